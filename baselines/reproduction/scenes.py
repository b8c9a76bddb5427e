"""Chapter 6 by Monte Carlo: scenes of `quad/CooperativeEstimation-v0`, and filters that run over them.

The policies of this suite are flown like any other (`fly_filter`). What only the dissertation's text has, or
what only a study needs, runs over a recorded scene (`run_filter`): the same measurements of the same flights.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from controllers.estimation import Measurements, ekf
from controllers.estimation.consistency import anees
from quad_envs import cooperative_estimation_v0
from quad_envs.observations.team import COMM_POSITION, COMM_WEIGHT
from quad_envs.parameters import POSITION, Array
from quad_envs.tasks import TeamTask

from ..evaluation.rollout import run_episodes
from ..policies.registry import make_policy

Bools = NDArray[np.bool_]

# 0 to 2.5, 2.5 to 5 and 5 to 10 s: between them the communication of chapter 6 changes.
INTERVALS = (slice(0, 50), slice(50, 100), slice(100, 200))


LOST = 5.0  # m, about the distance of the target: a filter beyond has settled on the wrong side


class Track(NamedTuple):
    """What filters believed, and how wrong it was; runs and vehicles are axes 1 and 2."""

    error: Array  # (T, runs, N, 3), position, m
    P: Array  # (T, runs, N, 3, 3)
    nis: Array  # (T, runs, N)
    rows: NDArray[np.int64]  # (T, runs, N)

    def rmse(self, vehicle: int | slice, part: slice) -> float:
        """Root of the mean squared position error, m."""
        return float(np.sqrt((self.error[part, :, vehicle] ** 2).sum(axis=-1).mean()))

    def sigma(self, vehicle: int | slice, part: slice) -> float:
        """What the filter believes the RMSE to be: root of the mean trace of its covariance, m."""
        return float(np.sqrt(np.trace(self.P[part, :, vehicle], axis1=-2, axis2=-1).mean()))

    def anees(self, vehicle: int | slice, part: slice) -> float:
        """1 for a filter as sure as it may be."""
        return anees(self.error[part, :, vehicle], self.P[part, :, vehicle])

    def anis(self, vehicle: int | slice, part: slice) -> float:
        """Normalised innovation squared per row; 1 for a consistent filter."""
        return float(np.nansum(self.nis[part, :, vehicle]) / self.rows[part, :, vehicle].sum())

    def jitter(self, vehicle: int, part: slice) -> float:
        """RMS change of the error from sample to sample, m: how rough the estimate is."""
        return float(np.sqrt((np.diff(self.error[part, :, vehicle], axis=0) ** 2).sum(axis=-1).mean()))

    def lost(self, limit: float = LOST) -> Bools:
        """Runs and vehicles whose error ever exceeds the limit, (runs, N)."""
        return np.asarray((np.linalg.norm(self.error, axis=-1) > limit).any(axis=0))

    def without(self, runs: Bools) -> Track:
        """The track of the other runs."""
        kept = ~runs
        return Track(self.error[:, kept], self.P[:, kept], self.nis[:, kept], self.rows[:, kept])


class Scene(NamedTuple):
    """Flights on rails with all that each vehicle holds, in absolute coordinates; axis 1 is run x vehicle."""

    task: TeamTask
    target: Array  # (T, runs N, 6)
    z: Array  # (T, runs N, 1 + K, 3), range, azimuth, elevation: own, then per comm slot
    places: Array  # (T, runs N, 1 + K, 3), where each was measured, m
    held: Bools  # (T, runs N, 1 + K)
    expected: Array  # (runs N, 3), where the target is expected at the start, m


def fly_filter(name: str, runs: int, **settings: Any) -> Track:
    """Fly a policy whose answer is an estimate, in `runs` seeds."""
    env = cooperative_estimation_v0.vector_env(num_teams=runs, **settings)
    episodes = list(run_episodes(make_policy(name, env), env, runs))
    n = env.task.vehicles

    def signal(key: str) -> NDArray[Any]:
        values = np.stack([episode.signals[key] for episode in episodes], axis=1)
        return values.reshape(len(values), runs, n, *values.shape[2:])

    error, P = signal("estimate_error")[..., :3], signal("estimate_covariance")[..., :3, :3]
    return Track(error, P, signal("nis"), signal("nis_rows"))


def record(runs: int, **settings: Any) -> Scene:
    """What all vehicles hold in the flights with seeds 0, 1, ..; on rails they do not depend on a policy."""
    env = cooperative_estimation_v0.vector_env(num_teams=runs, **settings)
    n = env.num_envs
    idle = np.zeros((n, env.task.action_size), dtype=np.float32)
    observations, _ = env.reset(seed=0)
    expected = env.plants[:, POSITION] - env.task.layout.decode(observations).slot
    parts = []
    for k in range(env.task.episode_steps):
        view = env.task.layout.decode(observations)
        own = env.plants[:, None, POSITION]
        message = np.concatenate([np.zeros((n, 1, 3)), view.comm[..., COMM_POSITION]], axis=1)
        heard = np.concatenate([np.ones((n, 1)), view.comm[..., COMM_WEIGHT]], axis=1) > 0.0
        valid, rho, sine, cosine, elevation = np.moveaxis(view.measured, -1, 0)
        z = np.stack([rho, np.arctan2(sine, cosine), elevation], axis=-1)
        target = np.repeat(env.targets[:, k], env.task.vehicles, axis=0)
        parts.append((target, z, own + message, heard & (valid > 0.0)))
        observations = env.step(idle)[0]
    target, z, places, held = (np.stack(part) for part in zip(*parts, strict=True))
    return Scene(env.task, target, z, places, held, expected)


class Held(NamedTuple):
    """What the filters of all runs and vehicles hold in one step."""

    z: Array  # (n, m, 3)
    places: Array  # (n, m, 3)
    valid: Bools  # (n, m)
    sigma: Array  # (3,)
    rows: int


Filter = tuple[Array, Array]  # states (n, d) of which the first three are the position, covariances (n, d, d)
Update = Callable[[Filter, Held], tuple[Filter, Array, NDArray[np.int64]]]


def ekf_update(state: Filter, held: Held) -> tuple[Filter, Array, NDArray[np.int64]]:
    """The update of this suite as the text has it: to the first order, and whatever was measured."""
    believed, now = ekf.TargetFilter(*state), np.zeros(held.z.shape[:2])
    measured = Measurements(held.z, held.places, now, held.valid, held.sigma, held.rows)
    new, said = ekf.update(believed, measured, restart=None, second_order=False)
    return (new.x, new.P), said.nis, said.rows


def run_filter(
    scene: Scene,
    start: Filter,
    predict: Callable[[Filter], Filter],
    rows: int,
    update: Update = ekf_update,
    fuse: Callable[[Filter], Filter] | None = None,
) -> Track:
    """Filters over a scene; the start is that of the first step, which has measurements, too."""
    state, n = start, scene.task.vehicles
    sigma, parts = np.array(scene.task.sensor_sigma), []
    for k, target in enumerate(scene.target):
        state = predict(state) if k else state
        held = Held(scene.z[k], scene.places[k], scene.held[k], sigma, rows)
        state, nis, used = update(state, held)
        state = fuse(state) if fuse else state
        parts.append((state[0][:, :3] - target[:, :3], state[1][:, :3, :3].copy(), nis, used))
    stacked = [np.stack(part) for part in zip(*parts, strict=True)]
    error, P, nis, used = (part.reshape(len(part), -1, n, *part.shape[2:]) for part in stacked)
    return Track(error, P, nis, used)


def prior(scene: Scene) -> Filter:
    """What the task says of the target before the first measurement: states (n, 6) and covariances."""
    n, task = len(scene.expected), scene.task
    x = np.concatenate([scene.expected, np.broadcast_to(task.prior_velocity, (n, 3))], axis=1)
    return x, np.tile(np.diag(np.repeat(np.square(task.prior_sigma), 3)), (n, 1, 1))


def drawn(scene: Scene, mean: Array, sigma: Array, seed: int = 1) -> Filter:
    """Filters drawn around a known start from their own covariance.

    Args:
        scene: Of as many filters.
        mean: Truth at the start, (d,).
        sigma: Standard deviations, (d,).
        seed: Of the draws.
    """
    n = len(scene.target[0])
    noise = np.random.default_rng(seed).normal(size=(n, len(mean)))
    return mean + sigma * noise, np.tile(np.diag(sigma**2), (n, 1, 1))


def constant_velocity(q: float, dt: float = 0.05) -> Callable[[Filter], Filter]:
    """The prediction of this suite."""

    def predict(state: Filter) -> Filter:
        new = ekf.predict(ekf.TargetFilter(*state), dt, q)
        return new.x, new.P

    return predict
