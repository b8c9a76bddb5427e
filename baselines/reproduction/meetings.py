"""Vehicles that follow references of their own, straight through each other, and a controller that may not.

No environment gives every vehicle a reference, so the flights of chapter 5's collision avoidance, and of its
Eq. (5.4) as printed, are flown here: plant and controller are those of the suite.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from controllers.team.cooperative import CooperativeMpc
from controllers.team.situation import TeamSituation
from quad_envs.dynamics import simulate
from quad_envs.formations import start_positions
from quad_envs.limits import Limits
from quad_envs.observations.team import AgentLayout
from quad_envs.parameters import Array
from quad_envs.rotations import rotation_body_from_inertial
from quad_envs.tasks import TeamTask

DT = 0.05  # s
_HORIZON = 5
Preview = Callable[[int, Array, Array], tuple[Array, Array]]


def team_task(vehicles: int, horizon: int = _HORIZON) -> TeamTask:
    """A task in which nobody hears anybody and all sense all."""
    layout = AgentLayout(preview=horizon, neighbours=0, sensed=vehicles - 1)
    return TeamTask(layout=layout, limits=Limits(tilt=1.2), vehicles=vehicles)


def fly_led(controller: CooperativeMpc, start: Array, preview: Preview, steps: int) -> Array:
    """Fly teams whose vehicles all follow references of their own.

    Args:
        controller: Of one team.
        start: Positions at rest, (teams, N, 3), m.
        preview: Step, positions and inertial velocities (teams, N, 3) -> references of position and velocity
            for the stages 0..horizon, (teams, N, horizon + 1, 3) each.
        steps: Control periods.

    Returns:
        Positions, (steps + 1, teams, N, 3), m.
    """
    teams, n = start.shape[:2]
    task, rows = controller.task, teams * n
    plants = np.zeros((rows, 16))
    plants[:, :3], plants[:, 12:] = start.reshape(rows, 3), task.hover_force
    last, memory = plants[:, 12:].copy(), np.zeros((rows, controller.memory_size))
    leads, comm = np.ones(rows), np.zeros((rows, 0, task.layout.comm_size))
    history = [start]
    for k in range(steps):
        p = plants[:, :3].reshape(teams, n, 3)
        v = np.einsum("nba,nb->na", rotation_body_from_inertial(plants[:, 6:9]), plants[:, 3:6])
        r, w = preview(k, p, v.reshape(teams, n, 3))
        stages = r.shape[2]
        heading = np.broadcast_to([0.0, 1.0], (rows, stages, 2))
        window = np.concatenate([(r - p[:, :, None]).reshape(rows, stages, 3),
                                 w.reshape(rows, stages, 3), heading], axis=-1)  # fmt: skip
        sensed = sensed_rows(p, v.reshape(teams, n, 3), task).reshape(rows, -1, 7)
        decision = controller.decide(TeamSituation(plants, last, comm, sensed, leads, window), memory)
        last, memory = decision.command, decision.memory
        plants = simulate(plants, last, task.params)
        history.append(plants[:, :3].reshape(teams, n, 3).copy())
    return np.stack(history)


def sensed_rows(p: Array, v: Array, task: TeamTask) -> Array:
    """Sensed slots of whole teams, most urgent first: (teams, N, N - 1, 7)."""
    n = p.shape[1]
    others = np.array([[j for j in range(n) if j != i] for i in range(n)], dtype=np.int64).reshape(n, n - 1)
    d, w = p[:, others] - p[:, :, None], v[:, others] - v[:, :, None]
    gap = np.linalg.norm(d, axis=-1)
    closing = -(d * w).sum(axis=-1) / np.maximum(gap, 1e-12)
    time = np.maximum(gap - task.separation, 0.0) / np.maximum(closing, 1e-9)
    urgency = np.where(closing > 1e-9, time, 1e9 + gap)  # the receding ones come last, by distance
    near = gap < task.sensing_radius
    order = np.argsort(np.where(near, urgency, np.inf), axis=-1)
    rows = np.concatenate([near[..., None], np.where(near[..., None], np.concatenate([d, w], -1), 0.0)], -1)
    return np.asarray(np.take_along_axis(rows, order[..., None], axis=2))


def smallest_gap(positions: Array) -> Array:
    """Smallest distance of two vehicles of each team at control steps, (teams,), m."""
    n = positions.shape[2]
    pairs = [np.linalg.norm(positions[:, :, i] - positions[:, :, j], axis=-1).min(axis=0)
             for i in range(n) for j in range(i)]  # fmt: skip
    return np.asarray(np.min(pairs, axis=0))


class Meeting(NamedTuple):
    """Vehicles that changed places through the centre of a circle; one entry per run."""

    gap: Array  # (runs,), m
    end: Array  # (runs,), m, largest distance from the goals 3 s after the end of the references


def meet(
    options: dict[str, Any], speed: float, vehicles: int = 2, runs: int = 20, jitter: float = 0.05
) -> Meeting:
    """Vehicles on a circle of radius 2 m exchange places with whoever is opposite, at constant speed.

    Args:
        options: Of the controller; there is no governor.
        speed: Of each reference, m/s.
        vehicles: On the circle, an even number.
        runs: Seeds 0, 1, ...
        jitter: Standard deviation of the starts, m.
    """
    options = {"reach": np.inf, "speed": np.inf, "alpha": 0.5, "plan_tilt": 0.7, **options}
    horizon = options.get("horizon", _HORIZON)
    controller = CooperativeMpc(team_task(vehicles, horizon), **options)
    angle = np.arange(vehicles) * 2.0 * np.pi / vehicles
    ring = 2.0 * np.stack([np.cos(angle), np.sin(angle), np.zeros(vehicles)], axis=-1)
    noise = [np.random.default_rng(seed).normal(size=ring.shape) for seed in range(runs)]
    start = ring + jitter * np.array(noise)
    way = -ring - start
    length = np.linalg.norm(way, axis=-1, keepdims=True)
    direction = way / length

    def preview(k: int, p: Array, v: Array) -> tuple[Array, Array]:
        s = np.minimum(speed * DT * (k + np.arange(horizon + 1)), length)[..., None]
        ahead = direction[:, :, None]
        return start[:, :, None] + s * ahead, np.where(s < length[..., None], speed * ahead, 0.0)

    steps = round((float(length.max()) / speed + 3.0) / DT)
    flown = fly_led(controller, start, preview, steps)
    return Meeting(smallest_gap(flown), np.linalg.norm(flown[-1] + ring, axis=-1).max(axis=-1))


def literal_consensus(slots: Array, G: Array, seconds: float = 20.0) -> Array:
    """Eq. (5.4) to the letter: each sums over those who hear it, and divides by those whom it hears.

    On a tree nobody hears whom he informs, so that nothing is left of the sum but the own term, divided:
    every reference shrinks to the origin, stage by stage. There is no avoidance. The leader stays at 0.

    Args:
        slots: p_i*, (N, 3), m.
        G: G[i, j] > 0 where i hears j, (N, N).
        seconds: Of the flight.

    Returns:
        Positions, (T+1, N, 3), m.
    """
    n = len(slots)
    start = start_positions("sorted", slots, np.random.default_rng(0))
    controller = CooperativeMpc(team_task(n), avoidance="none", reach=np.inf, speed=np.inf, alpha=0.5)
    out = (G.T * G) * ~np.eye(n, dtype=bool)  # (i, j) in E, and printed G_ij = 1 only if (j, i) is, too
    total = G.sum(axis=1)[:, None]
    delta = slots[:, None] - slots

    def preview(k: int, p: Array, v: Array) -> tuple[Array, Array]:
        r, w = [p[0]], [v[0]]
        for _ in range(_HORIZON):
            r.append((r[-1] + np.einsum("ij,ijc->ic", out, p[0] + delta)) / total)
            w.append((w[-1] + out @ v[0]) / total)
        for rows in (r, w):
            for row in rows[1:]:
                row[0] = 0.0
        return np.stack(r, axis=1)[None], np.stack(w, axis=1)[None]

    return fly_led(controller, start[None], preview, round(seconds / DT))[:, 0]
