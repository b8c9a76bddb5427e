"""Linear MPC: the hover linearisation of chapter 3, Eqs. (3.1) to (3.14)."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from quad_envs._numba import kernel
from quad_envs.parameters import ATTITUDE, Array
from quad_envs.tasks import Task

from ..controller import first_non_finite
from ..model import hover_pair
from ..qp.ocp import IntArray
from ..qp.structured import ITERATION_LIMIT, Workspace
from .kernels import (
    MpcData,
    Scratch,
    begin_row,
    carve,
    end_row,
    hold_trim,
    left_model,
    solve_within_model,
)
from .mpc import (
    PLAN_TILT,
    SOFT_WEIGHT,
    Frame,
    Mpc,
    MpcOptions,
    Problem,
    SolverName,
    default_rate,
    default_tilt,
    require_choice,
)

LevelReference = Literal["level", "heading", "attitude"]


@kernel
def _decide_rows(
    plants: Array,
    windows: Array,
    lasts: Array,
    disturbances: Array,
    memories: Array,
    commands: Array,
    kept: Array,
    report: IntArray,
    which: IntArray | None,
    A: Array,
    B: Array,
    stationary: bool,
    data: MpcData,
    buffer: Array,
    ws: Workspace,
) -> int:
    """One decision per row; -1, or the code of the first argument that is not finite."""
    N = ws.u.shape[0]
    bad = first_non_finite(plants, windows, lasts, disturbances, memories, N + 1)
    if bad >= 0:
        return bad
    H, K = data.normals.shape[0], data.normal.shape[0]
    s = carve(buffer, N, 1, H, K, 0)
    for j in range(plants.shape[0]):
        begin_row(plants[j], windows[j], lasts[j], disturbances[j], memories[j], which, data, s)
        hold_trim(A, s.trim, s.c)
        has_plan = memories[j, 0] > 0.0
        level, iterations = solve_within_model(A, B, data.Q, data.P, stationary, s.r, has_plan, data, s, ws)
        end_row(level, plants[j], lasts[j], disturbances[j], memories[j], data, s, ws.u, commands[j], kept[j])
        left = left_model(level, s.x_0, ws.x, s.points, data.model_tilt, data.first_angle)
        report[0, j], report[1, j], report[2, j] = level, iterations, left
    return bad


class LinearMPC(Mpc):
    """MPC on the hover linearisation, with the solution of its Riccati equation as terminal weight.

    Deviation:
        With frame "heading" (default) the problem is posed at the present position and heading, so that yaw
        may be anything; "hover" is the dissertation's: the model belongs to psi = 0, v_ref stands in the slot
        of V_B in inertial axes, and the yaw error is not wrapped.

    Args:
        task: What is known of the flight.
        horizon: N, samples.
        solver: "structured" (exact, one compiled call) or "osqp".
        frame: "heading" or "hover".
        velocity_reference: What is compared with v_ref in frame "heading". "level": the velocity, turned by
            the present attitude into the level axes of v_ref, which is the rate of the position, too.
            "attitude": V_B, with v_ref turned into its axes; "heading": V_B, with v_ref as it is. Both move
            positions by V_B: the longer the horizon, the more that costs.
        soft_weight: Exact penalty per unit of a state row; inf makes the rows hard.
        margin: What the plan keeps from each state limit, in its SI unit: cover for the unmodelled rotor lag.
        reject_disturbance: Whether to estimate and cancel disturbances that are not revealed.
        estimator_gain: Share of each new residual in the estimate, in (0, 1]; "auto" takes it from
            `task.sensor_noise`, 0.5 without any.
        iteration_limit: Largest number of active-set steps of a solve; 0 for one that grows with it.
        Q: Weight of the state, a number, the diagonal (12,) or a matrix; the reward's by default.
        R: Weight of the rotor forces, a number, the diagonal (4,) or a matrix; the reward's by default.
        plan_tilt: Largest roll and pitch of a plan, rad, besides the task's limit: where the model holds.
            None stands for 0.8 in frame "heading" and no such limit in frame "hover".
        plan_rate: Largest roll and pitch rate of a plan, rad/s, half of it in yaw, likewise; by default
            0.3 rad a sample.
        terminal: Factor of P, the weight of x_N, or a matrix (12, 12) in its place.
        R_rate: Weight of the changes of the forces from sample to sample, the first one against the command
            applied before; a number, the diagonal (4,) or a matrix. None: changes cost nothing.

    Raises:
        ValueError: If an option is not allowed.
    """

    def __init__(
        self,
        task: Task,
        horizon: int = 25,
        *,
        solver: SolverName = "structured",
        frame: Frame = "heading",
        velocity_reference: LevelReference = "level",
        soft_weight: float = SOFT_WEIGHT,
        margin: float = 0.02,
        reject_disturbance: bool = False,
        estimator_gain: float | Literal["auto"] = "auto",
        iteration_limit: int = ITERATION_LIMIT,
        Q: ArrayLike | None = None,
        R: ArrayLike | None = None,
        plan_tilt: float | None = None,
        plan_rate: float | None = None,
        terminal: ArrayLike = 1.0,
        R_rate: ArrayLike | None = None,
    ) -> None:
        require_choice("velocity_reference", velocity_reference, LevelReference)
        options = MpcOptions(
            solver,
            frame,
            velocity_reference,
            soft_weight,
            margin,
            reject_disturbance,
            estimator_gain,
            iteration_limit,
            Q,
            R,
            default_tilt(plan_tilt, PLAN_TILT, frame),
            default_rate(plan_rate, task.dt, frame),
            terminal,
            R_rate,
        )
        super().__init__(task, horizon, options, pairs=1, guess=False)
        self._data = self._data._replace(first_angle=ATTITUDE.start + 2)
        A, B = hover_pair(task.params, task.dt)
        self._A, self._B = np.ascontiguousarray(A[None]), np.ascontiguousarray(B[None])

    def _decide_rows(self, *arrays: Any) -> int:
        which, buffer, ws = self._scratch()
        arguments: tuple[Any, ...] = (
            *arrays,
            which,
            self._A,
            self._B,
            not self._own_terminal,
            self._data,
            buffer,
            ws,
        )
        return _decide_rows(*arguments)

    def _pose(self, number: int, memory: Array, s: Scratch, ws: Workspace) -> Problem:
        hold_trim(self._A, s.trim, s.c)
        return Problem(self._A, self._B, self._data.Q, self._data.P, not self._own_terminal, s.r)
