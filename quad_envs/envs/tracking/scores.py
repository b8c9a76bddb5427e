"""What a step tells of each flight beside its observation, and the infos of it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...plant import Array
from .kernel import COUNTS, FLAGS, N_TOLD

Bools = NDArray[np.bool_]
_COUNT, _FLAG = np.dtype(np.int64), np.dtype(np.bool_)


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


def scores_of(told: Array) -> Scores:
    """The scores in what the kernel told, see `kernel.N_TOLD`."""
    n = told.shape[1]
    reward, stage_cost, cost, episode_cost = told[:COUNTS]
    clipped, cause = told[COUNTS:FLAGS].view(_COUNT)
    flags = told[FLAGS].view(_FLAG)
    crashed, truncated, violated = flags[:n], flags[n : 2 * n], flags[2 * n : 3 * n]
    values = told[N_TOLD:].reshape(n, -1) if len(told) > N_TOLD else np.empty((n, 0))
    return Scores(
        reward, stage_cost, cost, episode_cost, clipped, cause, crashed, truncated, violated, values
    )


def info_of(scores: Scores) -> dict[str, Any]:
    """What `info` says of every flight."""
    return {
        "cost": scores.cost,
        "episode_cost": scores.episode_cost,
        "constraint_violation": scores.violated,
        "constraint_values": scores.values,
        "stage_cost": scores.stage_cost,
        "crashed": scores.crashed.copy(),
        "crash_cause": scores.cause,
        "clipped_actions": scores.clipped,
    }
