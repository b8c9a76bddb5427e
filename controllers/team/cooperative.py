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
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quad_envs.compilation.packed import pack
from quad_envs.observations.team import N_PLAN_STAGE, N_SENSED
from quad_envs.observations.tracking import N_REFERENCE
from quad_envs.parameters import N_INPUT, Array
from quad_envs.tasks import TeamTask

from ..controller import PLANT_SIZE, as_array
from ..disturbance import ESTIMATOR_SIZE, N_DISTURBANCE
from ..mpc.kernels import MEMORY_STAGE, make_scratch
from ..mpc.mpc import mpc_data
from ..mpc.options import MpcOptions, chosen, shared
from ..qp.ocp import IntArray, OcpQp, StateRows, concatenate_rows
from ..qp.workspace import make_workspace
from .collision import COLLISION_SCRATCH
from .consensus import require_messages
from .consensus_kernels import CONSENSUS_SCRATCH
from .cooperative_kernels import NAMES, RowLayout, Team, TeamCall, decide_team, pose_row
from .options import CooperativeOptions
from .situation import TeamSituation


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
        options: See `CooperativeOptions`; None for the defaults.
        changes: Fields of it, such as horizon=10, which replace those of `options`.

    Raises:
        TypeError: If there is no such option.
        ValueError: If an option is not allowed.
    """

    options_type = CooperativeOptions

    def __init__(self, task: TeamTask, options: CooperativeOptions | None = None, **changes: Any) -> None:
        self.task, self.options = task, chosen(CooperativeOptions, options, changes)
        self.horizon = int(self.options.horizon)
        require_messages(task.layout.comm_size, self.options)
        self.options.require_plans(task.layout.plan)
        self._prepare()
        estimator = ESTIMATOR_SIZE if self.options.reject_disturbance else 0
        self.memory_size = 1 + (MEMORY_STAGE + N_PLAN_STAGE) * self.horizon + estimator
        self._memory: tuple[IntArray | None, TeamCall, IntArray] | None = None

    def _prepare(self) -> None:
        """Constants for the kernels: the rows of the limits, then those of every slot."""
        task, options = self.task, self.options
        tilt = min(task.limits.tilt, float(options.plan_tilt) + options.margin)
        planned = replace(task, limits=replace(task.limits, tilt=tilt))
        single = shared(MpcOptions, options, plan_tilt=math.inf, plan_rate=math.inf)  # a limit of the task
        data = mpc_data(planned, single, "attitude")
        slots = task.layout.neighbours if options.avoidance_set == "edges" else task.layout.sensed
        limits = StateRows(data.normals, data.normal, data.stage, data.lower, data.upper, data.weight)
        separation = options.separation_layout(slots, self.horizon)
        rows = concatenate_rows(limits, separation)
        axis = np.concatenate([data.axis, np.full(len(separation.normals), -1)])
        self._data = data._replace(**rows._asdict(), axis=axis, kinematics=True)
        alpha = float(options.alpha)
        self._layout = RowLayout(
            alpha, alpha if options.turning else 0.0, options.terminal_weight == "stage",
            len(limits.normals), len(limits.normal),
            len(separation.normals) // max(slots, 1), len(separation.normal) // max(slots, 1),
            task.layout.comm_size,
        )  # fmt: skip
        self._constants = (
            options.consensus_data(task.dt, task.params.gravity),
            options.avoidance_data(task.separation, task.sensing_radius, task.dt),
            self._layout,
            self._data,
        )

    def decide(self, situation: TeamSituation, memory: ArrayLike, *former: Any) -> CooperativeDecision:
        """One command per vehicle; rows are independent.

        Args:
            situation: What the vehicles measure, hear and believe.
            memory: Of the previous decision, (n, memory_size); zeros for a vehicle that starts.
            former: Nothing: the parts of the situation were arguments of their own before.

        Returns:
            Commands, memory, how they were found, and the predictions.

        Raises:
            TypeError: If the parts of the situation are given one by one.
            ValueError: If a shape is wrong or a number is not finite.
        """
        if former:
            raise TypeError(
                "decide takes a situation and the memory: "
                f"decide(TeamSituation({', '.join(f'{name}=...' for name in TeamSituation._fields)}), memory)"
            )
        team = self._as_team(situation, memory)
        n, N = len(team[0]), self.horizon
        command, kept = np.empty((n, N_INPUT)), np.empty((n, self.memory_size))
        report = np.empty((3, n), np.int64)
        which, _, words = self._scratch()
        bad = decide_team(team, command, kept, report, which, words)
        if bad >= 0:
            row, argument = divmod(bad, len(NAMES))
            remedy = (
                "pass on what decide returned" if NAMES[argument] == "memory" else "check the observation"
            )
            raise ValueError(f"{NAMES[argument]} of vehicle {row} is not finite; {remedy}")
        plan = kept[:, -N_PLAN_STAGE * N :].reshape(n, N, N_PLAN_STAGE).copy()
        return CooperativeDecision(command, kept, report[0], report[1], report[2], plan)

    def problems(self, situation: TeamSituation, memory: ArrayLike) -> list[OcpQp]:
        """The OCP-QP of each vehicle, in its heading frame; arguments as of `decide`. For study and tests."""
        team, found = self._as_team(situation, memory), []
        which, call, _ = self._scratch()
        data, s = self._data, call.s
        for j in range(len(team[0])):
            H, K = pose_row(team, j, which, *call[:-1])
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
                    data.R_rate if len(data.R_rate) else None,
                )
            )
        return found

    def _as_team(self, situation: TeamSituation, memory: ArrayLike) -> Team:
        """The arguments of `decide` as contiguous float64 arrays, (n, numbers), of the right shapes."""
        plant, last, comm, sensed, leader, preview, target, disturbance = situation
        n, layout = len(np.asarray(plant)), self.task.layout
        window = n, layout.preview + 1, N_REFERENCE
        arrays = [
            as_array(value)
            for value in (
                plant,
                last,
                np.zeros(n) if leader is None else leader,
                np.zeros(window) if preview is None else preview,
                comm,
                sensed,
                *((np.zeros((n, 0)),) * 4 if target is None else target),
                np.zeros((n, N_DISTURBANCE)) if disturbance is None else disturbance,
                memory,
            )
        ]
        believed = ((n, 0),) * 4 if target is None else ((n, 3), (n, 3), (n, 3, 3), (n, 3))
        shapes: list[tuple[int, ...]] = [
            (n, PLANT_SIZE), (n, N_INPUT), (n,), window, (n, layout.neighbours, layout.comm_size),
            (n, layout.sensed, N_SENSED), *believed, (n, N_DISTURBANCE), (n, self.memory_size),
        ]  # fmt: skip
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

    def _scratch(self) -> tuple[IntArray | None, TeamCall, IntArray]:
        """What `begin_row` takes for the estimator, all else that a decision takes, and its words."""
        if self._memory is None:
            N, data = self.horizon, self._data
            call = TeamCall(
                *self._constants,
                make_scratch(N, 1, len(data.normals), len(data.normal), 0),
                np.zeros((N_REFERENCE + 2) * (N + 1) + max(CONSENSUS_SCRATCH, 18 + COLLISION_SCRATCH)),
                make_workspace(N, len(data.normal), 1, len(data.R_rate) > 0),
            )
            which = np.zeros(1, np.int64) if self.options.reject_disturbance else None
            self._memory = which, call, pack(call)
        return self._memory

    def __getstate__(self) -> dict[str, Any]:
        """Everything but scratch memory, which is made again when needed."""
        return {**self.__dict__, "_memory": None}
