"""Closed loops of a team for the controller tests, with every observation made here from the true states.

The rows are those of `quad_envs.observations.team`: `messages` the comm slots (delay 0, a fixed slot per
in-neighbour), `sensed_rows` the sensed slots (within the radius, most urgent first). No environment takes
part.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from controllers import TeamSituation
from quad_envs.dynamics import simulate
from quad_envs.formations import make_formation, start_positions
from quad_envs.graphs import make_graph, toward_leader
from quad_envs.observations.team import AgentLayout
from quad_envs.parameters import Limits
from quad_envs.rotations import rotation_body_from_inertial
from quad_envs.tasks import TeamTask

DT = 0.05
LIMITS = Limits(tilt=1.2)
RNG = np.random.default_rng(0)
TRIANGLE, HEXAGON = make_formation("triangle", 6), make_formation("hexagon", 6)
WEAK_TRIANGLE, WEAK_HEXAGON = make_graph("weak", "triangle", 6), make_graph("weak", "hexagon", 6)
STRONG_TRIANGLE = toward_leader(make_graph("strong", "triangle", 6))
LINE_START, SORTED_START = start_positions("line", TRIANGLE, RNG), start_positions("sorted", TRIANGLE, RNG)


def still(t):
    return np.zeros((*t.shape, 3)), np.zeros((*t.shape, 3))


def line(t, velocity=(0.5, 0.0, -0.2)):
    return t[..., None] * np.array(velocity), np.broadcast_to(velocity, (*t.shape, 3))


def helix(t):
    w = 0.3
    p = np.stack([2 * np.sin(w * t), 2 * (1 - np.cos(w * t)), -0.1 * t], axis=-1)
    v = np.stack([2 * w * np.cos(w * t), 2 * w * np.sin(w * t), np.full_like(t, -0.1)], axis=-1)
    return p, v


def team_task(vehicles=6, neighbours=5, sensed=5, plan=0, preview=5, **options):
    layout = AgentLayout(preview=preview, neighbours=neighbours, sensed=sensed, plan=plan)
    return TeamTask(layout=layout, limits=options.pop("limits", LIMITS), vehicles=vehicles, **options)


def velocities(plants):
    """Inertial velocities, (n, 3)."""
    return np.einsum("nba,nb->na", rotation_body_from_inertial(plants[:, 6:9]), plants[:, 3:6])


def at_rest(positions, task):
    positions = np.asarray(positions, dtype=float)
    plants = np.zeros((len(positions), 16))
    plants[:, :3], plants[:, 12:] = positions, task.hover_force
    return plants


def preview_rows(plant, path, k, stages):
    """A reference path relative to the vehicle, (stages, 8)."""
    p, v = path(DT * (k + np.arange(stages)))
    heading = np.broadcast_to([0.0, 1.0], (stages, 2))
    return np.concatenate([p - plant[:3], v, heading], axis=-1)


def messages(plants, G, slots, task, plans=None):
    """Comm slots; plans are those of the decision before, absolute, (n, N, 6), or None."""
    n, K, N_p = len(plants), task.layout.neighbours, task.layout.plan
    comm, v = np.zeros((n, K, task.layout.comm_size)), velocities(plants)
    for i in range(n):
        for slot, j in enumerate([j for j in np.flatnonzero(G[i]) if j != i]):
            psi = plants[j, 8]
            comm[i, slot, :2] = G[i, j], 0.0
            comm[i, slot, 2:5], comm[i, slot, 5:8] = plants[j, :3] - plants[i, :3], v[j] - v[i]
            comm[i, slot, 8:12] = plants[j, 6], plants[j, 7], np.sin(psi), np.cos(psi)
            comm[i, slot, 12:15] = slots[i] - slots[j]
            if N_p and plans is not None:
                plan = plans[j, :N_p] - np.r_[plants[i, :3], v[i]]
                comm[i, slot, 15:] = plan.ravel()
    return comm


def sensed_rows(plants, task):
    """Sensed slots: approaching vehicles by time to contact, then receding ones by distance."""
    n, K = len(plants), task.layout.sensed
    rows, v = np.zeros((n, K, 7)), velocities(plants)
    for i in range(n):
        d, w = plants[:, :3] - plants[i, :3], v - v[i]
        gap = np.linalg.norm(d, axis=1)
        closing = -np.einsum("na,na->n", d, w) / np.maximum(gap, 1e-12)
        near = [j for j in range(n) if j != i and gap[j] < task.sensing_radius]
        time = np.where(
            closing > 1e-9, np.maximum(gap - task.separation, 0) / np.maximum(closing, 1e-9), np.inf
        )
        near.sort(key=lambda j: (time[j], gap[j]))
        for slot, j in enumerate(near[:K]):
            rows[i, slot] = np.r_[1.0, d[j], w[j]]
    return rows


class TeamFlight(NamedTuple):
    plants: np.ndarray  # (steps + 1, n, 16)
    gap: float  # m, smallest distance of two vehicles at control steps
    error: np.ndarray  # (steps + 1,), largest |p_i - p_0 - delta_i0|
    fallbacks: np.ndarray  # (steps, n)
    iterations: np.ndarray  # (steps, n)

    @property
    def settling(self):
        """Time after which the error stays below 0.1 m, s."""
        return DT * (1 + np.flatnonzero(self.error > 0.1)[-1])


def smallest_gap(plants):
    p = plants[:, :3]
    gap = np.linalg.norm(p[:, None] - p[None], axis=-1)
    return gap[~np.eye(len(p), dtype=bool)].min(initial=np.inf)


def fly_team(controller, start, slots, G, path, seconds=20.0):
    """Vehicle 0 leads along a path; the others hear what G says."""
    task = controller.task
    plants, n = at_rest(start, task), len(start)
    last, leader = np.full((n, 4), task.hover_force), np.arange(n) == 0
    memory = np.zeros((n, controller.memory_size))
    preview, plans = np.zeros((n, task.layout.preview + 1, 8)), None
    history, fallbacks, iterations = [plants], [], []
    for k in range(round(seconds / DT)):
        preview[0] = preview_rows(plants[0], path, k, task.layout.preview + 1)
        comm, sensed = messages(plants, G, slots, task, plans), sensed_rows(plants, task)
        decision = controller.decide(TeamSituation(plants, last, comm, sensed, leader, preview), memory)
        last, memory = decision.command, decision.memory
        plans = decision.plan + np.pad(plants[:, None, :3], ((0, 0), (0, 0), (0, 3)))
        plants = simulate(plants, last, task.params)
        history.append(plants)
        fallbacks.append(decision.fallback)
        iterations.append(decision.iterations)
    history = np.array(history)
    p = history[:, :, :3]
    error = np.linalg.norm(p - p[:, :1] - slots + slots[0], axis=-1).max(axis=1)
    gap = min(smallest_gap(plants) for plants in history)
    return TeamFlight(history, gap, error, np.array(fallbacks), np.array(iterations))


class Meeting(NamedTuple):
    gap: float  # m, smallest distance
    end: float  # m, largest distance from the goals, 3 s after the end of the references


def swap_antipodes(controller, speed, vehicles=2, seed=0, jitter=0.05):
    """Vehicles on a circle of radius 2 m exchange places with whoever is opposite, at constant speed."""
    task, rng = controller.task, np.random.default_rng(seed)
    angle = np.arange(vehicles) * 2 * np.pi / vehicles
    ring = 2.0 * np.stack([np.cos(angle), np.sin(angle), np.zeros(vehicles)], axis=-1)
    start, goal = ring + jitter * rng.normal(size=ring.shape), -ring
    length = np.linalg.norm(goal - start, axis=1)
    plants, last = at_rest(start, task), np.full((vehicles, 4), task.hover_force)
    memory, leader = np.zeros((vehicles, controller.memory_size)), np.ones(vehicles, bool)
    comm = np.zeros((vehicles, task.layout.neighbours, task.layout.comm_size))
    stages, gap, plans = task.layout.preview + 1, np.inf, None
    G = np.ones((vehicles, vehicles))
    for k in range(round((length.max() / speed + 3.0) / DT)):
        preview = np.zeros((vehicles, stages, 8))
        for i in range(vehicles):
            direction = (goal[i] - start[i]) / length[i]

            def path(t, i=i, direction=direction):
                s = np.minimum(t * speed, length[i])[:, None]
                return start[i] + s * direction, np.where(s < length[i], speed * direction, 0.0)

            preview[i] = preview_rows(plants[i], path, k, stages)
        if task.layout.neighbours:
            comm = messages(plants, G, start, task, plans)
        situation = TeamSituation(plants, last, comm, sensed_rows(plants, task), leader, preview)
        decision = controller.decide(situation, memory)
        last, memory = decision.command, decision.memory
        plans = decision.plan + np.pad(plants[:, None, :3], ((0, 0), (0, 0), (0, 3)))
        plants = simulate(plants, last, task.params)
        gap = min(gap, smallest_gap(plants))
    return Meeting(gap, np.linalg.norm(plants[:, :3] - goal, axis=1).max())


def decide(controller, plants, G, slots, memory=None, path=still, target=None, **changed):
    """One decision of a team from its true states; `changed` replaces parts of the situation by name."""
    situation, kept = situation_of(controller, plants, G, slots, path), changed.pop("memory", memory)
    kept = np.zeros((len(plants), controller.memory_size)) if kept is None else kept
    return controller.decide(situation._replace(target=target, **changed), kept)


def situation_of(controller, plants, G, slots, path=still):
    """What `decide` takes besides the memory, without the target estimate."""
    task, n = controller.task, len(plants)
    preview = np.zeros((n, task.layout.preview + 1, 8))
    preview[0] = preview_rows(plants[0], path, 0, task.layout.preview + 1)
    comm, sensed = messages(plants, G, slots, task), sensed_rows(plants, task)
    last, leader = np.full((n, 4), task.hover_force), np.arange(n) == 0
    return TeamSituation(plants, last, comm, sensed, leader, preview, None, np.zeros((n, 6)))
