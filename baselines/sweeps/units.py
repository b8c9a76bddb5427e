"""What a benchmark does in one piece: it makes a policy, by training or tuning, or flies one."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from quad_envs.parameters import Array

from ..evaluation.episode import Episode
from .choices import EnvChoice, PolicyChoice, Training, Tuning
from .suite import Suite


class TrainingUnit(NamedTuple):
    """A network to train, or a controller to tune."""

    number: int
    env: EnvChoice  # without conditions
    policy: PolicyChoice
    folder: Path

    @property
    def made(self) -> Training | Tuning:
        """Its seed, its budget and how."""
        assert self.policy.made is not None
        return self.policy.made

    @property
    def env_kwargs(self) -> dict[str, Any]:
        """Of the environment in which it is made."""
        return {**self.env.kwargs, **self.policy.train_under}


class Given(NamedTuple):
    """Objects that fly and that no name in a suite stands for; a program that goes on later has others."""

    policy: Any = None  # with `predict`, or a factory; None: the name in the suite
    env: Any = None  # None: the id in the suite
    on_episode: Callable[[Episode], None] | None = None  # called with each flight
    mismatch: bool = False  # whether the policy may be one of another task on purpose


class Unit(NamedTuple):
    """A policy to fly in an environment."""

    number: int
    env: EnvChoice
    policy: PolicyChoice
    policy_name: str  # for make_policy
    episodes: int
    seed: int
    save_before: int = 0  # flights from starts below this seed are saved
    given: Given = Given()
    timed: tuple[Array, ...] | None = None  # its decisions, where they were timed before the flights
    files: Mapping[str, Mapping[str, bytes]] | None = None  # brought to another machine, see `inputs`

    @property
    def named(self) -> bool:
        """Whether names alone say what is flown, so that a stored result stands for it."""
        return all(value is None or value is False for value in self.given)

    @property
    def starts(self) -> range:
        """Seeds of its flights."""
        return range(self.seed, self.seed + self.episodes)

    @property
    def source(self) -> Any:
        """The policy, or its name for `make_policy`."""
        return self.policy_name if self.given.policy is None else self.given.policy

    @property
    def options(self) -> dict[str, Any]:
        """Of the policy for `make_policy`; what was made has its own."""
        return {} if self.policy.made is not None else self.policy.kwargs

    @property
    def name(self) -> str:
        """Its name in file names: readable, and another one for other titles."""
        return _file_name(f"{self.env.title}--{self.policy.title}")

    def episode_name(self, seed: int) -> str:
        """Name of the file of a flight that is saved."""
        return f"{self.name}-{seed}.npz"


def _file_name(text: str) -> str:
    """A text as a part of file names; its digest tells apart what differs in other characters only."""
    slug = "".join(c if c.isascii() and c.isalnum() else "-" for c in text)[:80]
    return f"{slug}-{hashlib.sha256(text.encode()).hexdigest()[:6]}"


def _trained_folder(env: EnvChoice, policy: PolicyChoice, networks: Path) -> Path:
    """Where the network of a policy for an environment is."""
    return networks / _file_name(f"{env.title}--{policy.title}")


def training_units(suite: Suite, networks: Path = Path("networks")) -> list[TrainingUnit]:
    """All policies that the suite trains or tunes: one for each environment in which one of them flies.

    Args:
        suite: The suite.
        networks: Folder of all of them.
    """
    pairs = [
        (env, policy)
        for policy in suite.policies
        for env in suite.envs
        if policy.made is not None and policy in suite.policies_in(env)
    ]
    return [TrainingUnit(i, *pair, _trained_folder(*pair, networks)) for i, pair in enumerate(pairs)]


def suite_units(
    suite: Suite,
    flights_saved: int = 0,
    networks: Path = Path("networks"),
) -> list[Unit]:
    """All environments x conditions x policies that are for them.

    Args:
        suite: The suite.
        flights_saved: How many of each unit are saved, the first ones.
        networks: Folder of what the suite trains or tunes.
    """
    units: list[Unit] = []
    for env in suite.envs:
        for condition, flown in suite.flown(env).items():
            for policy in suite.policies_in(env):
                if policy.conditions and condition not in policy.conditions:
                    continue
                name, number = _policy_name(env, policy, networks), len(units)
                flights = suite.episodes, suite.seed, suite.seed + flights_saved
                units.append(Unit(number, flown, policy, name, *flights))
    return units


def _policy_name(env: EnvChoice, policy: PolicyChoice, networks: Path) -> str:
    """Name or path of a policy for one environment."""
    from ..policies.trained import shipped_name

    if policy.made is not None:
        return str(_trained_folder(env, policy, networks))
    return shipped_name(policy.name, env.id) if policy.shipped else policy.name
