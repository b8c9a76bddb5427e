"""Environments of every id whose options are drawn at random, singly, in teams and as vectors."""

from __future__ import annotations

import random
import warnings
from collections.abc import Callable
from importlib import import_module
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from quad_envs.disturbances import DISTURBANCES
from quad_envs.formations import STARTS
from quad_envs.graphs import GRAPHS
from quad_envs.parameters import Array
from quad_envs.registration import TEAMS, TRACKING
from quad_envs.sensors import SENSORS
from quad_envs.vehicles import VEHICLES

Draw = Callable[[random.Random], Any]
IDS = (*TRACKING, *TEAMS)
_NOT_FILES = ("setpoint", "helix", "spiral", "lines", "lemniscate", "racetrack", "random", "mixture", "line")
_SHARED: dict[str, Draw] = {
    "kappa": lambda rng: rng.uniform(0.27, 1.0),
    "rate_limit": lambda rng: rng.uniform(3.0, 60.0),
    "tilt_limit": lambda rng: rng.uniform(0.05, 1.4),
    "velocity_limit": lambda rng: rng.uniform(0.2, 6.0),
    "position_limit": lambda rng: [[-rng.uniform(5.0, 30.0)] * 3, [rng.uniform(5.0, 30.0)] * 3],
    "body_rate_limit": lambda rng: rng.uniform(0.3, 8.0),
    "vehicle": lambda rng: rng.choice(list(VEHICLES)),
    "frame": lambda rng: rng.choice(["plus", "x"]),
    "drag": lambda rng: rng.uniform(0.0, 0.3),
    "Q": lambda rng: 10.0 ** rng.uniform(-3.0, 3.0),
    "R": lambda rng: 10.0 ** rng.uniform(-3.0, 3.0),
    "disturbance": lambda rng: rng.choice(list(DISTURBANCES)),
    "reveal_disturbance": lambda rng: True,
    "sensor_noise": lambda rng: rng.uniform(0.0, 0.2),
    "randomize": lambda rng: rng.uniform(0.0, 0.4),
    "dt": lambda rng: rng.choice([0.02, 0.05, 0.1]),
    "substeps": lambda rng: rng.randint(2, 8),
    "time_limit": lambda rng: rng.choice([1.0, 4.0, 10.0, 20.0]),
}
_SINGLE: dict[str, Draw] = {
    "reference": lambda rng: rng.choice(_NOT_FILES),
    "start": lambda rng: "reference",
    "start_box": lambda rng: rng.uniform(0.0, 4.0),
    "preview": lambda rng: rng.randint(0, 40),
    "lost_distance": lambda rng: rng.uniform(8.0, 100.0),
}
_TEAM: dict[str, Draw] = {
    "vehicles": lambda rng: rng.randint(2, 9),
    "spacing": lambda rng: rng.uniform(0.8, 3.0),
    "graph": lambda rng: rng.choice(GRAPHS),
    "drop_out": lambda rng: rng.uniform(0.0, 1.0),
    "delay": lambda rng: rng.randint(0, 4),
    "comm": lambda rng: "plan",
    "start": lambda rng: rng.choice(STARTS),
    "sensing_radius": lambda rng: rng.uniform(0.5, 10.0),
    "neighbours": lambda rng: rng.randint(0, 6),
    "sensed": lambda rng: rng.randint(0, 6),
    "preview": lambda rng: rng.randint(1, 10),
    "terminate": lambda rng: rng.choice(["team", "agent"]),
    "arena": lambda rng: rng.uniform(10.0, 200.0),
    "formation": lambda rng: rng.choice(["triangle", "hexagon", "lattice"]),
    "target": lambda rng: rng.choice(["static", "cv", "turn", "aircraft", "chapter-6"]),
    "sensor": lambda rng: rng.choice(list(SENSORS)),
    "detection": lambda rng: rng.uniform(0.0, 1.0),
}


class Drawn(NamedTuple):
    """An environment that was drawn."""

    env_id: str
    kwargs: dict[str, Any]
    copies: int  # vehicles or teams of a vector; 0 if it is none
    env: Any

    @property
    def what(self) -> str:
        """For a line about it."""
        form = f" x {self.copies}" if self.copies else ""
        return f"{self.env_id}{form} {self.kwargs}"


def options(rng: random.Random, env_id: str) -> dict[str, Any]:
    """Some options, most of which go together."""
    known = _SHARED | _SINGLE if env_id in TRACKING else _SHARED | _TEAM
    if env_id == "quad/Formation-v0":
        known = {name: how for name, how in known.items() if name not in ("target", "sensor", "detection")}
    names = rng.sample(list(known), rng.randint(0, 6))
    return {name: known[name](rng) for name in names}


def make(env_id: str, kwargs: dict[str, Any], copies: int, **more: Any) -> Any:
    """An environment: of one vehicle or team, or a vector of them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if env_id in TEAMS:
            module = import_module(TEAMS[env_id])
            return module.vector_env(copies, **kwargs, **more) if copies else module.parallel_env(**kwargs)
        if copies:
            return gymnasium.make_vec(env_id, num_envs=copies, **kwargs, **more)
        return gymnasium.make(env_id, disable_env_checker=True, **kwargs)


def draw(rng: random.Random, env_id: str, copies: int) -> Drawn:
    """An environment with options that it takes; those that do not go together are drawn anew."""
    while True:
        kwargs = options(rng, env_id)
        try:
            return Drawn(env_id, kwargs, copies, make(env_id, kwargs, copies))
        except ValueError:
            continue


class Step(NamedTuple):
    """What a step gave, of one vehicle, all vehicles of a team, or all of a vector."""

    observations: Array
    rewards: Array
    ended: bool  # so that a single environment must be reset


def reset(env: Any, seed: int | None = None) -> Array:
    """The first observations, rows x entries."""
    observation, _ = env.reset(seed=seed)
    return _rows(observation)


def step(env: Any, rng: np.random.Generator) -> Step:
    """A step with actions of which some are outside their box."""
    if hasattr(env, "possible_agents"):
        spread = {name: env.action_space(name).shape for name in env.agents}
        actions = {name: rng.uniform(-1.2, 1.2, shape).astype(np.float32) for name, shape in spread.items()}
        observations, rewards, *_ = env.step(actions)
        return Step(_rows(observations), np.array(list(rewards.values())), not env.agents)
    actions = rng.uniform(-1.2, 1.2, env.action_space.shape).astype(np.float32)
    observation, reward, terminated, truncated, _ = env.step(actions)
    single = np.ndim(reward) == 0
    return Step(_rows(observation), np.atleast_1d(reward), bool(single and (terminated or truncated)))


def _rows(observation: Any) -> Array:
    if isinstance(observation, dict):
        return np.array(list(observation.values()))
    return np.atleast_2d(observation)
