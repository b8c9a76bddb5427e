"""What all MPCs share in Python: constants, memory, and the batched decision."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quad_envs.compilation.packed import pack
from quad_envs.compilation.threads import Threads
from quad_envs.limits import Limits
from quad_envs.parameters import ATTITUDE, N_INPUT, N_STATE, POSITION, RATES, Array
from quad_envs.tasks import BaseTask, Task

from ..controller import (
    Decision,
    as_one_row,
    as_rows,
    code_of_row,
    first_non_finite,
    raise_non_finite,
)
from ..disturbance import ESTIMATOR_SIZE, N_DISTURBANCE
from ..fallback import CLIPPED_SDRE, HOVER, NONE, PREVIOUS_PLAN, RELAXED, RELAXED_WEIGHT
from ..frame import rotor_lag
from ..model import hover_pair
from ..qp import Backend, Status, StructuredSolver
from ..qp.ocp import IntArray, OcpQp, StateRows, concatenate_rows, no_rows, output_rows
from ..qp.riccati import dare
from ..qp.workspace import Workspace, make_workspace
from .estimator_gain import estimator_gains
from .kernels import (
    MEMORY_STAGE,
    MpcData,
    Scratch,
    begin_row,
    end_row,
    leaves_bound,
    left_model,
    make_scratch,
)
from .options import PLAN_TILT, MpcOptions, VelocityAxes
from .score import COST_FLOOR
from .weights import change_weight, require_turnable, terminal_weight, weight_matrix

PLAN_WEIGHT = 1e4  # per rad, rad/s: of rows that keep a plan in its model; 1e3 gives way to heavy positions
YAW_SHARE = 0.5  # of it for yaw: the axes of the problem stay where the heading is now


class _Memory(NamedTuple):
    """What a thread decides with."""

    which: IntArray | None  # what `begin_row` takes for the estimator
    s: Scratch
    ws: Workspace
    call: Any  # what lies behind the words
    words: IntArray  # all that a kernel takes beside its rows


class Problem(NamedTuple):
    """What a flavour contributes to the OCP-QP of one sample."""

    A: Array  # (1 or N, 12, 12)
    B: Array  # (1 or N, 12, 4)
    Q: Array  # (1 or N, 12, 12)
    R: Array  # (1 or N, 4, 4)
    Q_f: Array  # (12, 12)
    stationary: bool
    r: Array  # (N+1, 12)


def limit_rows(limits: Limits, margin: float, weight: float, horizon: int) -> tuple[StateRows, IntArray]:
    """State rows of the limits, less a margin, at stages 1..N; the position axis of each output (-1: none).

    Outputs: the bounded entries of the state, those of the position last.
    """
    lower, upper = limits.state_box()
    order = np.r_[POSITION.stop : N_STATE, POSITION]
    outputs = order[np.isfinite(lower[order]) | np.isfinite(upper[order])]
    lower, upper = lower + margin, upper - margin
    if (lower > upper).any():
        raise ValueError(
            f"margin {margin!r} leaves nothing between the limits of the task; choose a smaller one"
        )
    rows = output_rows(np.eye(N_STATE)[outputs], lower[outputs], upper[outputs], weight, horizon)
    return rows, np.where(outputs < POSITION.stop, outputs, -1).astype(np.int64)


def plan_bound(options: MpcOptions, task: BaseTask) -> Array:
    """Largest magnitude of each state of a plan where its model holds, (12,); inf for none of its own."""
    bound = np.full(N_STATE, math.inf)
    bound[ATTITUDE][:2] = options.largest_tilt()
    bound[RATES] = options.largest_rate(task.dt) * np.array([1.0, 1.0, YAW_SHARE])
    lower, upper = task.limits.state_box()
    return np.where((bound < upper) | (bound < -lower), bound, math.inf)


def plan_rows(bound: Array, horizon: int) -> StateRows:
    """Rows that keep a plan where its model holds.

    They are soft and stiff: `solve_within_model` takes them in only when a plan needs them.
    """
    bounded = np.isfinite(bound)
    if not bounded.any():
        return no_rows()
    return output_rows(np.eye(N_STATE)[bounded], -bound[bounded], bound[bounded], PLAN_WEIGHT, horizon)


def estimator_gain(task: BaseTask, options: MpcOptions) -> Array:
    """Gain of each channel of the disturbance estimator, (6,); zeros without one."""
    if not options.reject_disturbance:
        return np.zeros(N_DISTURBANCE)
    if options.estimator_gain == "auto":
        return np.minimum(1.0, options.estimator_gain_scale * estimator_gains(task))
    return np.full(N_DISTURBANCE, float(options.estimator_gain))


def mpc_data(task: BaseTask, options: MpcOptions, axes: VelocityAxes) -> MpcData:
    """The constants of a controller that compares velocities with v_ref in these axes, in frame "heading"."""
    params, horizon = task.params, int(options.horizon)
    heading = options.frame == "heading"
    Q = weight_matrix("Q", task.weights.Q if options.Q is None else options.Q, N_STATE, definite=False)
    R = weight_matrix("R", task.weights.R if options.R is None else options.R, N_INPUT, definite=True)
    P = terminal_weight(options.terminal, dare(*hover_pair(params, task.dt), Q, R))
    if heading:
        require_turnable(Q)
    own, axis = limit_rows(task.limits, options.margin, options.soft_weight, horizon)
    bound = plan_bound(options, task)
    planned = plan_rows(bound, horizon)
    rows = concatenate_rows(own, planned)
    return MpcData(
        coefficients=params.coefficients(),
        B_c=params.input_matrix(),
        Q=np.ascontiguousarray(Q[None]),
        R=np.ascontiguousarray(R[None]),
        R_rate=change_weight(options.R_rate),
        P=P,
        normals=rows.normals,
        axis=np.r_[axis, np.full(len(planned.normals), -1, np.int64)],
        normal=rows.normal,
        stage=rows.stage,
        lower=rows.lower.copy(),  # without rows these are read-only views, another type to numba
        upper=rows.upper.copy(),
        weight=rows.weight.copy(),
        dt=float(task.dt),
        force_max=task.force_max,
        rate_step=float(task.limits.rate * task.dt),
        lag=rotor_lag(task),
        gain=estimator_gain(task, options),
        fade=math.exp(-task.dt / options.disturbance_correlation_time),
        heading=heading,
        attitude=heading and axes in ("attitude", "present"),
        level=heading and axes == "level",
        present=heading and axes == "present",
        kinematics=False,
        iteration_limit=int(options.iteration_limit),
        plan_bound=bound,
        own_outputs=len(own.normals),
        own_rows=len(own.normal),
        model_tilt=PLAN_TILT,
        first_angle=ATTITUDE.start,
    )


class Mpc(ABC):
    """A flavour of MPC: makes the pairs of the OCP-QP, and inherits the rest.

    Not for use by several threads at once: the scratch memory is shared. It starts those of `options.threads`
    itself.
    """

    options: MpcOptions
    _kernel: Callable[..., int]  # the whole batch in one compiled call

    def __init__(
        self, task: Task, options: MpcOptions, axes: VelocityAxes, *, many_pairs: bool, guess: bool
    ) -> None:
        self.task = task
        self.horizon = int(options.horizon)
        self.options = options
        self._data = mpc_data(task, options, axes)
        self._floor = COST_FLOOR  # of the stage weights, see `score.weigh_stages`
        if options.objective == "score":
            self._floor = options.least_weight(task.limits)
        weighs = self._floor < COST_FLOOR
        limited = self._data.own_rows > 0 or math.isfinite(self._data.rate_step)
        if weighs and (limited or not guess):
            # A plan that flies to its limits has to know how late the rotors are, and so has a linear model,
            # which makes up for no other error by iterating.
            self._data = self._data._replace(lag=1.0 / task.params.rotor_rate)
        spread = weighs and len(self._data.R_rate) > 0  # as R_rate beside an R of each stage
        self._first_pairs = self.horizon if spread else 1  # of a first pass on one model
        self._pairs = self.horizon if many_pairs else self._first_pairs
        self._guess_stages = self.horizon if guess or weighs else 0
        self._keep_from = (
            1 + MEMORY_STAGE * self.horizon + (ESTIMATOR_SIZE if options.reject_disturbance else 0)
        )
        self.memory_size = self._keep_from + (1 + N_STATE * (self.horizon + 1) if guess else 0)
        self._memories: list[_Memory] = []  # of each thread
        self._threads = Threads(options.threads)
        self._backend: Backend | None = None

    def decide(
        self,
        plant: ArrayLike,
        window: ArrayLike,
        last_command: ArrayLike,
        disturbance: ArrayLike,
        memory: ArrayLike,
    ) -> Decision:
        """One command per vehicle; see `Controller.decide`."""
        arrays = as_rows(plant, window, last_command, disturbance, memory, self.horizon + 1, self.memory_size)
        n = arrays[0].shape[0]
        command, kept, report = (
            np.empty((n, N_INPUT)),
            np.empty((n, self.memory_size)),
            np.empty((3, n), np.int64),
        )
        if self.options.solver == "structured":
            bad = self._decide_rows(*arrays, command, kept, report)
        else:
            bad = self._decide_by_backend(*arrays, command, kept, report)
        if bad >= 0:
            raise_non_finite(bad)
        return Decision(command, kept, *report)

    def problem(
        self,
        plant: ArrayLike,
        window: ArrayLike,
        last_command: ArrayLike,
        disturbance: ArrayLike,
        memory: ArrayLike,
    ) -> OcpQp:
        """The OCP-QP of the first pass of one vehicle's decision, for study; arguments of `decide`, one row.

        It lives in the frame of the problem (`MpcOptions.frame`), and its inputs are u = F - F_trim with
        F_trim = -lower.

        Raises:
            ValueError: If a shape is wrong or a number is not finite.
        """
        row = as_one_row(plant, window, last_command, disturbance, memory, self.horizon + 1, self.memory_size)
        which, s, ws, *_ = self._scratch()
        begin_row(*row, which, self._data, s)
        qp = self._as_qp(self._pose(0, row[-1], s, ws), s, *self._row_sets()[0])
        rows = StateRows._make(np.array(value) for value in qp.rows)
        qp = qp._replace(rows=rows)
        return OcpQp._make(np.array(v) if isinstance(v, np.ndarray) else v for v in qp)

    def _decide_rows(self, *arrays: Any) -> int:
        """All rows, shared by the threads; -1, or the code of the first argument that is not finite."""
        report, rows = arrays[-1], len(arrays[0])
        if self._threads.count == 1 or rows == 1:
            memory = self._scratch()
            return self._kernel(*arrays, memory.which, memory.words)
        memories = [self._scratch(thread) for thread in range(min(self._threads.count, rows))]

        def work(thread: int, begin: int, end: int) -> int:
            memory, found = memories[thread], np.empty((len(report), end - begin), np.int64)
            share = (array[begin:end] for array in arrays[:-1])
            code = self._kernel(*share, found, memory.which, memory.words)
            report[:, begin:end] = found
            return code if code < 0 else code + code_of_row(begin)

        return self._threads.run(rows, work)

    @abstractmethod
    def _call(self, s: Scratch, ws: Workspace) -> Any:
        """What the kernel takes beside its rows, a NamedTuple for `pack`."""

    @abstractmethod
    def _pose(self, number: int, memory: Array, s: Scratch, ws: Workspace) -> Problem:
        """The problem of one pass, given the plan of the pass before in ws."""

    def _accept(self, number: int, s: Scratch, ws: Workspace) -> bool:
        """Take the plan in ws after pass `number`; whether it is the last one."""
        return True

    def _keep(self, level: int, kept: Array, s: Scratch) -> None:  # noqa: B027  most flavours keep nothing
        """Write what the flavour remembers."""

    def _scratch(self, thread: int = 0) -> _Memory:
        """Scratch memory of a thread, made at need."""
        while len(self._memories) <= thread:
            which = np.zeros(1, np.int64) if self.options.reject_disturbance else None
            s = make_scratch(self.horizon, *self._sizes())
            rows, weighs_changes = len(self._data.normal), len(self._data.R_rate) > 0
            ws = make_workspace(self.horizon, rows, self._pairs, weighs_changes)
            call = self._call(s, ws)
            self._memories.append(_Memory(which, s, ws, call, pack(call)))
        return self._memories[thread]

    def _sizes(self) -> tuple[int, int, int, int]:
        """Pairs, outputs, rows, stages of the guess."""
        return self._pairs, len(self._data.normals), len(self._data.normal), self._guess_stages

    def _decide_by_backend(self, *arrays: Any) -> int:
        """The same kernels row by row, with a solver behind the common interface."""
        plants, windows, lasts, disturbances, memories, commands, kept, report = arrays
        bad = first_non_finite(plants, windows, lasts, disturbances, memories, self.horizon + 1)
        if bad >= 0:
            return bad
        which, s, ws, *_ = self._scratch()
        for j in range(len(plants)):
            row = plants[j], windows[j], lasts[j], disturbances[j], memories[j]
            begin_row(*row, which, self._data, s)
            level, iterations, number, done = NONE, 0, 0, False
            while not done:
                problem = self._pose(number, memories[j], s, ws)
                level, count = self._solve(problem, bool(memories[j, 0] > 0.0), level, s, ws)
                iterations += count
                done = level > RELAXED or self._accept(number, s, ws)
                number += 1
            end_row(
                level,
                plants[j],
                lasts[j],
                disturbances[j],
                memories[j],
                self._data,
                s,
                ws.u,
                commands[j],
                kept[j],
            )
            self._keep(level, kept[j], s)
            points = s.points[: len(problem.A)]
            tilt, first = self._data.model_tilt, self._data.first_angle
            report[:, j] = level, iterations, left_model(level, s.x_0, ws.x, points, tilt, first)
        return -1

    def _solve(
        self, problem: Problem, has_plan: bool, level: int, s: Scratch, ws: Workspace
    ) -> tuple[int, int]:
        """The fallback order of `solve_row` with any backend."""
        if self._backend is None:
            from ..qp.osqp import OsqpSolver

            self._backend = OsqpSolver(persistent=False)  # rows must not depend on each other
        iterations = 0
        for which in self._row_sets():
            qp = self._as_qp(problem, s, *which)
            solution = self._backend.solve(qp)
            iterations += solution.iterations
            if solution.status == Status.INFEASIBLE and level == NONE:
                np.minimum(s.weight, RELAXED_WEIGHT, out=s.weight)
                level = RELAXED
                solution = self._backend.solve(qp)
                iterations += solution.iterations
            if solution.status != Status.OPTIMAL or not leaves_bound(solution.x, self._data.plan_bound):
                break
        if solution.status != Status.OPTIMAL and has_plan:
            return PREVIOUS_PLAN, iterations
        if solution.status != Status.OPTIMAL:
            level = CLIPPED_SDRE
            s.lower[:], s.upper[:] = -math.inf, math.inf
            solution = StructuredSolver().solve(qp._replace(rate_step=math.inf, rows=no_rows()))
        if solution.status != Status.OPTIMAL:
            return HOVER, iterations
        ws.u[:], ws.x[:] = solution.u, solution.x
        return level, iterations

    def _row_sets(self) -> tuple[tuple[int, int], ...]:
        """Outputs and rows of the task's limits, then with those of the plan's own where it has some."""
        own = self._data.own_outputs, self._data.own_rows
        every = len(self._data.normals), len(self._data.normal)
        return (own,) if own == every else (own, every)

    def _as_qp(self, problem: Problem, s: Scratch, H: int, K: int) -> OcpQp:
        """The problem of one pass as data, with H outputs and K rows; views of the scratch memory."""
        data = self._data
        rows = StateRows(
            s.normals[:H], data.normal[:K], data.stage[:K], s.row_lower[:K], s.row_upper[:K], s.weight[:K]
        )
        return OcpQp(
            problem.A, problem.B, s.c, problem.Q, problem.R, problem.Q_f, problem.stationary, s.x_0,
            problem.r, s.lower, s.upper, data.rate_step, s.u_last, rows,
            data.R_rate if len(data.R_rate) else None,
        )  # fmt: skip

    def __getstate__(self) -> dict[str, Any]:
        """Everything but scratch memory and the backend's, which are made again when needed."""
        return {**self.__dict__, "_memories": [], "_backend": None}
