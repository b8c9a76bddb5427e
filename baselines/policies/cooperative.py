"""The cooperative MPC of chapters 5 and 7 as policies: each agent decides from its own row alone."""

from __future__ import annotations

import math
from typing import Any, Literal, get_args

import numpy as np

from controllers.qp.structured import ITERATION_LIMIT
from controllers.team.collision import AvoidanceRule, AvoidanceSet
from controllers.team.consensus import Neighbour, TargetModel
from controllers.team.cooperative import CooperativeDecision, CooperativeMpc, CooperativeTerminalWeight
from quad_envs.names import unknown_name
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
from .rows import not_finite, times_left
from .team import Flags, TeamPolicy

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
        return self.controller.decide(
            parts.plant,
            parts.last_command,
            parts.leader[:, 0],
            parts.preview.reshape(n, layout.preview + 1, N_REFERENCE),
            parts.comm.reshape(n, layout.neighbours, layout.comm_size),
            parts.sensed.reshape(n, layout.sensed, N_SENSED),
            estimates.r if estimates is not None else None,
            estimates.v if estimates is not None else None,
            estimates.P[:, :3, :3] if estimates is not None else None,
            parts.slot if estimates is not None else None,
            parts.disturbance,
            memory,
        )

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
        horizon: See `controllers.team.cooperative.CooperativeMpc`, as all others.
        alpha: See there.
        terminal_weight: See there.
        neighbour: See there.
        feed_forward: See there.
        attitude: See there.
        reach: See there.
        speed: See there.
        avoidance: See there.
        avoidance_set: See there.
        moving_centre: See there.
        braking_time: See there.
        swirl: See there.
        separation_weight: See there.
        separation_margin: See there.
        plan_tilt: See there.
        turning: See there.
        soft_weight: See there.
        margin: See there.
        reject_disturbance: See there.
        estimator_gain: See there.
        iteration_limit: See there.

    Raises:
        ValueError: If the task has a target, or an option is not allowed.
    """

    def __init__(
        self,
        task: TeamTask,
        horizon: int = 5,
        alpha: float = 1.0,
        terminal_weight: CooperativeTerminalWeight = "hover",
        *,
        neighbour: Neighbour = "cv",
        feed_forward: bool = True,
        attitude: bool = False,
        reach: float = 1.0,
        speed: float = 2.0,
        avoidance: AvoidanceRule = "reciprocal",
        avoidance_set: AvoidanceSet = "sensed",
        moving_centre: bool = True,
        braking_time: float | None = None,
        swirl: float = math.radians(5.0),
        separation_weight: float = 1e3,
        separation_margin: float = 0.03,
        plan_tilt: float = 0.5,
        turning: bool = True,
        soft_weight: float = 1e3,
        margin: float = 0.02,
        reject_disturbance: bool = False,
        estimator_gain: float | Literal["auto"] = "auto",
        iteration_limit: int = ITERATION_LIMIT,
    ) -> None:
        if task.layout.target:
            raise ValueError(
                f"consensus-mpc has no answer to the target of {task.env_id!r}: take cooperative-mpc"
            )
        controller = CooperativeMpc(
            task, horizon, alpha, terminal_weight, neighbour=neighbour, feed_forward=feed_forward,
            attitude=attitude, reach=reach, speed=speed, avoidance=avoidance, avoidance_set=avoidance_set,
            moving_centre=moving_centre, braking_time=braking_time, swirl=swirl,
            separation_weight=separation_weight, separation_margin=separation_margin, plan_tilt=plan_tilt,
            turning=turning, soft_weight=soft_weight, margin=margin,
            reject_disturbance=reject_disturbance, estimator_gain=estimator_gain,
            iteration_limit=iteration_limit,
        )  # fmt: skip
        super().__init__(controller, "consensus-mpc", 0)

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


def make_cooperative_mpc(
    task: TeamTask,
    horizon: int = 5,
    alpha: float = 1.0,
    terminal_weight: CooperativeTerminalWeight = "hover",
    *,
    estimator: Any = None,
    q: Any = None,
    estimates: EstimateSource | None = None,
    neighbour: Neighbour = "cv",
    feed_forward: bool = True,
    attitude: bool = False,
    reach: float = 2.0,
    speed: float = 2.0,
    formation_weight: float = 0.1,
    target: TargetModel = "cv",
    avoidance: AvoidanceRule = "reciprocal",
    avoidance_set: AvoidanceSet = "sensed",
    moving_centre: bool = True,
    braking_time: float | None = None,
    swirl: float = math.radians(5.0),
    separation_weight: float = 1e3,
    separation_margin: float = 0.03,
    plan_tilt: float = 0.5,
    turning: bool = True,
    soft_weight: float = 1e3,
    margin: float = 0.02,
    reject_disturbance: bool = False,
    estimator_gain: float | Literal["auto"] = "auto",
    iteration_limit: int = ITERATION_LIMIT,
) -> TeamPolicy:
    """The policy of chapter 7. Where vehicles run on rails, its answer is its estimate.

    Options are those of `controllers.team.cooperative.CooperativeMpc` (reach is 2 m: the target is far at the
    start), and three more. `estimator` is "ekf" (None), "trilateration", "polar-ekf", "random-walk" or an
    object of the user's, and `q` belongs to it, see `estimation.make_estimator`; None: 0.02 for
    estimation, 0.05 m^2/s^3 for tracking. `estimates` is "own", a filter per agent in `state`, or "shared",
    what `EstimateWrapper` put into the observation; None: shared where it is there.

    Behind the target "aircraft", at up to 2.5 m/s, 1.0 m of error are left (RMS of the last 5 s, 20 flights,
    no crash), and 0.86 m with `q=0.4` and `speed=4`: the reference has the target's velocity and not its
    acceleration of 1 m/s^2, of which about 0.7 s^2 times it remain as lag, whatever the governor's speed.

    Raises:
        ValueError: If the task has no target, or an option is not allowed.
    """
    name, shared = "cooperative-mpc", _shares_estimates(task, estimates, q, estimator)
    controller = CooperativeMpc(
        task, horizon, alpha, terminal_weight, neighbour=neighbour, feed_forward=feed_forward,
        attitude=attitude, reach=reach, speed=speed, formation_weight=formation_weight, target=target,
        avoidance=avoidance, avoidance_set=avoidance_set, moving_centre=moving_centre,
        braking_time=braking_time, swirl=swirl, separation_weight=separation_weight,
        separation_margin=separation_margin, plan_tilt=plan_tilt, turning=turning,
        soft_weight=soft_weight, margin=margin, reject_disturbance=reject_disturbance,
        estimator_gain=estimator_gain, iteration_limit=iteration_limit,
    )  # fmt: skip
    if task.mission != "estimation":
        return TargetMpc(controller, None if shared else make_estimator(task, estimator, q))
    return SharedEstimatePolicy(task, name) if shared else EstimatorPolicy(task, name, estimator, q)


def _shares_estimates(task: TeamTask, estimates: Any, q: Any, estimator: Any) -> bool:
    """Whether the estimates come from the observation.

    Raises:
        ValueError: If there is no such source, the observation has no estimates, or q would have no effect.
    """
    if estimates is not None and estimates not in get_args(EstimateSource):
        raise ValueError(unknown_name("value of estimates", estimates, get_args(EstimateSource)))
    shared = task.layout.estimate if estimates is None else estimates == "shared"
    if shared and not task.layout.estimate:
        raise ValueError(
            f"estimates='shared' needs estimates in the observation of {task.env_id!r}: put an "
            "EstimateWrapper around the environment, or take estimates='own'"
        )
    for name, value in (("q", q), ("estimator", estimator)):
        if shared and value is not None:
            raise ValueError(
                f"{name} = {value!r} belongs to a filter of one's own: give it to the EstimateWrapper instead"
            )
    return bool(shared)
