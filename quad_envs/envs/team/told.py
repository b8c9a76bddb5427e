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
_ENDS = slice(1, 4, 2)  # of these, truncated and terminated


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


class Parts(NamedTuple):
    """What the kernel told, kind by kind."""

    numbers: Array  # (6, n): from reward to distance of the nearest, as in `TeamScores`
    counts: Counts  # (3, n)
    flags: Bools  # (5, n)
    values: Array  # (n, number of constraints)
    terms: Array  # (n, number of terms of the reward)

    def somebody_ends(self) -> bool:
        """Whether a vehicle is truncated or terminated; 0.3 us for a hundred."""
        return 1 in self.flags[_ENDS].tobytes()


def parts_of(told: Array, constraints: int) -> Parts:
    """Views of what the kernel told, see `kernel.N_TOLD`."""
    n, end = told.shape[1], N_TOLD + constraints
    return Parts(
        told[:COUNTS],
        told[COUNTS:FLAGS].view(_COUNT),
        told[FLAGS].view(_FLAG).reshape(8, n)[:_N_FLAGS],
        told[N_TOLD:end].reshape(n, constraints),
        told[end:].reshape(n, len(told) - end),
    )


def team_scores(told: Array, constraints: int) -> TeamScores:
    """The scores in what the kernel told."""
    parts = parts_of(told, constraints)
    reward, stage_cost, cost, episode_cost, slot_error, nearest = parts.numbers
    clipped, cause, heard = parts.counts
    crashed, truncated, violated, terminated, alive = parts.flags
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
        parts.values,
        parts.terms,
    )
