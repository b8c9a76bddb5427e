"""Suites: which policies fly in which environments, read from small TOML files.

name = "mine"
episodes = 10
seed = 0
compare_with = "lmpc"        # label of the policy from which differences are taken

envs = "all"                 # or a list of tables
[[policies]]
name = "sdc-nmpc"
label = "sdc-nmpc, N 15"
kwargs = {horizon = 15}

"all" means the tracking ids, or policies. Multi-agent ids are named, and a policy that is not for all of the
suite's environments says for which it is: `envs = ["quad/Formation-v0"]`, ids or labels.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from quad_envs.names import unknown_name
from quad_envs.registration import TEAMS, TRACKING

from .policy import TEAM_POLICIES, TRACKING_POLICIES

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


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
class PolicyChoice:
    """A policy of a suite."""

    name: str
    kwargs: dict[str, Any] = field(default_factory=dict)
    label: str = ""
    envs: tuple[str, ...] = ()  # ids or labels of the environments in which it flies; all if empty

    @property
    def title(self) -> str:
        """Label for tables."""
        return self.label or _title(self.name, self.kwargs)

    def flies_in(self, env: EnvChoice) -> bool:
        """Whether it is for an environment of the suite."""
        return not self.envs or env.id in self.envs or env.title in self.envs


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

    def __post_init__(self) -> None:
        for name in ("name", "compare_with"):
            if not isinstance(getattr(self, name), str):
                raise ValueError(f"{name} of a suite must be text, got {getattr(self, name)!r}")
        for name, least in (("episodes", 1), ("seed", 0)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ValueError(
                    f"{name} of suite {self.name!r} must be a whole number >= {least}, got {value!r}"
                )
        for kind, choices in (("envs", self.envs), ("policies", self.policies)):
            titles = [choice.title for choice in choices]
            if not titles:
                raise ValueError(f"suite {self.name!r} has no {kind}")
            for title in titles:
                if titles.count(title) > 1:
                    raise ValueError(f"suite {self.name!r} has {title!r} twice in {kind}; give them labels")
        self._check_pairs()
        titles = [policy.title for policy in self.policies]
        if self.compare_with and self.compare_with not in titles:
            raise ValueError(unknown_name(f"compare_with of suite {self.name!r}:", self.compare_with, titles))

    def _check_pairs(self) -> None:
        """Each name in `envs` of a policy is one of an environment here, and each environment is flown."""
        known = list(dict.fromkeys(name for env in self.envs for name in (env.id, env.title)))
        for policy in self.policies:
            for name in policy.envs:
                if name not in known:
                    what = f"environment of policy {policy.title!r} in suite {self.name!r}"
                    raise ValueError(unknown_name(what, name, known))
        for env in self.envs:
            if not any(policy.flies_in(env) for policy in self.policies):
                raise ValueError(f"suite {self.name!r} has no policy for {env.title!r}")

    @property
    def base(self) -> str:
        """Title of the policy from which differences are taken."""
        return self.compare_with or self.policies[0].title

    def to_dict(self) -> dict[str, Any]:
        """As plain values, the form of the TOML file."""
        return asdict(self)


_Choice = TypeVar("_Choice", EnvChoice, PolicyChoice)


def suite_from_dict(data: Mapping[str, Any], name: str = "suite") -> Suite:
    """A suite from the values of a TOML file.

    Raises:
        ValueError: If a key is unknown, one that is needed is missing, or a value is not allowed.
    """
    known = [entry.name for entry in fields(Suite)]
    for key in data:
        if key not in (*known, "description"):
            raise ValueError(unknown_name(f"key of suite {name!r}:", key, known))
    for key in ("envs", "policies"):
        if key not in data:
            raise ValueError(f'suite {name!r} needs {key}: a list of tables, or "all"')
    given = {key: value for key, value in data.items() if key != "description"}
    given["envs"] = _choices(EnvChoice, "id", data["envs"], list(TRACKING), list(TEAMS), name)
    policies = list(TRACKING_POLICIES), [key for key in TEAM_POLICIES if key not in TRACKING_POLICIES]
    given["policies"] = _choices(PolicyChoice, "name", data["policies"], *policies, name)
    return Suite(**{"name": name, **given})


def _choices(
    kind: type[_Choice], key: str, entries: Any, every: Sequence[str], more: Sequence[str], suite: str
) -> tuple[_Choice, ...]:
    """The tables of a list, or every name; `more` are names that "all" leaves out."""
    if entries == "all":
        entries = [{key: name} for name in every]
    if not isinstance(entries, Sequence) or isinstance(entries, str):
        raise ValueError(
            f'suite {suite!r}: choose from a list of tables with {key!r}, or "all"; got {entries!r}'
        )
    out, known = [], [entry.name for entry in fields(kind)]
    for entry in entries:
        if not isinstance(entry, str | Mapping):
            raise ValueError(f"suite {suite!r}: choose by name or by a table with {key!r}, got {entry!r}")
        table: dict[str, Any] = {key: entry} if isinstance(entry, str) else dict(entry)
        for name in table:
            if name not in known:
                raise ValueError(unknown_name(f"key in suite {suite!r}:", name, known))
        if key not in table:
            raise ValueError(f"suite {suite!r}: each table needs {key!r}, got {table}")
        if table[key] not in (*every, *more):
            raise ValueError(unknown_name(f"{key} in suite {suite!r}:", table[key], [*every, *more]))
        if not isinstance(table.get("kwargs", {}), Mapping):
            raise ValueError(
                f"suite {suite!r}: kwargs of {table[key]!r} must be a table, as {{horizon = 15}}, "
                f"got {table['kwargs']!r}"
            )
        if not isinstance(table.get("label", ""), str):
            raise ValueError(
                f"suite {suite!r}: the label of {table[key]!r} must be text, got {table['label']!r}"
            )
        if "envs" in table:
            table["envs"] = _names(table["envs"], table[key], suite)
        out.append(kind(**table))
    return tuple(out)


def _names(value: Any, policy: str, suite: str) -> tuple[str, ...]:
    """The environments of a policy."""
    if not isinstance(value, list | tuple) or not value or not all(isinstance(name, str) for name in value):
        raise ValueError(
            f"suite {suite!r}: envs of {policy!r} must be a list of ids or labels, got {value!r}; without "
            "it the policy flies everywhere"
        )
    return tuple(value)


def suite_names() -> dict[str, str]:
    """Shipped suites and what they are."""
    files = sorted(resources.files("baselines").joinpath("suites").iterdir(), key=lambda file: file.name)
    toml = [file for file in files if file.name.endswith(".toml")]
    return {
        file.name[:-5]: str(tomllib.loads(file.read_text("utf-8")).get("description", "")) for file in toml
    }


def load_suite(source: str | Path | Mapping[str, Any] | Suite) -> Suite:
    """A shipped suite by name, one from a TOML file, from a mapping, or as it is.

    Raises:
        ValueError: If it does not exist or is not valid.
    """
    if isinstance(source, Suite):
        return source
    if isinstance(source, Mapping):
        return suite_from_dict(source)
    path = Path(source)
    if path.suffix == ".toml":
        if not path.is_file():
            raise ValueError(
                f"there is no suite file {str(path)!r}; shipped suites: {', '.join(suite_names())}"
            )
        return _read_suite(path)
    if str(source) not in suite_names():
        raise ValueError(unknown_name("suite", str(source), suite_names()) + "; or the path of a .toml file")
    text = resources.files("baselines").joinpath("suites", f"{source}.toml").read_text("utf-8")
    return suite_from_dict(tomllib.loads(text), path.stem)


def _read_suite(path: Path) -> Suite:
    """The suite of a file; every complaint names the file."""
    try:
        return suite_from_dict(tomllib.loads(path.read_text("utf-8")), path.stem)
    except OSError as error:
        raise ValueError(f"cannot read suite file {str(path)!r}: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"suite file {str(path)!r} is not valid TOML: {error}") from error
    except ValueError as error:
        raise ValueError(f"suite file {str(path)!r}: {error}") from error


class Unit(NamedTuple):
    """What is flown in one piece."""

    number: int
    env: EnvChoice
    policy: PolicyChoice
    episodes: int
    seed: int
    episode_folder: Path | None  # where to save flights
    flights_saved: int = 0  # how many, the first ones

    @property
    def file_name(self) -> str:
        """Name of its file in cells/."""
        slug = "".join(c if c.isalnum() else "-" for c in f"{self.env.title}--{self.policy.title}")
        return f"{self.number:03d}-{slug[:80]}.json"

    def episode_file(self, seed: int) -> Path | None:
        """File of the flight with a seed; None if it is not saved."""
        if self.episode_folder is None or seed >= self.seed + self.flights_saved:
            return None
        return self.episode_folder / f"{self.file_name.removesuffix('.json')}-{seed}.npz"

    def episode_files(self) -> list[Path]:
        """Files of its flights that are saved."""
        files = (self.episode_file(self.seed + i) for i in range(self.episodes))
        return [file for file in files if file is not None]


def suite_units(suite: Suite, episode_folder: Path | None = None, flights_saved: int = 0) -> list[Unit]:
    """All environments x policies that are for them; the first `flights_saved` flights go to the folder."""
    pairs = [(env, policy) for env in suite.envs for policy in suite.policies if policy.flies_in(env)]
    return [
        Unit(i, env, policy, suite.episodes, suite.seed, episode_folder, flights_saved)
        for i, (env, policy) in enumerate(pairs)
    ]
