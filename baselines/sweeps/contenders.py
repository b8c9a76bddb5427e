"""Learned policies beside controllers: all training seeds of an algorithm are one contender.

Each column stands for itself. The score alone is compared with statistics, since every flight has one; what a
crash cuts short (cost, RMS) is a mean over flights, and empty where one crashed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from quad_envs.parameters import Array

from ..evaluation.evaluate import Evaluation
from ..evaluation.metrics import summarize, totals, worst_violations
from ..evaluation.statistics import Comparison, Interval, compare
from ..evaluation.table import Table, format_number
from ..evaluation.team_metrics import flight_values
from ..policies.registry import from_outside
from ..training.algorithms import ALGORITHMS
from .suite import PolicyChoice, Suite, is_for
from .units import Unit, training_units

ALL = "all environments"
_MEANS = ("cost", "position_rms", "steady_rms", "effort", "violation_share", "saturation_share")


class Contender(NamedTuple):
    """A controller, or all training seeds of a network, in one environment."""

    env: str
    condition: str
    name: str
    kind: str  # "controller", "model-free", "imitation" or "model-based"; "outside" if it is none of ours
    evaluations: tuple[Evaluation, ...]  # one per training seed
    trainings: tuple[Mapping[str, Any], ...]  # of its networks, if it was trained here

    def row(self) -> dict[str, Any]:
        """Its columns, without comparisons."""
        seeds = [self._seed_means(one) for one in self.evaluations]
        records = [record for one in self.evaluations for record in one.records]
        row: dict[str, Any] = {
            "env": self.env,
            "condition": self.condition,
            "policy": self.name,
            "kind": self.kind,
            "seeds": len(self.evaluations),
            "flights": sum(one.flights for one in self.evaluations),
            **{name: float(np.mean([means[name] for means in seeds])) for name in ("score", *_MEANS)},
            "crashed": sum(totals(one.records)["crashed"] for one in self.evaluations),
            **{f"worst_{name}": value for name, value in worst_violations(records).items()},
        }
        for name, k in (("decision_p50_ms", 0), ("decision_p99_ms", 1)):
            row[name] = float(np.median([one.decision_ms[k] for one in self.evaluations]))
        for name, key in (("training_cpu_s", "cpu_seconds"), ("training_steps", "steps")):
            spent = [training["curve"][-1][key] for training in self.trainings]
            row[name] = float(np.mean(spent)) if spent else math.nan
        return row

    @staticmethod
    def _seed_means(one: Evaluation) -> dict[str, float]:
        return {name: value.mean for name, value in summarize(one.records).items()}

    def values(self, column: str) -> Array:
        """(training seeds, starts), one number per flight."""
        return np.array([list(flight_values(one.records, column).values()) for one in self.evaluations])

    def beside(self, base: Contender, column: str = "score") -> Comparison | None:
        """This beside another in the same environment; None where a crash left no number."""
        ours, theirs = self.values(column), base.values(column)
        if not (np.isfinite(ours).all() and np.isfinite(theirs).all()):
            return None
        return compare([ours], [theirs])


def find_contenders(
    suite: Suite,
    units: Sequence[Unit],
    evaluations: Sequence[Evaluation],
    trainings: Sequence[Mapping[str, Any]],
) -> list[Contender]:
    """All contenders of a suite that flew, in its order.

    Args:
        suite: The suite.
        units: That were flown.
        evaluations: One per unit.
        trainings: One per unit of `training_units`.
    """
    flights = {(unit.env.title, unit.policy.title): one for unit, one in zip(units, evaluations, strict=True)}
    trained = {
        (unit.env.title, unit.policy.title): one
        for unit, one in zip(training_units(suite), trainings, strict=True)
    }
    found = []
    for env in suite.envs:
        groups: dict[str, list[PolicyChoice]] = {}
        for policy in suite.policies:
            if is_for(policy.envs, env):
                groups.setdefault(policy.contender, []).append(policy)
        for condition, flown in suite.flown(env).items():
            for name, policies in groups.items():
                if any((flown.title, policy.title) not in flights for policy in policies):
                    continue
                one = tuple(flights[flown.title, policy.title] for policy in policies)
                costs = [trained[env.title, policy.title] for policy in policies if policy.train is not None]
                found.append(Contender(env.title, condition, name, _kind(policies[0]), one, tuple(costs)))
    return found


def _kind(policy: PolicyChoice) -> str:
    if policy.train is not None or policy.shipped:
        return ALGORITHMS[policy.name].kind
    return "outside" if ":" in policy.name or from_outside(policy.name) else "controller"


def contender_rows(contenders: Sequence[Contender], base: str) -> list[dict[str, Any]]:
    """One row per contender, environment and condition, and one per contender and condition over all.

    Args:
        contenders: Of one suite.
        base: Name of the contender that the others are compared with.
    """
    rows = []
    for one in contenders:
        row = one.row()
        rivals = [other for other in contenders if other[:2] == one[:2]]
        rival = next((other for other in rivals if other.name == base), rivals[0])
        row |= {"base": rival.name} | _compared(one.beside(rival))
        cost = one.beside(rival, "cost")
        row |= _spread("cost_minus_base", None if cost is None else cost.difference)
        rows.append(row)
    return rows + list(_over_all(contenders, base))


def _over_all(contenders: Sequence[Contender], base: str) -> Iterator[dict[str, Any]]:
    """Where a contender and the base flew in several environments: one comparison over all of them."""
    for condition, name in dict.fromkeys((one.condition, one.name) for one in contenders):
        of = {one.env: one for one in contenders if (one.condition, one.name) == (condition, name)}
        rivals = {one.env: one for one in contenders if (one.condition, one.name) == (condition, base)}
        envs = [env for env in of if env in rivals]
        if len(envs) < 2:
            continue
        found = compare(
            [of[env].values("score") for env in envs], [rivals[env].values("score") for env in envs]
        )
        yield {
            "env": ALL,
            "condition": condition,
            "policy": name,
            "kind": of[envs[0]].kind,
            "environments": len(envs),
            "seeds": min(len(of[env].evaluations) for env in envs),
            "score": float(np.mean([of[env].values("score").mean() for env in envs])),
            "base": base,
            "crashed": sum(of[env].row()["crashed"] for env in envs),
            "violation_share": float(np.mean([of[env].row()["violation_share"] for env in envs])),
            **_compared(found),
        }


def _compared(found: Comparison | None) -> dict[str, float]:
    iqm, difference, improvement = found or (None, None, None)
    return _spread("iqm", iqm) | _spread("score_minus_base", difference) | _spread("improvement", improvement)


def _spread(name: str, interval: Interval | None) -> dict[str, float]:
    """An interval as three columns."""
    value, low, high = interval or (math.nan,) * 3
    return {name: value, f"{name}_low": low, f"{name}_high": high}


# Columns of the printed table: title, key, factor. Where they end stand the limits.
_COLUMNS = (
    ("score", "score", 1.0),
    ("IQM", "iqm", 1.0),
    ("- {base}", "score_minus_base", 1.0),
    ("P(better)", "improvement", 1.0),
    ("cost", "cost", 1.0),
    ("- {base}", "cost_minus_base", 1.0),
    ("RMS m", "position_rms", 1.0),
    ("steady m", "steady_rms", 1.0),
    ("effort N^2", "effort", 1.0),
    ("violating %", "violation_share", 100.0),
)
_LAST_COLUMNS = (
    ("saturated %", "saturation_share", 100.0),
    ("p50 ms", "decision_p50_ms", 1.0),
    ("p99 ms", "decision_p99_ms", 1.0),
    ("train CPU-s", "training_cpu_s", 1.0),
    ("train steps", "training_steps", 1.0),
)


def contender_tables(rows: Sequence[Mapping[str, Any]]) -> list[Table]:
    """One table per environment and condition; [low, high] are 95 % bootstrap intervals."""
    keys = dict.fromkeys((row["env"], row["condition"]) for row in rows)
    return [_table([row for row in rows if (row["env"], row["condition"]) == key]) for key in keys]


def _table(rows: Sequence[Mapping[str, Any]]) -> Table:
    limits = [(key.replace("_", " "), key, 1.0) for key in rows[0] if key.startswith("worst_")]
    first, last = (
        [entry for entry in part if any(entry[1] in row for row in rows)]
        for part in (_COLUMNS, _LAST_COLUMNS)
    )
    columns = [*first, *limits]
    header = ["policy", "kind", "seeds", *(title.format(base=rows[0]["base"]) for title, *_ in columns)]
    header += ["crashes", *(title for title, *_ in last)]
    lines = [
        [
            *(row["policy"], row["kind"], str(row["seeds"])),
            *(_cell(row, key, factor) for _, key, factor in columns),
            str(row["crashed"]),
            *(_cell(row, key, factor) for _, key, factor in last),
        ]
        for row in rows
    ]
    title = ", ".join(filter(None, (rows[0]["env"], rows[0]["condition"])))
    return Table((title,), header, lines)


def _cell(row: Mapping[str, Any], key: str, factor: float) -> str:
    text = format_number(factor * row[key])
    if f"{key}_low" not in row or not math.isfinite(row[key]):
        return text
    return f"{text} [{format_number(row[f'{key}_low'], 3)}, {format_number(row[f'{key}_high'], 3)}]"
