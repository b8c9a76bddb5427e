"""Suites as values: which policies fly in which environments, under which conditions, from which starts.

`suite_files` reads them from TOML, `units` cuts them into what is done in one piece. A suite with a version
is a protocol, whose definition has a digest.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from quad_envs.arguments.checks import require_whole
from quad_envs.arguments.names import shown, unknown_name

from ..evaluation.amounts import require_episodes
from ..files import plain_json
from .choices import (
    FIRST_PART,
    PARTS,
    Condition,
    EnvChoice,
    Part,
    PolicyChoice,
    TableChoice,
    flies_in,
    is_for,
    with_tuples,
)

BEST_MPC = "best MPC"  # `compare_with`: in each environment, condition and table the best of its MPCs
_DIGITS = 16  # of a digest


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
    compare_with: str = (
        ""  # title of the policy from which differences are taken; the first if empty; or BEST_MPC
    )
    conditions: tuple[
        Condition, ...
    ] = ()  # each environment is flown in each; once as it is if there are none
    tables: tuple[TableChoice, ...] = ()  # policies are compared within each; in one if there are none
    small: Part = FIRST_PART  # what `quick` keeps
    protocol: str = ""  # version, if it is one that others repeat
    definition: str = ""  # digest of the whole protocol of which this is a part

    def __post_init__(self) -> None:
        for name in ("name", "compare_with", "protocol"):
            if not isinstance(getattr(self, name), str):
                raise ValueError(f"{name} of a suite must be text, got {shown(getattr(self, name))}")
        require_episodes(f"episodes of suite {self.name!r}", self.episodes)
        require_whole(f"seed of suite {self.name!r}", self.seed, 0)
        for kind in ("envs", "conditions", "tables"):
            self._refuse_twice(kind, [choice.title for choice in getattr(self, kind)])
        for kind in ("envs", "policies"):
            if not getattr(self, kind):
                raise ValueError(f"suite {self.name!r} has no {kind}")
        for env in self.envs:
            self._refuse_twice("policies", [policy.title for policy in self.policies_in(env)])
        self._check_names()
        self._check_flown()
        titles = [policy.title for policy in self.policies]
        if self.compare_with and self.compare_with not in (*titles, BEST_MPC):
            raise ValueError(
                unknown_name(f"compare_with of suite {self.name!r}:", self.compare_with, [*titles, BEST_MPC])
            )

    def _refuse_twice(self, kind: str, titles: Sequence[str]) -> None:
        for title in titles:
            if titles.count(title) > 1:
                raise ValueError(f"suite {self.name!r} has {title!r} twice in {kind}; give them labels")

    def _check_names(self) -> None:
        """Each environment, condition or table that is named is one of those here."""
        known = {
            "envs": list(dict.fromkeys(name for env in self.envs for name in (env.id, env.title))),
            "conditions": [one.label for one in self.conditions],
            "tables": [one.label for one in self.tables],
        }
        singular = {"envs": "environment", "conditions": "condition", "tables": "table"}
        choices: list[tuple[str, Any]] = [(f"policy {one.title!r}", one) for one in self.policies]
        choices += [(f"condition {one.title!r}", one) for one in self.conditions]
        choices += [(f"environment {one.title!r}", one) for one in self.envs]
        for who, choice in [*choices, ("the small part", self.small)]:
            for kind, names in known.items():
                for name in getattr(choice, kind, ()):
                    if name not in names:
                        what = f"{singular[kind]} of {who} in suite {self.name!r}:"
                        raise ValueError(unknown_name(what, name, names))

    def _check_flown(self) -> None:
        """Each environment is flown by some policy under some condition."""
        for env in self.envs:
            if not self.policies_in(env):
                raise ValueError(f"suite {self.name!r} has no policy for {env.title!r}")
            if not self.flown(env):
                raise ValueError(f"suite {self.name!r} has no condition for {env.title!r}")

    def policies_in(self, env: EnvChoice) -> list[PolicyChoice]:
        """Policies that are for an environment."""
        return [policy for policy in self.policies if flies_in(policy, env)]

    def flown(self, env: EnvChoice) -> dict[str, EnvChoice]:
        """Label of each condition that is for an environment -> what is flown; of none "" -> itself."""
        if not self.conditions:
            return {"": env}
        return {one.label: one.of(env) for one in self.conditions if is_for(one.envs, env)}

    @property
    def base(self) -> str:
        """Title of the policy from which differences are taken, or BEST_MPC."""
        return self.compare_with or self.policies[0].title

    @property
    def learned(self) -> bool:
        """Whether policies have seeds, or stand in tables: then contenders are compared."""
        made = any(policy.made is not None or policy.shipped for policy in self.policies)
        return made or bool(self.tables)

    @property
    def digest(self) -> str:
        """Of all that is said here, but for the protocol of which it is a part."""
        said = {key: value for key, value in self.to_dict().items() if key != "definition"}
        for holder, name in (*((env, "tables") for env in said["envs"]), *_trainings(said)):
            if not holder[name]:  # as before it could be said
                del holder[name]
        text = json.dumps(plain_json(said), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:_DIGITS]

    @property
    def whole(self) -> bool:
        """Whether it is a whole protocol, and not a part of one or another suite."""
        return bool(self.protocol) and self.definition == self.digest

    def defined(self) -> Suite:
        """The same as a whole: of a protocol what is later taken out of it knows its digest."""
        return replace(self, definition=self.digest) if self.protocol else self

    def quick(self) -> Suite:
        """A small part, to see it work: few environments, conditions and seeds, small budgets."""
        small, seen = self.small, dict[str, int]()
        envs = [env for env in self.envs if small.envs and is_for(small.envs, env)] or [self.envs[0]]
        conditions = [one for one in self.conditions if any(is_for(one.envs, env) for env in envs)]
        named = [one for one in conditions if one.label in small.conditions]
        kept = []
        for policy in self.policies:
            if not any(flies_in(policy, env) for env in envs):
                continue
            key = f"{policy.contender} {policy.envs}"
            seen[key] = seen.get(key, 0) + 1
            if seen[key] <= small.seeds:
                kept.append(policy.part(small.divisor))
        return replace(
            self._of(envs, kept, named or conditions[:2]),
            name=f"{self.name}-quick",
            episodes=min(self.episodes, small.episodes),
        )

    def only(self, names: Iterable[str]) -> Suite:
        """What is named of it: parts, environments (ids or labels), conditions and tables.

        Raises:
            ValueError: If a name is none of these, or nothing is left.
        """
        asked = list(names)
        known = dict.fromkeys(env.part for env in self.envs) | dict.fromkeys(
            [*(name for env in self.envs for name in (env.title, env.id))]
        )
        known |= dict.fromkeys([one.label for one in self.conditions] + [one.label for one in self.tables])
        for name in asked:
            if name in PARTS and name not in known:
                raise ValueError(f"suite {self.name!r} has no part {name!r} yet; it has {', '.join(known)}")
            if name not in known:
                raise ValueError(unknown_name(f"part of suite {self.name!r}:", name, known))
        conditions = _those(self.conditions, lambda one: one.label in asked)
        envs = [env for env in self.envs if {env.part, env.title, env.id} & set(asked)]
        if not envs:
            envs = _those(self.envs, lambda env: any(is_for(one.envs, env) for one in conditions))
        tables = _those(self.tables, lambda one: one.label in asked)
        labels = {one.label for one in tables}
        policies = [one for one in self.policies if not one.tables or set(one.tables) & labels]
        part = self._of(envs, policies, conditions, tables)
        return part if part == self else replace(part, name="-".join([self.name, *map(_slug, asked)]))

    def _of(
        self,
        envs: Sequence[EnvChoice],
        policies: Sequence[PolicyChoice],
        conditions: Sequence[Condition],
        tables: Sequence[TableChoice] | None = None,
    ) -> Suite:
        """These of its parts, which name nothing that is no longer there."""
        tables = self.tables if tables is None else tables
        asked = {one.label for one in tables}
        envs = [env for env in envs if not env.tables or set(env.tables) & asked] or envs
        tables = [one for one in tables if not self._elsewhere(one, envs)]
        places = {name for env in envs for name in (env.id, env.title)}
        labels = {one.label for one in conditions}
        tabled = {one.label for one in tables}

        def fits(choice: Any, kind: str, names: set[str]) -> bool:
            return not getattr(choice, kind) or bool(set(getattr(choice, kind)) & names)

        def cut(choice: Any) -> Any:
            kinds = {"envs": places, "conditions": labels, "tables": tabled}
            found = {
                kind: tuple(name for name in getattr(choice, kind) if name in names)
                for kind, names in kinds.items()
                if hasattr(choice, kind)
            }
            return replace(choice, **found)

        meant = [one for one in policies if any(flies_in(one, env) for env in envs)]
        kept = [cut(one) for one in meant if fits(one, "conditions", labels)]
        flown = [cut(one) for one in conditions if fits(one, "envs", places)]
        base = self.compare_with if self.compare_with in {BEST_MPC, *(one.title for one in kept)} else ""
        return replace(
            self,
            envs=tuple(map(cut, envs)),
            policies=tuple(kept),
            conditions=tuple(flown),
            tables=tuple(tables),
            small=cut_small(self.small, places, {one.label for one in flown}),
            compare_with=base,
        )

    def _elsewhere(self, table: TableChoice, envs: Sequence[EnvChoice]) -> bool:
        """Whether all policies that stand in a table are for other environments."""
        there = [one for one in self.policies if table.label in one.tables]
        return bool(there) and not any(flies_in(one, env) for one in there for env in envs)

    def to_dict(self) -> dict[str, Any]:
        """As plain values, the form of the TOML file."""
        return asdict(self)

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Suite:
        """What `to_dict` gave, unchecked: its policies may be folders that are no longer there."""
        parts = {
            "envs": tuple(EnvChoice(**with_tuples(env, ("tables",))) for env in plain["envs"]),
            "policies": tuple(map(PolicyChoice.from_dict, plain["policies"])),
            "conditions": tuple(Condition(**with_tuples(one, ("envs",))) for one in plain["conditions"]),
            "tables": tuple(TableChoice(**one) for one in plain.get("tables", ())),
            "small": Part(**with_tuples(plain.get("small", {}), ("envs", "conditions"))),
        }
        return cls(**{**plain, **parts})


def cut_small(small: Part, envs: set[str], conditions: set[str]) -> Part:
    """The small part of a suite that has no more than these."""
    return replace(
        small,
        envs=tuple(name for name in small.envs if name in envs),
        conditions=tuple(name for name in small.conditions if name in conditions),
    )


def _trainings(said: Mapping[str, Any]) -> list[tuple[dict[str, Any], str]]:
    """The trainings in a suite as plain values, each with the key that says from what they go on."""
    return [(policy["train"], "start_from") for policy in said["policies"] if policy["train"]]


def _those(choices: Sequence[Any], wanted: Callable[[Any], bool]) -> list[Any]:
    """Those that are wanted; all if none is."""
    return [one for one in choices if wanted(one)] or list(choices)


def _slug(text: str) -> str:
    return "".join(c if c.isalnum() else "-" for c in text.rsplit("/", 1)[-1]).strip("-").lower()
