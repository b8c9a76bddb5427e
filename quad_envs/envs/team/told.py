"""What a step tells of each vehicle of a team beside its observation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...plant import Array
from .kernel import COUNTS, FLAGS, N_TOLD

Bools = NDArray[np.bool_]
Counts = NDArray[np.int64]
_COUNT, _FLAG = np.dtype(np.int64), np.dtype(np.bool_)
_N_FLAGS = 5


class TeamScores(NamedTuple):
    """Views of what the kernel told of n vehicles."""

    reward: Array  # (n,), as the next ones
    stage_cost: Array
    cost: Array
    episode_cost: Array
    slot_error: Array  # m
    nearest: Array  # m
    clipped: Counts
    cause: Counts
    heard: Counts
    crashed: Bools
    truncated: Bools
    violated: Bools
    terminated: Bools
    alive: Bools
    values: Array  # (n, number of constraints)
    terms: Array  # (n, number of terms of the reward)


def team_scores(told: Array, constraints: int) -> TeamScores:
    """The scores in what the kernel told, see `kernel.N_TOLD`."""
    n, end = told.shape[1], N_TOLD + constraints
    reward, stage_cost, cost, episode_cost, slot_error, nearest = told[:COUNTS]
    clipped, cause, heard = told[COUNTS:FLAGS].view(_COUNT)
    crashed, truncated, violated, terminated, alive = told[FLAGS].view(_FLAG).reshape(8, n)[:_N_FLAGS]
    return TeamScores(
        reward,
        stage_cost,
        cost,
        episode_cost,
        slot_error,
        nearest,
        clipped,
        cause,
        heard,
        crashed,
        truncated,
        violated,
        terminated,
        alive,
        told[N_TOLD:end].reshape(n, constraints),
        told[end:].reshape(n, len(told) - end),
    )
