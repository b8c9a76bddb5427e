"""Flights in dissertation mode: its tasks, its controllers and its cost, as values that run in parallel."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from joblib import Parallel, delayed

from quad_envs.parameters import Array
from quad_envs.references import Helix, OutAndBack, Reference, SetPoint, SphericalSpiral

from ..evaluation.columns import Record
from ..evaluation.metrics import measure
from ..evaluation.rollout import Episode, run_episodes
from ..policies.registry import make_policy

HORIZON = 25

# The tasks that reproduce tables 4.1 and 4.2 (all descend, z being down), and their climbing mirror images.
DESCENDING: dict[str, Reference] = {"helix": Helix(), "spiral": SphericalSpiral(), "lines": OutAndBack()}
CLIMBING: dict[str, Reference] = {
    "helix": Helix(vertical_speed=-3.0),
    "spiral": SphericalSpiral(latitude_rate=-0.3),
    "lines": OutAndBack(vertical_speed=-1.0),
}

ORIGIN: Reference = SetPoint()

# Controllers in dissertation mode: hover frame, v_ref unrotated in the slot of V_B, no rate limit.
_DISSERTATION = {"frame": "hover"}
CONTROLLERS: dict[str, tuple[str, dict[str, Any]]] = {
    "LMPC": ("lmpc", _DISSERTATION),
    "SDC 1/2": ("sdc-nmpc", {**_DISSERTATION, "alpha": 0.5}),
    "SDC 1": ("sdc-nmpc", {**_DISSERTATION, "alpha": 1.0}),
    "1 pass": ("sdc-nmpc", {**_DISSERTATION, "alpha": 0.5, "relinearisations": 1}),
    "1 pass, alpha 1": ("sdc-nmpc", {**_DISSERTATION, "alpha": 1.0, "relinearisations": 1}),
    "RTI": ("nmpc", {**_DISSERTATION, "velocity_error": "body"}),
    "exact": ("nmpc", {**_DISSERTATION, "velocity_error": "body", "passes": 30}),
    "FBL": ("feedback-linearization", _DISSERTATION),
}


@dataclass(frozen=True)
class Flight:
    """One episode of one controller from one start."""

    controller: str  # of CONTROLLERS
    reference: Reference
    start: tuple[float, ...] = (0.0, 0.0, 0.0)  # m, or the whole state
    horizon: int = HORIZON
    env: dict[str, Any] = field(default_factory=dict)  # further keyword arguments of the environment
    policy: dict[str, Any] = field(default_factory=dict)  # further options of the policy


class Outcome(NamedTuple):
    """What is kept of a flight."""

    record: Record
    cost: float  # sum of |x_k - r_k|^2 + |du_k|^2 over k = 0..T-1, Eq. (3.1) with Q = R = I
    error: Array  # (T,), position error, m
    states: Array  # (T+1, 16)
    commands: Array  # (T, 4), N
    decision_times: Array  # (T,), s


def dissertation_cost(episode: Episode) -> float:
    """J of Eq. (3.1) without its terminal term; v_ref unrotated, yaw error not wrapped."""
    steps = len(episode.commands)
    x, rows = episode.states[:steps, :12].copy(), episode.references[:steps]
    x[:, :6] -= rows[:, :6]
    x[:, 8] -= np.arctan2(rows[:, 6], rows[:, 7])
    du = episode.commands - episode.task.hover_force
    return float((x * x).sum() + (du * du).sum())


def fly(flight: Flight) -> Outcome:
    """Fly one episode."""
    settings = {"start": flight.start, "start_box": 0.0, "preview": flight.horizon, **flight.env}
    with warnings.catch_warnings():  # the text's pulse of 1 N m for 0.1 s exceeds what the vehicle can hold
        warnings.filterwarnings("ignore", "the disturbance's torque", UserWarning)
        env = gymnasium.make("quad/HelixTracking-v0", reference=flight.reference, **settings)
    name, options = CONTROLLERS[flight.controller]
    options = {**options, **flight.policy}
    if name != "feedback-linearization":
        options["horizon"] = flight.horizon
    episode = next(run_episodes(make_policy(name, env, **options), env, 1))
    steps = len(episode.commands)
    error = np.linalg.norm(episode.states[:steps, :3] - episode.references[:steps, :3], axis=1)
    return Outcome(
        measure(episode),
        dissertation_cost(episode),
        np.asarray(error),
        episode.states,
        episode.commands,
        episode.decision_times,
    )


def fly_all(flights: Sequence[Flight], jobs: int = 1) -> list[Outcome]:
    """Fly many, in parallel where jobs > 1; decision times are only comparable with jobs = 1."""
    return list(Parallel(n_jobs=jobs)(delayed(fly)(flight) for flight in flights))


def regulate(controller: str, offsets: Array, horizon: int = HORIZON) -> list[Record]:
    """Regulation to the origin from many offsets (n, 3) at once."""
    env = gymnasium.make_vec(
        "quad/Regulation-v0", num_envs=len(offsets), reference=ORIGIN, preview=horizon, start_box=0.0
    )
    starts = np.zeros((len(offsets), 12))
    starts[:, :3] = offsets
    name, options = CONTROLLERS[controller]
    policy = make_policy(name, env, horizon=horizon, **options)
    episodes = run_episodes(policy, _FixedStarts(env, starts), len(offsets))
    return [measure(episode) for episode in episodes]


class _FixedStarts(gymnasium.vector.VectorWrapper):
    """A vector environment whose rows always start from given states."""

    def __init__(self, env: Any, starts: Array) -> None:
        super().__init__(env)
        self._starts = starts

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        """Reset all rows to their starts."""
        return self.env.reset(seed=seed, options={**(options or {}), "state": self._starts})
