"""The cooperative MPC of chapters 5 and 7 as policies: each agent decides from its own row alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from controllers.mpc.options import chosen, shared
from controllers.team.cooperative import CooperativeDecision, CooperativeMpc
from controllers.team.options import CooperativeOptions, FormationMpcOptions
from controllers.team.situation import TargetEstimate, TeamSituation
from quad_envs.arguments.names import unknown_name
from quad_envs.observations.team import N_SENSED
from quad_envs.observations.tracking import N_REFERENCE
from quad_envs.parameters import Array
from quad_envs.tasks import TeamTask

from .decoding import (
    Decoded,
    decode_rows,
    empty_parts,
    encode_decisions,
    part_starts,
    split_memory,
)
from .estimation import AgentFilters, EstimatorPolicy, SharedEstimatePolicy, make_estimator, shared_estimates
from .protocol import N_FALLBACKS, Actions, Counts, Estimates, PolicyState
from .row_policy import Flags
from .rows import not_finite, times_left
from .team import TeamPolicy

EstimateSource = Literal["own", "shared"]


class CooperativePolicy(TeamPolicy):
    """A `CooperativeMpc` between observations and actions.

    The memory of an agent is the controller's, then that of its filter where there is one.

    Args:
        controller: Of the team.
        name: For tables and messages.
        filter_size: Numbers of a filter in the memory.
    """

    def __init__(self, controller: CooperativeMpc, name: str, filter_size: int) -> None:
        super().__init__(controller.task, name, controller.memory_size + filter_size)
        self.controller, self._filter_size = controller, filter_size
        self._starts = part_starts(self.task.layout)

    def _decode(self, obs: Actions, memory: Array, start: Flags) -> tuple[Decoded, Array]:
        """The parts of the rows, and the controller's memory."""
        parts, kept = empty_parts(self.task.layout, len(obs)), np.empty((len(obs), memory.shape[1]))
        code = decode_rows(obs, self._starts, *parts)
        if code >= 0:
            raise not_finite(obs, code, self.task.layout.slices)
        split_memory(memory, start, kept, np.empty((len(obs), 0)))
        return parts, kept

    def _control(self, parts: Decoded, estimates: Estimates | None, memory: Array) -> CooperativeDecision:
        """The controller's decision."""
        n, layout = len(parts.plant), self.task.layout
        believed = None
        if estimates is not None:
            believed = TargetEstimate(estimates.r, estimates.v, estimates.P[:, :3, :3], parts.slot)
        situation = TeamSituation(
            parts.plant,
            parts.last_command,
            parts.comm.reshape(n, layout.neighbours, layout.comm_size),
            parts.sensed.reshape(n, layout.sensed, N_SENSED),
            parts.leader[:, 0],
            parts.preview.reshape(n, layout.preview + 1, N_REFERENCE),
            believed,
            parts.disturbance,
        )
        return self.controller.decide(situation, memory)

    def _act(
        self,
        decision: CooperativeDecision,
        filters: Array,
        estimates: Estimates | None,
        state: PolicyState,
        start: Flags,
    ) -> tuple[Actions, PolicyState]:
        """The decision as actions, and the state to pass on."""
        n, task = len(start), self.task
        actions = np.empty((n, task.action_size), dtype=np.float32)
        counts: Counts = np.empty((n, N_FALLBACKS), dtype=np.int64)
        worst, left = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
        memory = np.empty((n, self.memory_size))
        encode_decisions(
            decision.command,
            decision.plan.reshape(n, -1),
            decision.fallback,
            decision.iterations,
            decision.left_model,
            start,
            state.fallbacks,
            state.worst_iterations,
            times_left(state),
            float(task.hover_force),
            task.force_max,
            float(task.dt),
            decision.memory,
            filters,
            actions,
            counts,
            worst,
            left,
            memory,
        )
        return actions, PolicyState(memory, counts, decision.iterations, worst, estimates, left)


class ConsensusMpc(CooperativePolicy):
    """Consensus, collision avoidance and MPC of each vehicle, chapter 5.

    Args:
        task: Of the mission "formation".
        options: See `FormationMpcOptions`; None for the defaults.
        changes: Fields of it, such as horizon=10, which replace those of `options`.

    Raises:
        TypeError: If there is no such option.
        ValueError: If the task has a target, or an option is not allowed.
    """

    options_type = FormationMpcOptions

    def __init__(self, task: TeamTask, options: FormationMpcOptions | None = None, **changes: Any) -> None:
        if task.layout.target:
            raise ValueError(
                f"consensus-mpc has no answer to the target of {task.env_id!r}: take cooperative-mpc"
            )
        options = chosen(FormationMpcOptions, options, changes)
        super().__init__(CooperativeMpc(task, shared(CooperativeOptions, options)), "consensus-mpc", 0)

    def _decide(self, obs: Actions, state: PolicyState, start: Flags) -> tuple[Actions, PolicyState]:
        parts, memory = self._decode(obs, state.memory, start)
        decision = self._control(parts, None, memory)
        return self._act(decision, np.empty((len(obs), 0)), None, state, start)


class TargetMpc(CooperativePolicy):
    """The cooperative MPC beside a target that each agent estimates, or is told of by the wrapper, chapter 7.

    Args:
        controller: Of the team.
        estimator: The agents' filters; None: the estimates in the observation.
    """

    def __init__(self, controller: CooperativeMpc, estimator: AgentFilters | None) -> None:
        super().__init__(controller, "cooperative-mpc", 0 if estimator is None else estimator.size)
        self.estimator = estimator

    def _decide(self, obs: Actions, state: PolicyState, start: Flags) -> tuple[Actions, PolicyState]:
        if self.estimator is None:
            parts, memory = self._decode(obs, state.memory, start)
            estimates, filters = shared_estimates(parts.estimate), np.empty((len(obs), 0))
        else:
            parts, memory, filters, *_ = done = self.estimator.step(obs, state.memory, start)
            estimates = done.estimates
        decision = self._control(parts, estimates, memory)
        return self._act(decision, filters, estimates, state, start)


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetMpcOptions(CooperativeOptions):
    """What the policy of chapter 7 lets choose."""

    reach: float = 2.0  # m, governor: largest distance of a reference, wide: the target is far at the start
    estimator: Any = (
        None  # "ekf" (None), "trilateration", "polar-ekf", "random-walk", or an object of the user's
    )
    q: Any = None  # of the estimator, m^2/s^3 of "ekf"; None: 0.02 for estimation, 0.05 for tracking
    estimates: EstimateSource | None = (
        None  # "own", a filter per agent in `state`, or "shared", what `EstimateWrapper` put into the
        # observation; None: shared where it is there
    )


def make_cooperative_mpc(
    task: TeamTask, options: TargetMpcOptions | None = None, **changes: Any
) -> TeamPolicy:
    """The policy of chapter 7. Where vehicles run on rails, its answer is its estimate.

    Behind the target "aircraft", at up to 2.5 m/s, 1.0 m of error are left (RMS of the last 5 s, 20 flights,
    no crash), and 0.86 m with `q=0.4` and `speed=4`: the reference has the target's velocity and not its
    acceleration of 1 m/s^2, of which about 0.7 s^2 times it remain as lag, whatever the governor's speed.

    Args:
        task: With a target.
        options: See `TargetMpcOptions`; None for the defaults.
        changes: Fields of it, such as horizon=10, which replace those of `options`.

    Raises:
        TypeError: If there is no such option.
        ValueError: If the task has no target, or an option is not allowed.
    """
    options = chosen(TargetMpcOptions, options, changes)
    name, (estimator, q) = "cooperative-mpc", (options.estimator, options.q)
    told = _shares_estimates(task, options)
    controller = CooperativeMpc(task, options)
    if task.mission != "estimation":
        return TargetMpc(controller, None if told else make_estimator(task, estimator, q))
    return SharedEstimatePolicy(task, name) if told else EstimatorPolicy(task, name, estimator, q)


make_cooperative_mpc.options_type = TargetMpcOptions  # type: ignore[attr-defined]


def _shares_estimates(task: TeamTask, options: TargetMpcOptions) -> bool:
    """Whether the estimates come from the observation.

    Raises:
        ValueError: If there is no such source, the observation has no estimates, or q would have no effect.
    """
    estimates = options.estimates
    if estimates is not None and estimates not in get_args(EstimateSource):
        raise ValueError(unknown_name("value of estimates", estimates, get_args(EstimateSource)))
    told = task.layout.estimate if estimates is None else estimates == "shared"
    if told and not task.layout.estimate:
        raise ValueError(
            f"estimates='shared' needs estimates in the observation of {task.env_id!r}: put an "
            "EstimateWrapper around the environment, or take estimates='own'"
        )
    for name in ("q", "estimator"):
        value = getattr(options, name)
        if told and value is not None:
            raise ValueError(
                f"{name} = {value!r} belongs to a filter of one's own: give it to the EstimateWrapper instead"
            )
    return bool(told)
