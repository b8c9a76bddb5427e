"""A safety filter in front of a policy: its commands, corrected where the limits could not be kept else."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controllers.mpc.options import SafetyOptions
from controllers.mpc.safety import Correction, SafetyFilter
from quad_envs.arguments.names import shown
from quad_envs.constraints import forces_from_actions
from quad_envs.parameters import N_INPUT, Array
from quad_envs.tasks import BaseTask, Task

from ..errors import PolicyError
from .blame import place_where_defined
from .pairing import require_pair
from .protocol import Actions, Interventions, PolicyState
from .rows import as_rows, as_starts, state_of
from .tracking import ControllerPolicy, Seen


def task_to_keep(task: BaseTask) -> Task:
    """A task that a filter can keep.

    Raises:
        ValueError: If it is one of a team.
    """
    if isinstance(task, Task):
        return task
    raise ValueError(
        f"a safety filter stands in front of the policy of one vehicle, and {task.env_id} is a task of "
        f"{task.mission}: choose a policy that keeps the limits and distances of a team itself, as "
        "consensus-mpc or cooperative-mpc"
    )


class SafePolicy(ControllerPolicy):
    """A policy whose commands keep the limits of its task.

    Args:
        policy: It; whatever has `predict`, for the observations of one vehicle.
        task: Where it flies.
        options: Of the filter.
        name: Of the policy, for tables and messages.

    Raises:
        ValueError: If the policy is filtered already or is for another task, or the task has no limits.
    """

    controller: SafetyFilter

    def __init__(self, policy: Any, task: Task, options: SafetyOptions, name: str) -> None:
        if isinstance(policy, SafePolicy):
            raise ValueError(f"policy {policy.name!r} has a safety filter already: one is enough")
        require_pair(policy, task)
        super().__init__(SafetyFilter(task, options), task, f"safe:{name}")
        self.unfiltered = policy

    def predict(
        self,
        observation: NDArray[Any],
        state: PolicyState | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, PolicyState]:
        """Choose actions; see `Policy`.

        Raises:
            ValueError: If a shape is wrong or an observation is not finite; it names the part.
            PolicyError: If the policy behind the filter does not return (actions, state).
        """
        obs, one = as_rows(observation, self._size)
        start = as_starts(episode_start, len(obs))
        seen = self._read(obs, state_of(state, len(obs), self.memory_size), start)
        answer = self.unfiltered.predict(
            obs, seen.state.behind, None if episode_start is None else start, deterministic=deterministic
        )
        wanted, behind = self._forces(answer, len(obs))
        correction = self.controller.filter(*seen.arguments, wanted)
        actions, kept = self._answer(seen, correction.decision)
        kept = kept._replace(interventions=_counted(seen, correction), behind=behind)
        return actions[0] if one else actions, kept

    def _forces(self, answer: Any, n: int) -> tuple[Array, Any]:
        """Commands of what the policy behind the filter answered, (n, 4), N, and its state."""
        if not isinstance(answer, tuple) or len(answer) != 2:
            raise self._broken(f"must return (actions, state), got {shown(answer)}")
        actions = np.asarray(answer[0])
        if actions.shape != (n, N_INPUT) or actions.dtype.kind not in "fiu":
            raise self._broken(
                f"must return actions of shape ({n}, {N_INPUT}), got {actions.shape} of {actions.dtype}"
            )
        return forces_from_actions(actions, self._hover, self._force_max), answer[1]

    def _broken(self, what: str) -> PolicyError:
        place = place_where_defined(self.unfiltered.predict)
        return PolicyError(f"predict of the policy behind {self.name!r} {what}" + (place and f"; {place}"))


def _counted(seen: Seen, correction: Correction) -> Interventions:
    """The interventions of the episode with those of one step."""
    change, start, before = correction.change, seen.start, seen.state.interventions
    unanswered = np.isnan(change)
    size = np.where(unanswered, 0.0, change)
    found = Interventions((unanswered | (size > 0.0)).astype(np.int64), size, unanswered.astype(np.int64))
    if before is None:
        return found
    return Interventions._make(
        np.where(start, now, now + old) for now, old in zip(found, before, strict=True)
    )
