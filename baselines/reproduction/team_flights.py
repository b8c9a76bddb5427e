"""Flights of teams as values that run in parallel, through the environments and policies of this suite."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from joblib import Parallel, delayed

from quad_envs.parameters import POSITION, Array

from ..evaluation.rollout import Episode, run_episodes
from ..policies.environments import make_env
from ..policies.estimate_wrapper import EstimateWrapper, Fusion
from ..policies.registry import make_policy

FORMATION, TRACKING = "quad/Formation-v0", "quad/TargetTracking-v0"
_SETTLED = 0.1  # m
_NO_CRASH = 1e-9  # m: flights go on after a collision, so that a rule's smallest distance can be told

# Chapter 5 as printed, its errata apart: neighbours frozen over the horizon, no governor, alpha = 1/2.
FROZEN: dict[str, Any] = {
    "alpha": 0.5,
    "neighbour": "frozen",
    "feed_forward": False,
    "reach": np.inf,
    "speed": np.inf,
}
TEXT_ROWS: dict[str, Any] = {"avoidance": "frozen", "avoidance_set": "edges"}  # (5.7), its sign corrected
NO_ROWS: dict[str, Any] = {"avoidance": "none"}
FREE: dict[str, Any] = {"reach": np.inf, "speed": np.inf}
EQUAL: dict[str, Any] = {"leader_weight": 1.0}


@dataclass(frozen=True)
class TeamFlight:
    """One episode of a team."""

    env: dict[str, Any] = field(default_factory=dict)
    policy: dict[str, Any] = field(default_factory=dict)
    env_id: str = FORMATION
    name: str = "consensus-mpc"
    seed: int = 0
    fusion: Fusion | None = None  # weights with which estimates are shared, through the estimate wrapper


class TeamOutcome(NamedTuple):
    """What is kept of a flight."""

    error: Array  # (T+1, N, 3), position less the slot beside the leader, or beside the target, m
    gap: float  # m, smallest distance of two vehicles, at substeps
    crashed: bool
    dt: float
    estimate_error: Array  # (T, N, 3), m; empty where nothing is estimated
    estimate_trace: Array  # (T, N), m^2

    @property
    def distance(self) -> Array:
        """Largest error of a vehicle, (T+1,), m."""
        return np.asarray(np.linalg.norm(self.error, axis=-1).max(axis=-1))

    @property
    def final(self) -> float:
        """Error of the worst vehicle at the end, m; infinite after a crash."""
        return np.inf if self.crashed else float(self.distance[-1])

    @property
    def settling(self) -> float:
        """Time from which all errors stay below 0.1 m, s; infinite where they do not."""
        above = np.flatnonzero(self.distance > _SETTLED)
        if self.crashed or (above.size and above[-1] == len(self.distance) - 1):
            return np.inf
        return self.dt * float(above[-1] + 1) if above.size else 0.0

    @property
    def height(self) -> tuple[float, float]:
        """Largest and RMS height error of the followers, m."""
        z = np.abs(self.error[:, 1:, 2])
        return float(z.max()), float(np.sqrt((z * z).mean()))

    @property
    def level(self) -> float:
        """RMS error of the followers in x and y, m."""
        return float(np.sqrt((self.error[:, 1:, :2] ** 2).sum(axis=-1).mean()))

    def rms(self, seconds: float = 5.0) -> Array:
        """RMS error of each vehicle over the end of the flight, (N,), m; infinite after a crash."""
        last = self.error[-round(seconds / self.dt) :]
        found = np.sqrt((last**2).sum(axis=-1).mean(axis=0))
        return np.full_like(found, np.inf) if self.crashed else np.asarray(found)


def team_episodes(flight: TeamFlight) -> list[Episode]:
    """Fly one episode of a team: that of each vehicle."""
    settings = {"crash_distance": _NO_CRASH, **flight.env}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*no spanning tree.*")  # some claims are about that
        env = make_env(flight.env_id, **settings)
    if flight.fusion is not None:
        env = EstimateWrapper(env, fusion=flight.fusion)
    policy = make_policy(flight.name, env, **flight.policy)
    return list(run_episodes(policy, env, 1, flight.seed))


def fly_team(flight: TeamFlight) -> TeamOutcome:
    """Fly one episode, and keep what the claims look at."""
    return outcome_of(team_episodes(flight))


def outcome_of(episodes: list[Episode]) -> TeamOutcome:
    """What is kept of the episodes of a team."""
    states = np.stack([episode.states for episode in episodes], axis=1)
    slots = np.stack([episode.references[0, POSITION] for episode in episodes])
    p, steps = states[..., POSITION], len(states)
    if episodes[0].task.layout.target:  # type: ignore[attr-defined]
        error = p - np.stack([episode.references[:steps, POSITION] for episode in episodes], axis=1)
    else:
        error = p - p[:, :1] - (slots - slots[0])
    gap = min(float(episode.signals["min_separation"].min()) for episode in episodes)
    estimates, trace = _estimates(episodes)
    crashed = any(episode.crashed for episode in episodes)
    return TeamOutcome(error, gap, crashed, episodes[0].task.dt, estimates, trace)


def _estimates(episodes: Sequence[Any]) -> tuple[Array, Array]:
    if "estimate_error" not in episodes[0].signals:
        return np.zeros((0, 0, 3)), np.zeros((0, 0))
    error = np.stack([episode.signals["estimate_error"][:, :3] for episode in episodes], axis=1)
    P = np.stack([episode.signals["estimate_covariance"][:, :3, :3] for episode in episodes], axis=1)
    return error, np.asarray(np.trace(P, axis1=-2, axis2=-1))


_FLOWN: dict[str, TeamOutcome] = {}  # flights of this process: tables and claims look at the same ones


def fly_teams(flights: Sequence[TeamFlight], jobs: int = 1) -> list[TeamOutcome]:
    """Fly many, each once in a process, in parallel where jobs > 1."""
    missing = {repr(flight): flight for flight in flights if repr(flight) not in _FLOWN}
    outcomes = Parallel(n_jobs=jobs)(delayed(fly_team)(flight) for flight in missing.values())
    _FLOWN.update(zip(missing, outcomes, strict=True))
    return [_FLOWN[repr(flight)] for flight in flights]
