"""MPC of a team: consensus, fusion with a target estimate, separation; Eqs. (5.4) to (5.8), (7.1), (7.2).

Each row of a call is one vehicle, which decides from its own measurements and messages alone; a whole team is
one compiled call. A vehicle flies SDC-NMPC in the heading frame (p = 0, psi = 0). Its state rows are those of
the task's limits, then those of the vehicles it senses, slot by slot, so that leading parts go to the solver.

Memory of one vehicle: whether a plan is held, the plan's rotor commands (N x 4), with `reject_disturbance`
the estimator's numbers, then the planned positions and velocities (N x 6).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quad_envs.checks import require_choice
from quad_envs.names import shown
from quad_envs.observations.team import N_PLAN_STAGE, N_SENSED
from quad_envs.observations.tracking import N_REFERENCE
from quad_envs.parameters import N_INPUT, Array
from quad_envs.tasks import TeamTask

from ..controller import PLANT_SIZE, as_array, require_horizon
from ..disturbance import ESTIMATOR_SIZE, N_DISTURBANCE
from ..mpc.kernels import MEMORY_STAGE, buffer_size, carve
from ..mpc.mpc import mpc_data
from ..mpc.options import MpcOptions
from ..qp.ocp import IntArray, OcpQp, StateRows, concatenate_rows
from ..qp.structured import ITERATION_LIMIT, make_workspace
from .collision import COLLISION_SCRATCH, AvoidanceOptions, AvoidanceRule, AvoidanceSet, time_to_stop
from .consensus import ConsensusOptions, Neighbour, TargetModel, require_messages
from .consensus_kernels import CONSENSUS_SCRATCH
from .cooperative_kernels import NAMES, RowLayout, Team, decide_team, pose_row

CooperativeTerminalWeight = Literal["hover", "stage"]
_TARGET = NAMES.index("estimate_r"), NAMES.index("slot") + 1


class CooperativeDecision(NamedTuple):
    """Commands for a team."""

    command: Array  # (n, 4), rotor commands F_cmd, N, finite and inside the box
    memory: Array  # (n, memory_size), opaque: pass it to the next decide
    fallback: IntArray  # (n,), Fallback: how each command was found
    iterations: IntArray  # (n,), active-set iterations
    left_model: IntArray  # (n,), 1 where its state or plan left where the model holds
    plan: Array  # (n, N, 6), p and v predicted for k+1..k+N, inertial, p relative to the present position


class CooperativeMpc:
    """Consensus, fusion, avoidance and SDC-NMPC of every vehicle of a team, chapters 5 and 7.

    Not for use by several threads at once: the scratch memory is shared.

    Deviation:
        The terminal weight, of which chapter 5 says nothing, solves the Riccati equation of hover; with Q
        itself ("stage") a formation never closes. It compares velocities in the level frame. alpha = 1 by
        default, see `SdcNmpc`. `consensus.py` and `collision.py` name their own deviations.

    Args:
        task: What is known of the flight; its layout gives the number of slots and the length of messages.
        horizon: N, samples.
        alpha: Member of the family of factorisations, in [0, 1]; 1/2 is the dissertation's.
        terminal_weight: "hover" or "stage".
        neighbour: How neighbours move on over the horizon: "cv" (constant velocity), "frozen" (the
            dissertation), "ca" (constant acceleration, from their attitude), "plan" (what they sent).
        feed_forward: Whether the own term of the consensus moves on, too.
        attitude: Whether tilt references come from the neighbours' accelerations; needs "ca", and a graph
            without cycles among followers.
        reach: Largest distance of a reference, m; inf for none. The dissertation has no such governor.
        speed: Largest velocity reference, m/s; inf for none. Above the leader's speed.
        formation_weight: P_f of (7.2), m^2.
        target: Whether the target moves on over the horizon: "cv" or "frozen".
        avoidance: "reciprocal", "frozen" (the dissertation's, its sign corrected), "plan" or "none".
        avoidance_set: Whom to avoid, "sensed" or "edges".
        moving_centre: Whether the common centre of a pair moves with it.
        braking_time: t_b, s; 0 for no braking row, None for the time in which 4 m/s^2 stop a vehicle at the
            governor's `speed`, or at 2 m/s where that is inf.
        swirl: Turn of the normals about the vertical, rad.
        separation_weight: Penalty per metre of a separation row; `collision.py` says why not more.
        separation_margin: What the plan keeps beyond the separation, m.
        plan_tilt: Largest roll and pitch of a plan, rad, besides the task's limit; inf for none. Rows that
            push a vehicle upside down push it to where its model holds no longer. With alpha = 1/2 vehicles
            that meet at 2 m/s each need 0.7.
        turning: Whether predicted positions follow the velocity as the predicted attitude turns it; the
            dissertation's keep the present R_BI.
        soft_weight: Exact penalty per unit of the other state rows; inf makes them hard.
        margin: What the plan keeps from each limit of the task, in its SI unit.
        reject_disturbance: Whether to estimate and cancel disturbances that are not revealed.
        estimator_gain: Share of each new residual in the estimate, in (0, 1]; "auto" takes it from
            `task.sensor_noise`, 0.5 without any.
        iteration_limit: Largest number of active-set steps of a solve; 0 for one that grows with it.

    Raises:
        ValueError: If an option is not allowed.
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
    ) -> None:
        horizon = require_horizon(horizon)
        if not 0.0 <= alpha <= 1.0:
            raise ValueError(f"alpha must lie in [0, 1], got {shown(alpha)}; 1/2 is the dissertation's")
        require_choice("terminal_weight", terminal_weight, CooperativeTerminalWeight)
        if not plan_tilt > 0.0:
            raise ValueError(f"plan_tilt must be > 0 rad, got {shown(plan_tilt)}; math.inf is no limit")
        self.task, self.horizon = task, horizon
        self.consensus = ConsensusOptions(
            neighbour, feed_forward, attitude, reach, speed, formation_weight, target
        )
        if braking_time is None:
            braking_time = time_to_stop(speed)
        self.avoidance = AvoidanceOptions(
            avoidance, avoidance_set, moving_centre, braking_time, swirl, separation_weight, separation_margin
        )
        self.options = MpcOptions(
            horizon=horizon,
            soft_weight=soft_weight,
            margin=margin,
            reject_disturbance=reject_disturbance,
            estimator_gain=estimator_gain,
            iteration_limit=iteration_limit,
            plan_tilt=math.inf,  # `_prepare` makes it a limit of the task
            plan_rate=math.inf,
        )
        require_messages(task.layout.comm_size, self.consensus)
        self.avoidance.require_plans(task.layout.plan)
        self._prepare(float(alpha), terminal_weight == "stage", float(plan_tilt), bool(turning))
        estimator = ESTIMATOR_SIZE if reject_disturbance else 0
        self.memory_size = 1 + (MEMORY_STAGE + N_PLAN_STAGE) * self.horizon + estimator
        self._workspace: tuple[Any, ...] | None = None

    def _prepare(self, alpha: float, stage_weight: bool, plan_tilt: float, turning: bool) -> None:
        """Constants for the kernels: the rows of the limits, then those of every slot."""
        task, edges = self.task, self.avoidance.neighbours == "edges"
        tilt = min(task.limits.tilt, plan_tilt + self.options.margin)
        planned = replace(task, limits=replace(task.limits, tilt=tilt))
        data = mpc_data(planned, self.options, "attitude")
        slots = task.layout.neighbours if edges else task.layout.sensed
        limits = StateRows(data.normals, data.normal, data.stage, data.lower, data.upper, data.weight)
        separation = self.avoidance.layout(slots, self.horizon)
        rows = concatenate_rows(limits, separation)
        axis = np.concatenate([data.axis, np.full(len(separation.normals), -1)])
        self._data = data._replace(**rows._asdict(), axis=axis, kinematics=True)
        self._layout = RowLayout(
            alpha, alpha if turning else 0.0, stage_weight, len(limits.normals), len(limits.normal),
            len(separation.normals) // max(slots, 1), len(separation.normal) // max(slots, 1),
            task.layout.comm_size, 1,
        )  # fmt: skip
        self._constants = (
            self.consensus.data(task.dt, task.params.gravity),
            self.avoidance.data(task.separation, task.sensing_radius, task.dt),
            self._layout,
            self._data,
        )

    def decide(
        self,
        plant: ArrayLike,
        last_command: ArrayLike,
        leader: ArrayLike,
        preview: ArrayLike,
        comm: ArrayLike,
        sensed: ArrayLike,
        estimate_r: ArrayLike | None,
        estimate_v: ArrayLike | None,
        estimate_P: ArrayLike | None,
        slot: ArrayLike | None,
        disturbance: ArrayLike,
        memory: ArrayLike,
    ) -> CooperativeDecision:
        """One command per vehicle; rows are independent. Laid out as in `quad_envs.observations.team`.

        Args:
            plant: Measured [p, V_B, Theta, Omega, F], (n, 16); p matters only where the task limits it.
            last_command: Last applied rotor commands, (n, 4), N.
            leader: Which vehicles follow their preview, (n,) bool.
            preview: Leader's reference relative to its own position, (n, >= N+1, 8); not read of others.
            comm: Messages, (n, K, 15 + 6 N_p).
            sensed: Vehicles nearby, (n, K_s, 7).
            estimate_r: Estimated target position less the own, (n, 3), m; None, as the next three, where
                there is no target.
            estimate_v: Estimated target velocity, (n, 3), m/s.
            estimate_P: Covariance of the estimated position, (n, 3, 3), m^2.
            slot: Wanted own position relative to the target, (n, 3), m.
            disturbance: Torque in body axes, N m, and force in inertial axes, N, as far as revealed, (n, 6).
            memory: Of the previous decision, (n, memory_size); zeros for a vehicle that starts.

        Returns:
            Commands, memory, how they were found, and the predictions.

        Raises:
            ValueError: If a shape is wrong or a number is not finite.
        """
        arguments = (
            plant, last_command, leader, preview, comm, sensed, estimate_r, estimate_v, estimate_P, slot,
            disturbance, memory,
        )  # fmt: skip
        team = self._as_team(arguments)
        n, N = len(team[0]), self.horizon
        command, kept = np.empty((n, N_INPUT)), np.empty((n, self.memory_size))
        report = np.empty((3, n), np.int64)
        which, *scratch = self._scratch()
        bad = decide_team(team, command, kept, report, which, *self._constants, *scratch)
        if bad >= 0:
            row, argument = divmod(bad, len(NAMES))
            remedy = (
                "pass on what decide returned" if NAMES[argument] == "memory" else "check the observation"
            )
            raise ValueError(f"{NAMES[argument]} of vehicle {row} is not finite; {remedy}")
        plan = kept[:, -N_PLAN_STAGE * N :].reshape(n, N, N_PLAN_STAGE).copy()
        return CooperativeDecision(command, kept, report[0], report[1], report[2], plan)

    def problems(self, *arguments: ArrayLike | None) -> list[OcpQp]:
        """The OCP-QP of each vehicle, in its heading frame; arguments as of `decide`. For study and tests."""
        team, found = self._as_team(arguments), []
        which, buffer, work, _ = self._scratch()
        data, layout = self._data, self._layout
        s = carve(buffer, self.horizon, layout.pairs, len(data.normals), len(data.normal), 0)
        for j in range(len(team[0])):
            H, K = pose_row(team, j, which, *self._constants, s, work)
            rows = StateRows(
                s.normals[:H].copy(),
                data.normal[:K],
                data.stage[:K],
                s.row_lower[:K].copy(),
                s.row_upper[:K].copy(),
                s.weight[:K].copy(),
            )
            found.append(
                OcpQp(
                    s.A.copy(),
                    s.B.copy(),
                    s.c.copy(),
                    data.Q,
                    data.R,
                    s.P.copy(),
                    False,
                    s.x_0.copy(),
                    s.r.copy(),
                    s.lower.copy(),
                    s.upper.copy(),
                    data.rate_step,
                    s.u_last.copy(),
                    rows,
                )
            )
        return found

    def _as_team(self, arguments: tuple[ArrayLike | None, ...]) -> Team:
        """The arguments of `decide` as contiguous float64 arrays, (n, numbers), of the right shapes."""
        empty = np.zeros((len(np.asarray(arguments[0])), 0))
        arrays = [empty if value is None else as_array(value) for value in arguments]
        n, layout = len(arrays[0]), self.task.layout
        shapes: list[tuple[int, ...]] = [
            (n, PLANT_SIZE), (n, N_INPUT), (n,), (n, layout.preview + 1, N_REFERENCE),
            (n, layout.neighbours, layout.comm_size), (n, layout.sensed, N_SENSED),
            (n, 3), (n, 3), (n, 3, 3), (n, 3), (n, N_DISTURBANCE), (n, self.memory_size),
        ]  # fmt: skip
        if all(arguments[k] is None for k in range(*_TARGET)):
            shapes[slice(*_TARGET)] = [(n, 0)] * 4
        for name, array, shape in zip(NAMES, arrays, shapes, strict=True):
            if array.shape != shape:
                raise ValueError(
                    f"{name} must have shape {shape} for this task and {n} vehicles, got {array.shape}"
                )
        if layout.preview < self.horizon and arrays[NAMES.index("leader")].any():
            raise ValueError(
                f"a leader's preview must reach over the horizon {self.horizon}, got {layout.preview}; "
                f"make the environment with preview={self.horizon} or shorten the horizon"
            )
        return tuple(array.reshape(n, math.prod(array.shape[1:])) for array in arrays)

    def _scratch(self) -> tuple[Any, ...]:
        """What the kernels take for the estimator, as buffer and work space, and for the solver."""
        if self._workspace is None:
            N, data = self.horizon, self._data
            self._workspace = (
                np.zeros(1, np.int64) if self.options.reject_disturbance else None,
                np.zeros(buffer_size(N, 1, len(data.normals), len(data.normal), 0)),
                np.zeros((N_REFERENCE + 2) * (N + 1) + max(CONSENSUS_SCRATCH, 18 + COLLISION_SCRATCH)),
                make_workspace(N, len(data.normal), 1),
            )
        return self._workspace

    def __getstate__(self) -> dict[str, Any]:
        """Everything but scratch memory, which is made again when needed."""
        return {**self.__dict__, "_workspace": None}
