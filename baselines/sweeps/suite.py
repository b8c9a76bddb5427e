"""Suites as values: which policies fly in which environments, under which conditions, from which starts.

`suite_files` reads them from TOML, `units` cuts them into what is done in one piece.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from quad_envs.checks import require_whole
from quad_envs.names import shown, unknown_name

from ..evaluation.amounts import require_episodes

# What --quick keeps of a suite.
_QUICK_SEEDS, _QUICK_CONDITIONS, _QUICK_EPISODES = 2, 2, 5
_QUICK_BUDGET, _QUICK_SECONDS = 20, 3.0  # divisor of training budgets; CPU-seconds where none is given


@dataclass(frozen=True, slots=True)
class EnvChoice:
    """An environment of a suite."""

    id: str
    kwargs: dict[str, Any] = field(default_factory=dict)
    label: str = ""  # for tables; the id and the arguments if empty

    @property
    def title(self) -> str:
        """Label for tables."""
        return self.label or _title(self.id, self.kwargs)


@dataclass(frozen=True, slots=True)
class Condition:
    """Arguments under which environments of a suite are flown, and networks were not trained."""

    label: str
    kwargs: dict[str, Any] = field(default_factory=dict)
    envs: tuple[str, ...] = ()  # ids or labels; all if empty

    @property
    def title(self) -> str:
        """Label for tables."""
        return self.label

    def of(self, env: EnvChoice) -> EnvChoice:
        """The environment under this condition."""
        return EnvChoice(env.id, {**env.kwargs, **self.kwargs}, f"{env.title}, {self.label}")


@dataclass(frozen=True, slots=True)
class Training:
    """How the network of a policy is trained, in each environment in which it flies.

    Raises:
        ValueError: If the budget or the seed is not allowed.
    """

    seed: int = 0
    steps: int | None = None  # budget in environment steps,
    seconds: float | None = None  # or in CPU-seconds; the algorithm's own if neither
    hyper: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_whole("seed of a training in a suite", self.seed, 0)

    def quick(self) -> Training:
        """A small part of the budget."""
        if self.steps is not None:
            return replace(self, steps=max(1, self.steps // _QUICK_BUDGET))
        seconds = _QUICK_SECONDS if self.seconds is None else self.seconds / _QUICK_BUDGET
        return replace(self, seconds=seconds)


@dataclass(frozen=True, slots=True)
class PolicyChoice:
    """A policy of a suite."""

    name: str  # of a policy; of an algorithm if it is trained or shipped
    kwargs: dict[str, Any] = field(default_factory=dict)
    label: str = ""
    envs: tuple[str, ...] = ()  # ids or labels of the environments in which it flies; all if empty
    train: Training | None = None
    shipped: bool = False  # fly the network of this algorithm that comes with the suite

    @property
    def contender(self) -> str:
        """What policies are compared as: all training seeds of an algorithm are one."""
        return self.label or _title(self.name, self.kwargs) + ", shipped" * self.shipped

    @property
    def title(self) -> str:
        """Label for tables."""
        return self.contender if self.train is None else f"{self.contender}, seed {self.train.seed}"


def is_for(names: tuple[str, ...], env: EnvChoice) -> bool:
    """Whether a policy or condition that names these environments, or none, is for one."""
    return not names or env.id in names or env.title in names


def _title(name: str, kwargs: Mapping[str, Any]) -> str:
    return ", ".join([name, *(f"{key}={value}" for key, value in kwargs.items())])


@dataclass(frozen=True, slots=True)
class Suite:
    """Every policy flies in every environment that it is for, from the same seeds.

    Raises:
        ValueError: If there is nothing to fly, a number is not allowed, or two titles are equal.
    """

    name: str
    envs: tuple[EnvChoice, ...]
    policies: tuple[PolicyChoice, ...]
    episodes: int = 20  # per environment and policy
    seed: int = 0  # flight i starts with the environment seed `seed + i`
    compare_with: str = ""  # title of the policy from which differences are taken; the first if empty
    conditions: tuple[
        Condition, ...
    ] = ()  # each environment is flown in each; once as it is if there are none

    def __post_init__(self) -> None:
        for name in ("name", "compare_with"):
            if not isinstance(getattr(self, name), str):
                raise ValueError(f"{name} of a suite must be text, got {shown(getattr(self, name))}")
        require_episodes(f"episodes of suite {self.name!r}", self.episodes)
        require_whole(f"seed of suite {self.name!r}", self.seed, 0)
        for kind in ("envs", "policies", "conditions"):
            titles = [choice.title for choice in getattr(self, kind)]
            if not titles and kind != "conditions":
                raise ValueError(f"suite {self.name!r} has no {kind}")
            for title in titles:
                if titles.count(title) > 1:
                    raise ValueError(f"suite {self.name!r} has {title!r} twice in {kind}; give them labels")
        self._check_pairs()
        titles = [policy.title for policy in self.policies]
        if self.compare_with and self.compare_with not in titles:
            raise ValueError(unknown_name(f"compare_with of suite {self.name!r}:", self.compare_with, titles))

    def _check_pairs(self) -> None:
        """Each name in `envs` is one of an environment here, and each environment is flown."""
        known = list(dict.fromkeys(name for env in self.envs for name in (env.id, env.title)))
        for kind, choices in (("policy", self.policies), ("condition", self.conditions)):
            for choice in choices:
                for name in choice.envs:
                    if name not in known:
                        what = f"environment of {kind} {choice.title!r} in suite {self.name!r}"
                        raise ValueError(unknown_name(what, name, known))
        for env in self.envs:
            if not any(is_for(policy.envs, env) for policy in self.policies):
                raise ValueError(f"suite {self.name!r} has no policy for {env.title!r}")
            if not self.flown(env):
                raise ValueError(f"suite {self.name!r} has no condition for {env.title!r}")

    def flown(self, env: EnvChoice) -> dict[str, EnvChoice]:
        """Label of each condition that is for an environment -> what is flown; of none "" -> itself."""
        if not self.conditions:
            return {"": env}
        return {one.label: one.of(env) for one in self.conditions if is_for(one.envs, env)}

    @property
    def base(self) -> str:
        """Title of the policy from which differences are taken."""
        return self.compare_with or self.policies[0].title

    @property
    def learned(self) -> bool:
        """Whether networks are among the policies, which are compared as contenders."""
        return any(policy.train is not None or policy.shipped for policy in self.policies)

    def quick(self) -> Suite:
        """A small part, to see it work: one environment, two conditions, two seeds, small budgets."""
        env = self.envs[0]
        kept, seen = [], dict[str, int]()
        for policy in self.policies:
            seen[policy.contender] = seen.get(policy.contender, 0) + 1
            if is_for(policy.envs, env) and seen[policy.contender] <= _QUICK_SEEDS:
                envs = tuple(name for name in policy.envs if name in (env.id, env.title))
                train = policy.train and policy.train.quick()
                kept.append(replace(policy, envs=envs, train=train))
        conditions = [one for one in self.conditions if is_for(one.envs, env)][:_QUICK_CONDITIONS]
        return replace(
            self,
            name=f"{self.name}-quick",
            envs=(env,),
            policies=tuple(kept),
            conditions=tuple(replace(one, envs=()) for one in conditions),
            episodes=min(self.episodes, _QUICK_EPISODES),
        )

    def to_dict(self) -> dict[str, Any]:
        """As plain values, the form of the TOML file."""
        return asdict(self)

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Suite:
        """What `to_dict` gave, unchecked: its policies may be folders that are no longer there."""
        policies = (
            PolicyChoice(
                **{**one, "train": one["train"] and Training(**one["train"]), "envs": tuple(one["envs"])}
            )
            for one in plain["policies"]
        )
        conditions = (Condition(**{**one, "envs": tuple(one["envs"])}) for one in plain["conditions"])
        envs = (EnvChoice(**env) for env in plain["envs"])
        parts = {"envs": tuple(envs), "policies": tuple(policies), "conditions": tuple(conditions)}
        return cls(**{**plain, **parts})
