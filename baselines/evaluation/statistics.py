"""Interquartile means, paired differences and probabilities of improvement, with bootstrap intervals.

A learned policy is known only over its training seeds, and any policy only over its starts. Values are arrays
(S, E): S training seeds (1 for a controller) by E starts, the same starts for all that are compared. A
resample draws training seeds and starts with replacement, and the same starts for both sides of a comparison.
After Agarwal et al., *Deep Reinforcement Learning at the Edge of the Statistical Precipice* (2021), with
the starts paired.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from quad_envs.parameters import Array

from .amounts import INTERVAL_LEAST

RESAMPLES = 2_000
_COVERED = (2.5, 97.5)  # percentiles of the resamples
_AT_ONCE = 8_000_000  # drawn values that are held together, 64 MB


class Interval(NamedTuple):
    """A statistic with its 95 % bootstrap interval, nan below INTERVAL_LEAST starts."""

    value: float
    low: float
    high: float


class Comparison(NamedTuple):
    """A policy by itself, and beside another from the same starts."""

    iqm: Interval  # interquartile mean over seeds and starts
    difference: Interval  # mean of ours - theirs on the same start
    improvement: Interval  # probability that ours is better on a start; equal ones count half


def interquartile_mean(values: Array) -> Array:
    """Mean of the middle half along the last axis, a quarter of the values cut off at each end.

    Args:
        values: (..., n).
    """
    ordered = np.sort(values, axis=-1)
    cut = ordered.shape[-1] // 4
    return np.asarray(ordered[..., cut : ordered.shape[-1] - cut].mean(axis=-1))


def compare(
    ours: Sequence[Array], theirs: Sequence[Array], resamples: int = RESAMPLES, seed: int = 0
) -> Comparison:
    """Statistics over one or more tasks, resampled within each.

    The interquartile mean is over the values of all tasks together, the difference and the probability are
    means over the tasks.

    Args:
        ours: One array (S, E) per task, higher is better.
        theirs: One array (S', E) per task, from the same starts.
        resamples: Of the bootstrap.
        seed: Of the bootstrap.

    Raises:
        ValueError: If there is no task, the starts do not match, or a value is not finite.
    """
    _check(ours, theirs)
    rng = np.random.default_rng(seed)
    exact = _Pieces((x[None], y[None]) for x, y in zip(ours, theirs, strict=True))()
    drawn = [_Pieces(_resample(ours, theirs, n, rng))() for n in _portions(ours, theirs, resamples)]
    few = any(x.shape[1] < INTERVAL_LEAST for x in ours)
    return Comparison(
        *(
            Interval(float(one[0]), *((math.nan,) * 2 if few else _range(many)))
            for one, many in zip(exact, map(np.concatenate, zip(*drawn, strict=True)), strict=True)
        )
    )


def difference(
    ours: Sequence[Array], theirs: Sequence[Array], resamples: int = RESAMPLES, seed: int = 0
) -> Interval:
    """The mean of ours - theirs alone, see `compare`; the interval is nan below INTERVAL_LEAST starts."""
    _check(ours, theirs)
    rng = np.random.default_rng(seed)
    value = float(np.mean([x.mean() - y.mean() for x, y in zip(ours, theirs, strict=True)]))
    if any(x.shape[1] < INTERVAL_LEAST for x in ours):
        return Interval(value, math.nan, math.nan)
    means = [
        np.mean(
            [x.mean(axis=(1, 2)) - y.mean(axis=(1, 2)) for x, y in _resample(ours, theirs, n, rng)], axis=0
        )
        for n in _portions(ours, theirs, resamples)
    ]
    return Interval(value, *_range(np.concatenate(means)))


def mean_interval(values: Array, resamples: int = RESAMPLES, seed: int = 0) -> Interval:
    """The mean over training seeds and starts (S, E), both resampled; nan where a value is not finite."""
    value = float(values.mean())
    if values.shape[1] < INTERVAL_LEAST or not math.isfinite(value):
        return Interval(value, math.nan, math.nan)
    rng, sides = np.random.default_rng(seed), ([values], [values[:1]])
    means = [
        drawn.mean(axis=(1, 2))
        for n in _portions(*sides, resamples)
        for drawn, _ in _resample(*sides, n, rng)
    ]
    return Interval(value, *_range(np.concatenate(means)))


class _Pieces:
    """What the statistics of several tasks are made of, in several resamples at once."""

    def __init__(self, tasks: Iterable[tuple[Array, Array]]) -> None:
        self._values: list[Array] = []
        self._differences: list[Array] = []
        self._improvements: list[Array] = []
        for x, y in tasks:
            self._add(x, y)

    def _add(self, x: Array, y: Array) -> None:
        """One more task: x (n, S, E) and y (n, S', E) in n resamples."""
        self._values.append(x.reshape(len(x), -1))
        self._differences.append(x.mean(axis=(1, 2)) - y.mean(axis=(1, 2)))
        better = np.sign(x[:, :, None] - y[:, None, :]).mean(axis=(1, 2, 3))
        self._improvements.append(0.5 * (1.0 + better))

    def __call__(self) -> tuple[Array, Array, Array]:
        """Interquartile mean, difference and probability of improvement, (n,) each."""
        return (
            interquartile_mean(np.concatenate(self._values, axis=1)),
            np.mean(self._differences, axis=0),
            np.mean(self._improvements, axis=0),
        )


def _portions(ours: Sequence[Array], theirs: Sequence[Array], resamples: int) -> list[int]:
    """How many resamples are drawn at a time, so that what is held does not grow with the starts."""
    size = sum(max(x.size, y.size) for x, y in zip(ours, theirs, strict=True))
    most = max(1, _AT_ONCE // size)
    whole, rest = divmod(resamples, most)
    return [most] * whole + [rest] * (rest > 0)


def _resample(
    ours: Sequence[Array], theirs: Sequence[Array], n: int, rng: np.random.Generator
) -> Iterator[tuple[Array, Array]]:
    """(n, S, E) and (n, S', E) of each task: seeds of each side by themselves, starts together."""
    for x, y in zip(ours, theirs, strict=True):
        starts = rng.integers(x.shape[1], size=(n, 1, x.shape[1]))
        own, other = (rng.integers(len(z), size=(n, len(z), 1)) for z in (x, y))
        yield x[own, starts], y[other, starts]


def _range(values: Array) -> tuple[float, float]:
    low, high = np.percentile(values, _COVERED)
    return float(low), float(high)


def _check(ours: Sequence[Array], theirs: Sequence[Array]) -> None:
    if not ours or len(ours) != len(theirs):
        raise ValueError(f"compare needs the same tasks on both sides, got {len(ours)} and {len(theirs)}")
    for x, y in zip(ours, theirs, strict=True):
        if x.ndim != 2 or y.ndim != 2 or x.shape[1] != y.shape[1] or 0 in (*x.shape, *y.shape):
            raise ValueError(
                "compare needs arrays of training seeds x the same starts, got shapes "
                f"{x.shape} and {y.shape}"
            )
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            raise ValueError("compare needs finite values: leave out columns that a crash cuts short")
