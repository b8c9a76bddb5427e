"""What a step tells of each flight beside its observation, and the infos of it."""

from __future__ import annotations

from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...plant import Array
from ..shared.vector_parts import presence
from .kernel import COUNTS, FLAGS, N_TOLD

Bools = NDArray[np.bool_]
_COUNT, _FLAG = np.dtype(np.int64), np.dtype(np.bool_)
# Rows one by one: an iteration over an array takes twice as long.
_numbers, _counts = itemgetter(*range(COUNTS)), itemgetter(*range(COUNTS, FLAGS))


class Scores(NamedTuple):
    """Views of what the kernel told of n flights."""

    reward: Array  # (n,), as the next ones
    stage_cost: Array
    cost: Array
    episode_cost: Array
    clipped: NDArray[np.int64]
    cause: NDArray[np.int64]
    crashed: Bools
    truncated: Bools
    violated: Bools
    values: Array  # (n, number of limits)


def _told(told: Array) -> tuple[Any, ...]:
    """The fields of `Scores` but the last."""
    n, flags = told.shape[1], told[FLAGS].view(_FLAG)
    crashed, truncated, violated = flags[:n], flags[n : 2 * n], flags[2 * n : 3 * n]
    return *_numbers(told), *_counts(told.view(_COUNT)), crashed, truncated, violated


def _values(told: Array) -> Array:
    return told[N_TOLD:].reshape(told.shape[1], len(told) - N_TOLD)


def scores_of(told: Array) -> Scores:
    """The scores in what the kernel told, see `kernel.N_TOLD`."""
    return Scores._make((*_told(told), _values(told)))


def blank_info(told: Array) -> dict[str, Any]:
    """An info with the masks of Gymnasium's vectors, for `answer_of` to copy and to fill."""
    *_, info = answer_of(told, {})
    return info | presence(told.shape[1], info)


def answer_of(told: Array, blank: dict[str, Any]) -> tuple[Array, Bools, Bools, dict[str, Any]]:
    """Reward, whether it crashed or is truncated, and info of every flight.

    Args:
        told: What the kernel told, see `kernel.N_TOLD`.
        blank: Of `blank_info`, which is copied.
    """
    reward, stage_cost, cost, episode_cost, clipped, cause, crashed, truncated, violated = _told(told)
    info = blank.copy()
    info["cost"] = cost
    info["episode_cost"] = episode_cost
    info["constraint_violation"] = violated
    if len(told) > N_TOLD or not blank:  # else they are no numbers, and there already
        info["constraint_values"] = _values(told)
    info["stage_cost"] = stage_cost
    info["crashed"] = crashed.copy()
    info["crash_cause"] = cause
    info["clipped_actions"] = clipped
    return reward, crashed, truncated, info
