"""Learned policies beside controllers: all training seeds of an algorithm are one contender.

Each column stands for itself. The score alone is compared with statistics, since every flight has one; what a
crash cuts short (costs, RMS) is a mean over flights, and empty where one crashed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from quad_envs.parameters import Array

from ..evaluation.column import COUNTED, LESS, MORE, TEAM, Column
from ..evaluation.columns import COLUMNS, limits_in, shown
from ..evaluation.evaluate import Evaluation
from ..evaluation.metrics import summarize, totals, worst_violations
from ..evaluation.statistics import Comparison, Interval, compare
from ..evaluation.table import Table, printed_table
from ..evaluation.team_metrics import flight_values
from ..policies.registry import behind_filter, from_outside
from ..training.algorithms import ALGORITHMS
from .suite import PolicyChoice, Suite, is_for
from .units import Unit, training_units

ALL = "all environments"
_COST = COLUMNS["quadratic_cost"].difference()
# Columns beyond those of summaries: of the score, with intervals, and of training.
SEEDS = Column("Seeds", "", "of the training", COUNTED, name="seeds")
SCORES = {
    column.name: column
    for column in (
        Column("IQM", "", "interquartile mean of the score", MORE, "IQM", "iqm"),
        COLUMNS["score"].difference(),
        Column(
            *("P(better)", "", "probability to score more than {base} on a start", MORE),
            printed="P(better)",
            name="improvement",
        ),
    )
}
TRAININGS = {
    column.name: column
    for column in (
        Column(
            "Training",
            "CPU-s",
            "CPU time of one training, mean of the seeds",
            LESS,
            "train",
            "training_cpu_s",
        ),
        Column("Training", "steps", "environment steps of one training", LESS, "train", "training_steps"),
    )
}


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
            **{name: float(np.mean([means[name] for means in seeds])) for name in seeds[0]},
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
    name = behind_filter(policy.name)
    return "outside" if ":" in name or from_outside(name) else "controller"


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
        cost = one.beside(rival, "quadratic_cost")
        row |= _spread(_COST.name, None if cost is None else cost.difference)
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


def contender_tables(rows: Sequence[Mapping[str, Any]]) -> list[Table]:
    """One table per environment and condition; [low, high] are 95 % bootstrap intervals."""
    keys = dict.fromkeys((row["env"], row["condition"]) for row in rows)
    return [_table([row for row in rows if (row["env"], row["condition"]) == key]) for key in keys]


def _table(rows: Sequence[Mapping[str, Any]]) -> Table:
    beside = {"score": tuple(SCORES.values()), "quadratic_cost": (_COST,)}
    team = any(name in rows[0] for name, column in COLUMNS.items() if column.has(TEAM))
    columns: list[Column] = []
    for column in shown(team, limits_in(rows[0])):
        columns += (column, *beside.get(column.name, ()))
    table = printed_table(rows, [*columns, *TRAININGS.values()], rows[0]["base"], drop_empty=team)
    names = [(row["policy"], row["kind"], str(row["seeds"])) for row in rows]
    lines = [[*name, *cells] for name, cells in zip(names, table.rows, strict=True)]
    title = ", ".join(filter(None, (rows[0]["env"], rows[0]["condition"])))
    return Table((title,), ["policy", "kind", "seeds", *table.header], lines)
