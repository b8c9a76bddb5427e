"""What every policy checks of its arguments: rows of observations, flags, numbers that are not finite."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_envs.compilation.decorators import inline_kernel

from .protocol import N_FALLBACKS, Actions, PolicyState


def as_rows(observation: NDArray[Any], size: int) -> tuple[Actions, bool]:
    """Observations as rows (n, size) float32, and whether it was a single one.

    Raises:
        ValueError: If the shape is another one, or what is there are no real numbers.
    """
    given = np.asarray(observation)
    if given.dtype.kind not in "fiub":
        raise ValueError(f"observation must be an array of real numbers, got dtype {given.dtype}")
    obs = np.ascontiguousarray(given, dtype=np.float32)
    one = obs.ndim == 1
    if one:
        obs = obs.reshape(1, -1)
    if obs.ndim != 2 or obs.shape[1] != size:
        shape = np.shape(observation)
        raise ValueError(f"observation must have shape (n, {size}) or ({size},), got {shape}")
    return obs, one


def as_starts(episode_start: ArrayLike | None, n: int) -> NDArray[np.bool_]:
    """Which rows begin an episode, (n,) bool; None: none.

    Raises:
        ValueError: If the shape is wrong.
    """
    if episode_start is None:
        return np.zeros(n, dtype=np.bool_)
    start = np.ascontiguousarray(episode_start, dtype=np.bool_)
    if start.shape != (n,):
        raise ValueError(f"episode_start must have shape ({n},), one flag per row, got {start.shape}")
    return start


def state_of(state: PolicyState | None, n: int, memory_size: int) -> PolicyState:
    """The state of n rows; None: the one before an episode, whose memory is zero.

    Raises:
        ValueError: If the state is one of another number of rows.
    """
    if state is None:
        count = np.zeros(n, dtype=np.int64)
        memory = np.zeros((n, memory_size))
        fallbacks = np.zeros((n, N_FALLBACKS), dtype=np.int64)
        return PolicyState(memory, fallbacks, count, count, left_model=count)
    if state.worst_iterations.shape[0] != n:
        raise ValueError(f"state has {state.worst_iterations.shape[0]} rows, the observation {n}")
    return state


def times_left(state: PolicyState) -> NDArray[np.int64]:
    """`state.left_model`, zeros where a state has none."""
    return (
        np.zeros(len(state.worst_iterations), dtype=np.int64)
        if state.left_model is None
        else state.left_model
    )


@inline_kernel
def first_not_finite(row: Actions) -> int:
    """Index of the first entry of an observation that is not finite, or -1."""
    bad = 0
    for value in row:  # without a branch, so that it vectorises
        bad |= 0 if abs(value) < np.inf else 1
    if bad:
        for i in range(row.size):
            if not abs(row[i]) < np.inf:
                return i
    return -1


def not_finite(obs: NDArray[Any], index: int, slices: Mapping[str, slice]) -> ValueError:
    """The error for an observation with NaN or infinity at a flat index; slices name its parts."""
    row, column = divmod(index, obs.shape[1])
    name, start = _part(column, slices)
    where = f"entry {column - start} of {name!r}"
    return ValueError(
        f"observation {row} is not finite: {where} (index {column}) is {obs[row, column]}; "
        "check the sensors or the wrapper that made it"
    )


def too_large(obs: NDArray[Any], row: int, slices: Mapping[str, slice]) -> ValueError:
    """The error for a finite observation that no action follows from; slices name its parts."""
    column = int(np.argmax(np.abs(obs[row])))
    name, start = _part(column, slices)
    return ValueError(
        f"no action follows from observation {row}: entry {column - start} of {name!r} (index {column}) is "
        f"{obs[row, column]:g}, beyond what float32 can hold; check the sensors or the wrapper that made it"
    )


def _part(column: int, slices: Mapping[str, slice]) -> tuple[str, int]:
    """Name and first column of the part of an observation in which a column is."""
    parts = {name: part for name, part in slices.items() if name != "own"}
    name = next(name for name, part in parts.items() if part.start <= column < part.stop)
    return name, int(parts[name].start)


def require_finite(obs: NDArray[Any], slices: Mapping[str, slice]) -> None:
    """Check observations (n, d).

    Raises:
        ValueError: If a number is not finite, see `not_finite`.
    """
    finite = np.isfinite(obs)
    if not finite.all():
        raise not_finite(obs, int(np.argmin(finite)), slices)
