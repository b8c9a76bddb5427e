"""What is recorded of a team beyond the flight itself, and of what its policy believes of a target.

| signal | shape | content |
|---|---|---|
| formation_error | (T,) | m, distance to the own slot after the step; on rails the error of the answer |
| min_separation | (T,) | m, to the nearest vehicle, smallest over the substeps |
| messages | (T,) | messages that were heard in the step |
| reward_terms | (T, terms) | parts of the stage cost, then violation / scale of each limit |
| estimate_error | (T, 6) | estimated minus true [r, v] of the target when the policy decided, m and m/s |
| estimate_covariance | (T, 6, 6) | what the policy gives as its covariance; nan where it gives none |
| trilaterated | (T,) | whether the measurements entered as a trilaterated position |
| nis, nis_rows | (T,) | normalised innovation squared of an update, and the numbers in it |

An update belongs to the decision of its step; that of the estimate wrapper comes with the step's answer.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_envs.envs.team.kernel import ESTIMATE_REACH, ESTIMATE_SPEED
from quad_envs.parameters import POSITION, Array
from quad_envs.tasks import TeamTask

from ..policies.estimation import shared_estimates
from ..policies.protocol import Estimates, PolicyState

# Keys of `info` that become signals under the same names.
TEAM_INFO = ("formation_error", "min_separation", "messages", "reward_terms")
WRAPPER_INFO = ("nis", "nis_rows")  # of the estimate wrapper's filter, where the policy has none of its own


def estimate_signals(
    task: TeamTask,
    state: Any,
    observations: NDArray[Any],
    actions: NDArray[Any],
    plants: Array,
    targets: Array,
) -> dict[str, NDArray[Any]]:
    """What every vehicle believed of the target when it decided, beside the truth.

    Taken from the policy's state; else from the estimate wrapper's block of the observation; else, where the
    action is an estimate, from the action. Empty where nobody says anything.

    Args:
        task: Of the flight.
        state: What the policy returned.
        observations: From which it decided, (n, d).
        actions: What it decided, (n, action size).
        plants: Then, (n, 16).
        targets: Then, rows r, v, (n, 6).
    """
    found = _believed(task, state, observations, actions)
    if found is None:
        return {}
    r = found.r + plants[:, POSITION] - targets[:, :3]
    out: dict[str, NDArray[Any]] = {
        "estimate_error": np.concatenate([r, found.v - targets[:, 3:]], axis=1),
        "estimate_covariance": found.P,
        "nis": found.nis,
        "nis_rows": found.rows,
    }
    return out if found.trilaterated is None else out | {"trilaterated": found.trilaterated}


def _believed(
    task: TeamTask, state: Any, observations: NDArray[Any], actions: NDArray[Any]
) -> Estimates | None:
    """Estimates relative to the own vehicles."""
    if isinstance(state, PolicyState) and state.estimates is not None:
        return state.estimates
    if task.layout.estimate:
        own = task.layout.decode(observations).estimate[:, 0]
        return shared_estimates(np.where(own[:, :1] > 0.0, own, np.nan))
    if task.mission == "estimation":
        n, answer = len(observations), np.clip(np.asarray(actions, dtype=np.float64), -1.0, 1.0)
        P, no_nis, no_rows = np.full((n, 6, 6), np.nan), np.full(n, np.nan), np.zeros(n, dtype=np.int64)
        return Estimates(ESTIMATE_REACH * answer[:, :3], ESTIMATE_SPEED * answer[:, 3:], P, no_nis, no_rows)
    return None
