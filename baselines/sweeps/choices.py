"""What a suite names: environments, conditions, tables, policies, and how a policy is trained or tuned."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from quad_envs.arguments.checks import require_whole
from quad_envs.arguments.names import shown
from quad_envs.registration import TEAMS

from ..files import plain_json

TEAMS_PART, TRACKING_PART = "teams", "tracking"
PARTS = (TRACKING_PART, TEAMS_PART)  # environments of one vehicle, and of several
_QUICK_SECONDS = 3.0  # CPU-seconds of a training in a quick suite, where none are given


@dataclass(frozen=True, slots=True)
class EnvChoice:
    """An environment of a suite."""

    id: str
    kwargs: dict[str, Any] = field(default_factory=dict)
    label: str = ""  # for tables; the id and the arguments if empty
    tables: tuple[
        str, ...
    ] = ()  # labels of the tables of which alone policies fly in it; any policy if empty

    @property
    def title(self) -> str:
        """Label for tables."""
        return self.label or _title(self.id, self.kwargs)

    @property
    def part(self) -> str:
        """One of PARTS."""
        return TEAMS_PART if self.id in TEAMS else TRACKING_PART


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
class TableChoice:
    """A table of its own, in which some of a suite's policies are compared with each other alone."""

    label: str
    about: str = ""  # what its policies have in common

    @property
    def title(self) -> str:
        """Label for tables."""
        return self.label


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
    start_from: str = ""  # shipped policy, or checkpoint, whose network it begins with; a new one if empty

    def __post_init__(self) -> None:
        require_whole("seed of a training in a suite", self.seed, 0)
        if not isinstance(self.start_from, str):
            raise ValueError(
                "start_from of a training in a suite must be the name of a policy, got "
                f"{shown(self.start_from)}"
            )

    def part(self, divisor: float) -> Training:
        """With a small part of the budget."""
        if self.steps is not None:
            return replace(self, steps=max(1, int(self.steps // divisor)))
        seconds = _QUICK_SECONDS if self.seconds is None else self.seconds / divisor
        return replace(self, seconds=seconds)


@dataclass(frozen=True, slots=True)
class Tuning:
    """How the options of a controller are tuned, in each environment in which it flies.

    Raises:
        ValueError: If the budget or the seed is not allowed.
    """

    seed: int = 0
    seconds: float | None = None  # budget in CPU-seconds; that of `tune` if neither this
    episodes: int | None = None  # nor one in episodes is given
    objective: str = "score"  # or "quadratic_cost"
    fields: tuple[str, ...] = ()  # options to tune; all that mean something if empty

    def __post_init__(self) -> None:
        require_whole("seed of a tuning in a suite", self.seed, 0, 99)
        if isinstance(self.fields, str):
            raise ValueError(f"fields of a tuning in a suite must be a list, as ['Q'], got {self.fields!r}")
        object.__setattr__(self, "fields", tuple(self.fields))

    def part(self, divisor: float) -> Tuning:
        """With a small part of the budget."""
        if self.episodes is not None:
            return replace(self, episodes=max(1, int(self.episodes // divisor)))
        seconds = _QUICK_SECONDS if self.seconds is None else self.seconds / divisor
        return replace(self, seconds=seconds)


@dataclass(frozen=True, slots=True)
class PolicyChoice:
    """A policy of a suite.

    Raises:
        ValueError: If it is to be trained and tuned, or is trained under conditions and does neither.
    """

    name: str  # of a policy; of an algorithm if it is trained or shipped
    kwargs: dict[str, Any] = field(default_factory=dict)  # options; where a tuning begins if it is tuned
    label: str = ""
    envs: tuple[str, ...] = ()  # ids or labels of the environments in which it flies; all if empty
    conditions: tuple[str, ...] = ()  # labels of the conditions under which it flies; all if empty
    tables: tuple[str, ...] = ()  # labels of the tables in which it stands; all if empty
    train: Training | None = None
    tune: Tuning | None = None
    train_under: dict[str, Any] = field(
        default_factory=dict
    )  # arguments of the environment in training or tuning, beside its own
    shipped: bool = False  # fly the network of this algorithm that comes with the suite
    trace: str = ""  # name of the line on which it is a point of the frontier

    def __post_init__(self) -> None:
        if self.train is not None and self.tune is not None:
            raise ValueError(f"policy {self.title!r} of a suite has train and tune: give one of them")
        if self.train_under and self.made is None:
            raise ValueError(
                f"policy {self.title!r} of a suite has train_under, and is neither trained nor tuned: give "
                "train or tune, or leave it out"
            )

    @property
    def made(self) -> Training | Tuning | None:
        """What makes it before it flies, if anything."""
        return self.train or self.tune

    @property
    def contender(self) -> str:
        """What policies are compared as: all seeds of an algorithm, or of a tuning, are one."""
        tuned = ", tuned" * (self.tune is not None)
        return self.label or _title(self.name, self.kwargs) + ", shipped" * self.shipped + tuned

    @property
    def title(self) -> str:
        """Label for tables."""
        return self.contender if self.made is None else f"{self.contender}, seed {self.made.seed}"

    def part(self, divisor: float) -> PolicyChoice:
        """The same, made with a small part of the budget."""
        train, tune = self.train and self.train.part(divisor), self.tune and self.tune.part(divisor)
        return replace(self, train=train, tune=tune)

    def to_dict(self) -> dict[str, Any]:
        """As plain values."""
        return asdict(self)

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> PolicyChoice:
        """What `to_dict` gave, also before JSON made lists of tuples, or by a version with fewer fields."""
        given = dict(plain)
        for name, kind in (("train", Training), ("tune", Tuning)):
            given[name] = given.get(name) and kind(**given[name])
        return cls(**with_tuples(given, ("envs", "conditions", "tables")))


def with_tuples(plain: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    """A mapping in which these are tuples, where JSON had lists."""
    return {key: tuple(value) if key in names else value for key, value in plain.items()}


@dataclass(frozen=True, slots=True)
class Part:
    """What --quick keeps of a suite.

    Raises:
        ValueError: If a number is not allowed.
    """

    envs: tuple[str, ...] = ()  # ids or labels; the first environment if empty
    conditions: tuple[str, ...] = ()  # labels; the first two of those environments if empty
    seeds: int = 2  # of trainings and tunings
    episodes: int = 5
    divisor: float = 20.0  # of the budgets of trainings and tunings

    def __post_init__(self) -> None:
        require_whole("seeds of the small part of a suite", self.seeds, 1)
        require_whole("episodes of the small part of a suite", self.episodes, 1)
        if isinstance(self.divisor, bool) or not self.divisor >= 1.0:
            raise ValueError(
                f"divisor of the small part of a suite must be a number >= 1, got {shown(self.divisor)}"
            )


FIRST_PART = Part()  # of a suite that says nothing else


def is_for(names: tuple[str, ...], env: EnvChoice) -> bool:
    """Whether a policy or condition that names these environments, or none, is for one."""
    return not names or env.id in names or env.title in names


def flies_in(policy: PolicyChoice, env: EnvChoice) -> bool:
    """Whether a policy is for an environment."""
    return is_for(policy.envs, env) and (not env.tables or bool(set(env.tables) & set(policy.tables)))


def _title(name: str, kwargs: Mapping[str, Any]) -> str:
    """Name and arguments as a folder holds them, so that what is read there has the title that was flown."""
    kwargs = plain_json(kwargs)
    return ", ".join([name, *(f"{key}={value}" for key, value in kwargs.items())])
