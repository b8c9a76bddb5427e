"""Linear MPC: the hover linearisation of chapter 3, Eqs. (3.1) to (3.14)."""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import numpy as np

from quad_envs.compilation.decorators import entry_of, threaded_kernel
from quad_envs.compilation.packed import unpacker
from quad_envs.parameters import ATTITUDE, Array
from quad_envs.tasks import Task

from ..controller import first_non_finite
from ..model import hover_pair
from ..qp.ocp import IntArray
from ..qp.workspace import Workspace
from .equilibrium import hold_equilibrium
from .kernels import (
    MpcData,
    Scratch,
    begin_row,
    end_row,
    left_model,
)
from .linear_score import begin_guess, refuses_plan, solve_for_objective, weigh_about_guess
from .mpc import Mpc, Problem
from .options import LmpcOptions, chosen
from .score import COST_FLOOR


class _Call(NamedTuple):
    """What a decision takes beside its rows."""

    A: Annotated[Array, "1 or N, 12, 12"]
    B: Annotated[Array, "1 or N, 12, 4"]
    stationary: bool  # whether data.P solves the Riccati equation of the pair
    floor: float  # of the stage weights, see `score.weigh_stages`
    data: MpcData
    s: Scratch
    ws: Workspace


_unpack = unpacker(_Call)


@threaded_kernel
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
    words: IntArray,
) -> int:
    """One decision per row; -1, or the code of the first argument that is not finite."""
    A, B, stationary, floor, data, s, ws = _unpack(words)
    N = ws.u.shape[0]
    bad = first_non_finite(plants, windows, lasts, disturbances, memories, N + 1)
    if bad >= 0:
        return bad
    for j in range(plants.shape[0]):
        begin_row(plants[j], windows[j], lasts[j], disturbances[j], memories[j], which, data, s)
        hold_equilibrium(A, B, data.fade < 1.0, s.stages, s.c)
        begin_guess(floor, memories[j], s)
        has_plan = memories[j, 0] > 0.0
        level, iterations = solve_for_objective(A, B, data.P, stationary, has_plan, data, s, ws)
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
        options: See `LmpcOptions`; None for the defaults.
        changes: Fields of it, such as horizon=10, which replace those of `options`.

    Raises:
        TypeError: If there is no such option.
        ValueError: If an option is not allowed.
    """

    options_type = LmpcOptions
    options: LmpcOptions
    _kernel = staticmethod(entry_of(_decide_rows))

    def __init__(self, task: Task, options: LmpcOptions | None = None, **changes: Any) -> None:
        options = chosen(LmpcOptions, options, changes)
        super().__init__(task, options, options.velocity_reference, many_pairs=False, guess=False)
        self._data = self._data._replace(first_angle=ATTITUDE.start + 2)
        A, B = hover_pair(task.params, task.dt)
        self._A, self._B = (np.repeat(matrix[None], self._pairs, axis=0) for matrix in (A, B))
        self._stationary = not options.own_terminal and self._pairs == 1

    def _call(self, s: Scratch, ws: Workspace) -> _Call:
        return _Call(self._A, self._B, self._stationary, self._floor, self._data, s, ws)

    def _pose(self, number: int, memory: Array, s: Scratch, ws: Workspace) -> Problem:
        data = self._data
        if number == 0:
            hold_equilibrium(self._A, self._B, self._data.fade < 1.0, s.stages, s.c)
            begin_guess(self._floor, memory, s)
        if s.floor[0] < COST_FLOOR:
            weigh_about_guess(self._A, self._B, data.P, data, s)
            return Problem(self._A, self._B, s.Q, s.R, s.P, False, s.r)
        return Problem(self._A, self._B, data.Q, data.R, data.P, self._stationary, s.r)

    def _accept(self, number: int, s: Scratch, ws: Workspace) -> bool:
        return not (s.floor[0] < COST_FLOOR and refuses_plan(self._data, s, ws.x, ws.u))
