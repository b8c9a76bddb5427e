"""Closed loops for the controller tests: windows of the identified tasks, and a flight with its metrics."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from controllers import ExactNmpc, LinearMPC, SdcNmpc
from quad_envs.compilation.decorators import kernel
from quad_envs.dynamics import arrive, disturbed_substep, load_air, place_vehicle, set_out
from quad_envs.lanes import COMMAND, LANES, N_FLIGHT, PLANT
from quad_envs.parameters import Limits
from quad_envs.rotations import rotation_body_from_inertial, wrap_angle
from quad_envs.tasks import Task

DT = 0.05
SUBSTEPS = 5
TASK = Task()
WEAK = Task(limits=Limits(kappa=0.3125))  # 2.45 N
HOVER = TASK.hover_force
FLAVOURS = {  # of MPC
    "lmpc": LinearMPC,
    "sdc": SdcNmpc,
    "sdc-sdre": lambda task, **options: SdcNmpc(task, terminal_weight="sdre", **options),
    "sdc-pass": lambda task, **options: SdcNmpc(task, relinearisations=1, **options),
    "rti": ExactNmpc,
}


def helix(t):
    R, w, v_z = 6.0, 0.4, 3.0
    p = np.stack([R * np.sin(w * t), R * (1.0 - np.cos(w * t)), v_z * t], axis=-1)
    v = np.stack([R * w * np.cos(w * t), R * w * np.sin(w * t), np.full_like(t, v_z)], axis=-1)
    return p, v


def spiral(t):
    R, w, c = 4.5, 0.25, 0.3
    cw, sw, cc, sc = np.cos(w * t), np.sin(w * t), np.cos(c * t), np.sin(c * t)
    p = R * np.stack([cw * cc, sw * cc, sc], axis=-1)
    v = R * np.stack([-w * sw * cc - c * cw * sc, w * cw * cc - c * sw * sc, c * cc], axis=-1)
    return p, v


def lines(t):
    slope, turn = np.array([1.25, 1.25, 1.0]), 5.0
    out = (t < turn - 1e-9)[..., None]
    t = t[..., None]
    return np.where(out, t, 2.0 * turn - t) * slope, np.where(out, slope, -slope)


def rest(t):
    return np.zeros((*t.shape, 3)), np.zeros((*t.shape, 3))


def jumps(t):
    """Set-points every 2 s, previewed."""
    points = np.array([[0.0, 0.0, 0.0], [3.0, 3.0, 3.0], [3.0, -3.0, 1.0], [-2.0, 1.0, -3.0]])
    return points[(np.floor(t / 2.0 + 1e-9)).astype(int) % 4], np.zeros((*t.shape, 3))


def window(path, k, horizon, climb=False, psi=0.0):
    """Reference rows k .. k + horizon, (horizon + 1, 8)."""
    p, v = path(DT * (k + np.arange(horizon + 1)))
    if climb:
        p, v = p * [1.0, 1.0, -1.0], v * [1.0, 1.0, -1.0]
    heading = np.broadcast_to([np.sin(psi), np.cos(psi)], (horizon + 1, 2))
    return np.concatenate([p, v, heading], axis=-1)


def at_rest(p=(0.0, 0.0, 0.0), Theta=(0.0, 0.0, 0.0), force=HOVER):
    return np.r_[np.array(p, dtype=float) * np.ones(3), np.zeros(3), Theta, np.zeros(3), np.full(4, force)]


class Flight(NamedTuple):
    rms: float  # m
    effort: float  # N^2
    cost: float  # sum of |x - r|^2 + |du|^2, v_ref beside V_B as it stands
    exact_cost: float  # the same with the residual of the reward
    plants: np.ndarray  # (steps + 1, 16)
    commands: np.ndarray  # (steps, 4)
    fallbacks: np.ndarray  # (steps,)


@kernel
def _hold(w, c, force_max, table, h):
    place_vehicle(w, np.int64(0), c, force_max, h)
    set_out(w)
    for s in range(SUBSTEPS):
        load_air(w, np.int64(0), table, s)
        disturbed_substep(w, h)
    arrive(w)


def held_under(plant, command, task, disturbance, k):
    """One control period under a disturbance, a function of time."""
    table = np.array([disturbance(DT * (k + i / (2 * SUBSTEPS))) for i in range(2 * SUBSTEPS + 1)])
    w = np.zeros(N_FLIGHT)
    w[PLANT : PLANT + 16 * LANES : LANES], w[COMMAND : COMMAND + 4 * LANES : LANES] = plant, command
    _hold(w, task.params.coefficients(), task.force_max, table, task.dt / SUBSTEPS)
    return w[PLANT : PLANT + 16 * LANES : LANES].copy()


def calm(t):
    return np.zeros(6)


def fly(
    controller, path=rest, start=(0.0, 0.0, 0.0), seconds=10.0, climb=False, disturbance=calm, reveal=False
):
    """Fly one vehicle from rest at `start` and measure as section 8 of the chapter does."""
    task = controller.task
    plant, last = at_rest(start), np.full(4, task.hover_force)
    memory = np.zeros((1, controller.memory_size))
    plants, commands, fallbacks = [plant], [], []
    squares = np.zeros(4)
    for k in range(round(seconds / DT)):
        rows = window(path, k, controller.horizon, climb)
        known = disturbance(DT * (k + 0.5)) if reveal else np.zeros(6)
        decision = controller.decide(plant[None], rows[None], last[None], known[None], memory)
        memory, last = decision.memory, decision.command[0]
        error = plant[:12] - np.r_[rows[0, :6], np.zeros(6)]
        residual = error.copy()
        residual[3:6] = plant[3:6] - rotation_body_from_inertial(plant[6:9]) @ rows[0, 3:6]
        residual[8] = wrap_angle(residual[8])
        du = np.sum((last - task.hover_force) ** 2)
        squares += [error[:3] @ error[:3], du, error @ error + du, residual @ residual + du]
        plant = held_under(plant, last, task, disturbance, k)
        plants.append(plant)
        commands.append(last)
        fallbacks.append(decision.fallback[0])
    n = len(commands)
    mean = np.sqrt(squares[0] / n), squares[1] / n
    return Flight(*mean, squares[2], squares[3], np.array(plants), np.array(commands), np.array(fallbacks))


def decide_once(controller, plant, rows=None, last=None, disturbance=None, memory=None):
    """One decision for one vehicle; by default at set-point 0 with the last command at hover."""
    rows = window(rest, 0, controller.horizon) if rows is None else rows
    last = np.full(4, controller.task.hover_force) if last is None else last
    disturbance = np.zeros(6) if disturbance is None else disturbance
    memory = np.zeros(controller.memory_size) if memory is None else memory
    return controller.decide(plant[None], rows[None], last[None], disturbance[None], memory[None])


def plan_of(decision, horizon):
    """The planned inputs F - u_T that an MPC keeps in its memory, (N, 4)."""
    return decision.memory[0, 1 : 1 + 4 * horizon].reshape(horizon, 4) - HOVER
