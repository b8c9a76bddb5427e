"""Feedback without prediction: SDRE, Eqs. (4.1) to (4.4) corrected, and its constant case, LQR at hover."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import N_INPUT, N_STATE, Array
from quad_envs.tasks import Task

from ..controller import TURNING_ROWS, FeedbackLaw, as_one_row, first_non_finite
from ..disturbance import feed_forward
from ..fallback import CLIPPED_SDRE, HOVER, NONE, limit_command, yield_yaw
from ..frame import add_rotor_lag, rotor_lag, set_references, set_state
from ..model import hover_pair, sdc_matrix, sdc_pair, zero_order_hold
from ..mpc.kernels import copy_vector
from ..mpc.options import chosen
from ..qp.linalg import copy
from ..qp.ocp import IntArray, OcpQp, no_rows
from ..qp.recursion import stage_gains
from ..qp.riccati import DARE_SCRATCH, dare, lqr_gain, solve_dare
from .options import LqrOptions, SdreOptions, StateFeedbackOptions

_MATRICES = DARE_SCRATCH + 6


@kernel
def sdre_gain(
    x: Array, alpha: float, c: Array, B_c: Array, Q: Array, R: Array, dt: float, K: Array, scratch: Array
) -> bool:
    """Gain of the pair at x from the solution P(x) of its Riccati equation; False where there is none.

    Args:
        x: State, (12,).
        alpha: Factorisation, see `model.sdc_matrix`.
        c: QuadrotorParams.coefficients().
        B_c: QuadrotorParams.input_matrix(), (12, 4).
        Q: (12, 12).
        R: (4, 4).
        dt: Control period, s.
        K: Result, (4, 12).
        scratch: Overwritten, (_MATRICES, 12, 12).
    """
    A_c, A, P = scratch[0], scratch[1], scratch[2]
    B = scratch[4].reshape(-1)[: N_STATE * N_INPUT].reshape(N_STATE, N_INPUT)
    D = scratch[5].reshape(-1)[: N_INPUT * N_INPUT].reshape(N_INPUT, N_INPUT)
    sdc_matrix(x, alpha, c, A_c)
    zero_order_hold(A_c, B_c, dt, A, B, scratch[6:])
    if solve_dare(A, B, Q, R, P, scratch[6:]) < 0:
        return False
    stage_gains(P, A, B, R, K, D, scratch[6:])
    return True


@kernel
def _decide_rows(
    plants: Array,
    windows: Array,
    lasts: Array,
    disturbances: Array,
    memories: Array,
    commands: Array,
    report: IntArray,
    alpha: float,
    heading: bool,
    attitude: bool,
    c: Array,
    B_c: Array,
    Q: Array,
    R: Array,
    K_0: Array,
    dt: float,
    force_max: Array,
    rate_step: float,
    lag: float,
    scratch: Array,
) -> int:
    """One decision per row; alpha < 0: the gain K_0 everywhere."""
    stages = min(windows.shape[1], TURNING_ROWS)
    bad = first_non_finite(plants, windows, lasts, disturbances, memories, stages)
    if bad >= 0:
        return bad
    rows = scratch[_MATRICES]
    x, trim, r = rows[0], rows[1], rows[2:3]
    offset, F = rows[3, :N_INPUT], rows[4, :N_INPUT]
    K = scratch[_MATRICES + 1, :N_INPUT]
    for j in range(plants.shape[0]):
        feed_forward(disturbances[j], plants[j, 8], c, force_max, offset, trim)
        set_state(plants[j], heading, x)
        add_rotor_lag(plants[j], offset, B_c, lag, x)
        set_references(plants[j], windows[j], trim, heading, attitude, alpha >= 0.0, stages, dt, r)
        level = NONE
        if alpha < 0.0 or not sdre_gain(x, alpha, c, B_c, Q, R, dt, K, scratch):
            level = NONE if alpha < 0.0 else CLIPPED_SDRE
            copy(K_0, K)
        for a in range(N_INPUT):
            F[a] = offset[a]
            for b in range(N_STATE):
                F[a] -= K[a, b] * (x[b] - r[0, b])
        if not math.isfinite(F[0] + F[1] + F[2] + F[3]):
            level = HOVER
            copy_vector(offset, F)
        if heading:
            yield_yaw(F, lasts[j], rate_step, force_max)
        limit_command(F, lasts[j], rate_step, force_max, commands[j])
        report[0, j], report[1, j] = level, 0
    return bad


class Sdre(FeedbackLaw):
    """du = -K(x) (x - r_0) with K(x) from the Riccati equation of the pair at x, clipped. No preview.

    Of the rows that follow in the window only the rate of a turning heading is read, where there are any.

    `fallback` is CLIPPED_SDRE where the equation has no solution and the gain at hover is taken instead.

    Args:
        task: What is known of the flight.
        options: See `SdreOptions`; None for the defaults.
        changes: Fields of it by name, which replace those of `options`.

    Raises:
        TypeError: If there is no such option.
        ValueError: If an option is not allowed.
    """

    horizon = 0
    options_type: ClassVar[type[StateFeedbackOptions]] = SdreOptions

    def __init__(self, task: Task, options: SdreOptions | None = None, **changes: Any) -> None:
        options = chosen(SdreOptions, options, changes)
        self._prepare(task, options, float(options.alpha))

    def _prepare(self, task: Task, options: StateFeedbackOptions, alpha: float) -> None:
        """Constants; alpha < 0 for the gain at hover."""
        self.options = options
        self.task = task
        self.alpha = alpha
        heading = options.frame == "heading"
        Q, R = task.weights.Q_matrix(), task.weights.R_matrix()
        K, _ = lqr_gain(*hover_pair(task.params, task.dt), Q, R)
        self._constants: tuple[Any, ...] = (
            alpha,
            heading,
            heading and options.velocity_reference == "attitude",
            task.params.coefficients(),
            task.params.input_matrix(),
            Q,
            R,
            K,
            float(task.dt),
            task.force_max,
            float(task.limits.rate * task.dt),
            rotor_lag(task),
        )
        self._scratch = np.empty((_MATRICES + 2, N_STATE, N_STATE))

    def _decide_rows(self, *arrays: Any) -> int:
        arguments: tuple[Any, ...] = (*arrays, *self._constants, self._scratch)
        return _decide_rows(*arguments)

    def problem(
        self,
        plant: ArrayLike,
        window: ArrayLike,
        last_command: ArrayLike,
        disturbance: ArrayLike,
        memory: ArrayLike,
    ) -> OcpQp:
        """The OCP-QP of horizon zero whose cost is this law's cost to go, for study; see `Mpc.problem`.

        Q_f is P(x) of the pair at x; a disturbance that is revealed moves r_0, but not the model.

        Raises:
            ValueError: If a shape is wrong, a number is not finite, or the pair at x has no P.
        """
        plant_row, rows, last, revealed, _ = as_one_row(
            plant, window, last_command, disturbance, memory, 1, 0
        )
        alpha, heading, attitude, c, B_c, Q, R, _, dt, force_max, rate_step, lag = self._constants
        offset, trim, x, r = np.zeros(N_INPUT), np.zeros(N_STATE), np.zeros(N_STATE), np.zeros((1, N_STATE))
        feed_forward(revealed, plant_row[8], c, force_max, offset, trim)
        set_state(plant_row, heading, x)
        add_rotor_lag(plant_row, offset, B_c, lag, x)
        stages = min(len(rows), TURNING_ROWS)
        set_references(plant_row, rows, trim, heading, attitude, alpha >= 0.0, stages, dt, r)
        params = self.task.params
        A, B = hover_pair(params, dt) if alpha < 0.0 else sdc_pair(x, params, dt, alpha)
        return OcpQp(
            A[None], B[None], np.zeros((0, N_STATE)), Q[None], R[None], dare(A, B, Q, R), True, x, r,
            -offset, force_max - offset, rate_step, last - offset, no_rows(),
        )  # fmt: skip


class Lqr(Sdre):
    """du = -K (x - r_0) with the constant gain of the hover model, clipped.

    Args:
        task: What is known of the flight.
        options: See `LqrOptions`; None for the defaults.
        changes: Fields of it by name, which replace those of `options`.

    Raises:
        TypeError: If there is no such option.
        ValueError: If an option is not allowed.
    """

    options_type = LqrOptions

    def __init__(self, task: Task, options: LqrOptions | None = None, **changes: Any) -> None:
        self._prepare(task, chosen(LqrOptions, options, changes), -1.0)
