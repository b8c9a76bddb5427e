"""Learned policies beside controllers: all seeds of a training, or of a tuning, are one contender.

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
from ..evaluation.frontier import Flights, above_frontier
from ..evaluation.metrics import summarize, totals, worst_violations
from ..evaluation.statistics import Comparison, Interval, compare, difference, mean_interval
from ..evaluation.table import Table, printed_table
from ..evaluation.team_metrics import flight_values
from ..policies.registry import behind_filter, from_outside, is_mpc
from ..policies.trained import shipped_kind
from ..training.algorithms import ALGORITHMS
from .choices import PolicyChoice
from .suite import BEST_MPC, Suite
from .units import Unit, training_units

ALL = "all environments"
VIOLATING = 0.01  # share of steps up to which the score alone says which MPC is the best
_COST = COLUMNS["quadratic_cost"].difference()
_ABOUT = "score minus the most that the MPC of the frontier has at this quadratic cost"
_ABOVE = Column("Δ frontier", "", _ABOUT, MORE, "- frontier", "score_minus_frontier")
# Columns beyond those of summaries: of the score, with intervals, and of training.
SEEDS = Column("Seeds", "", "of the training or tuning", COUNTED, name="seeds")
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
        _ABOVE,
    )
}
TRAININGS = {
    column.name: column
    for column in (
        Column(
            "Training",
            "CPU-s",
            "CPU time of one training or tuning, mean of the seeds",
            LESS,
            "train",
            "training_cpu_s",
        ),
        Column("Training", "steps", "environment steps of one training", LESS, "train", "training_steps"),
    )
}
# All that only contenders have.
CONTENDER_COLUMNS = SCORES | {column.name: column for column in (_COST, SEEDS)} | TRAININGS


class Contender(NamedTuple):
    """A controller, or all seeds of a network or a tuned controller, in one environment."""

    env: str
    condition: str
    name: str
    kind: str  # "controller", "tuned", "model-free", "imitation", "model-based"; "outside": none of ours
    mpc: bool
    trace: str  # line of the frontier on which it is a point
    tables: tuple[str, ...]  # in which it stands; all if empty
    evaluations: tuple[Evaluation, ...]  # one per seed
    trainings: tuple[Mapping[str, Any], ...]  # of its networks or tunings, if they were made here

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

    def rank(self) -> tuple[float, ...]:
        """See `rank_of`."""
        return rank_of(self.evaluations)

    def beside(self, base: Contender) -> Comparison:
        """The scores of this beside those of another in the same environment."""
        return compare([self.values("score")], [base.values("score")])

    def flights(self) -> Flights:
        """What places it in the plane of score and quadratic cost."""
        return Flights(self.values("score"), self.values("quadratic_cost"))

    def dearer(self, base: Contender) -> Interval | None:
        """By how much quadratic cost it is dearer than another; None where a crash left no number."""
        ours, theirs = self.values("quadratic_cost"), base.values("quadratic_cost")
        if not (np.isfinite(ours).all() and np.isfinite(theirs).all()):
            return None
        return difference([ours], [theirs])


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
        for policy in suite.policies_in(env):
            groups.setdefault(policy.contender, []).append(policy)
        for condition, flown in suite.flown(env).items():
            for name, policies in groups.items():
                if any((flown.title, policy.title) not in flights for policy in policies):
                    continue
                one = tuple(flights[flown.title, policy.title] for policy in policies)
                costs = [trained[env.title, policy.title] for policy in policies if policy.made is not None]
                found.append(contender_of(env.title, condition, name, policies[0], one, tuple(costs)))
    return found


def contender_of(
    env: str,
    condition: str,
    name: str,
    policy: PolicyChoice,
    evaluations: tuple[Evaluation, ...],
    trainings: tuple[Mapping[str, Any], ...],
) -> Contender:
    """A contender, of which any of its policies says what it is."""
    known = _kind(policy), plans(policy), policy.trace, policy.tables
    return Contender(env, condition, name, *known, evaluations, trainings)


def plans(policy: PolicyChoice) -> bool:
    """Whether it is an MPC, tuned or not."""
    return not (policy.shipped or policy.train) and is_mpc(behind_filter(policy.name))


def rank(crashed: float, violating: float, score: float) -> tuple[float, ...]:
    """Less is better: crashes come before violations of more than VIOLATING, these before the score.

    Args:
        crashed: Share of the flights.
        violating: Share of the steps.
        score: Mean.
    """
    return crashed, max(0.0, violating - VIOLATING), -score


def rank_of(evaluations: Sequence[Evaluation]) -> tuple[float, ...]:
    """The `rank` of flights, all of them alike."""
    records = [record for one in evaluations for record in one.records]
    crashed, violating, score = (
        float(np.mean([getattr(record, name) for record in records]))
        for name in ("crashed", "violation_share", "score")
    )
    return rank(crashed, violating, score)


def _kind(policy: PolicyChoice) -> str:
    if policy.tune is not None:
        return "tuned"
    if policy.train is not None or policy.shipped:
        return ALGORITHMS[policy.name].kind
    name = behind_filter(policy.name)
    known = shipped_kind(name)
    if known:
        return known
    return "outside" if ":" in name or from_outside(name) else "controller"


def contender_rows(
    contenders: Sequence[Contender], base: str, tables: Sequence[str] = ("",)
) -> list[dict[str, Any]]:
    """One row per table, contender, environment and condition, and one per contender over all environments.

    Args:
        contenders: Of one suite.
        base: Name of the contender that the others are compared with, or BEST_MPC.
        tables: Labels of the tables, within each of which contenders are compared.
    """
    rows: list[dict[str, Any]] = []
    for table in tables:
        here = _of_table(contenders, table)
        rivals, families = _rivals(here, base), _families(here)
        for one in here:
            rival = rivals[one.env, one.condition]
            row = {"table": table, **one.row(), "mpc": one.mpc, "trace": one.trace, "base": rival.name}
            row |= _compared(one.beside(rival))
            row |= _spread("score", mean_interval(one.values("score")))
            row |= _spread("quadratic_cost", mean_interval(one.values("quadratic_cost")))
            row |= _spread(_COST.name, one.dearer(rival))
            family = [] if one.trace else families[one.env, one.condition]
            row |= _spread(_ABOVE.name, above_frontier(one.flights(), family))
            rows.append(row)
        rows += [{"table": table, **row} for row in _over_all(here, rivals, base)]
    return rows


def _of_table(contenders: Sequence[Contender], table: str) -> list[Contender]:
    """Those that stand in a table; one that names none stands in all in which its environment is."""
    if not table:
        return list(contenders)
    envs = {one.env for one in contenders if table in one.tables}
    return [one for one in contenders if table in one.tables or (not one.tables and one.env in envs)]


def _rivals(contenders: Sequence[Contender], base: str) -> dict[tuple[str, str], Contender]:
    """With whom those of an environment and a condition are compared."""
    return {key: find_base(group, base) for key, group in _together(contenders).items()}


def _families(contenders: Sequence[Contender]) -> dict[tuple[str, str], list[Flights]]:
    """The points of the frontier of each environment and condition."""
    groups = _together(contenders).items()
    return {key: [one.flights() for one in group if one.trace] for key, group in groups}


def _together(contenders: Sequence[Contender]) -> dict[tuple[str, str], list[Contender]]:
    """Those of each environment and condition."""
    groups: dict[tuple[str, str], list[Contender]] = {}
    for one in contenders:
        groups.setdefault((one.env, one.condition), []).append(one)
    return groups


def find_base(group: Sequence[Contender], base: str) -> Contender:
    """The base among contenders in one environment and condition; the first of them where it did not fly.

    The best MPC is chosen by the flights that are compared: where several are equally good, this favours MPC
    by as much as chance makes one of them lead.
    """
    if base == BEST_MPC:
        return min((one for one in group if one.mpc and not one.trace), key=Contender.rank, default=group[0])
    return next((one for one in group if one.name == base), group[0])


def _over_all(
    contenders: Sequence[Contender], rivals: Mapping[tuple[str, str], Contender], base: str
) -> Iterator[dict[str, Any]]:
    """Where a contender and the base flew in several environments: one comparison over all of them."""
    for condition, name in dict.fromkeys((one.condition, one.name) for one in contenders):
        of = {one.env: one for one in contenders if (one.condition, one.name) == (condition, name)}
        envs = [env for env in of if base in (BEST_MPC, rivals[env, condition].name)]
        if len(envs) < 2:
            continue
        found = compare(
            [of[env].values("score") for env in envs],
            [rivals[env, condition].values("score") for env in envs],
        )
        rows = [of[env].row() for env in envs]
        yield {
            "env": ALL,
            "condition": condition,
            "policy": name,
            "kind": of[envs[0]].kind,
            "trace": of[envs[0]].trace,
            "environments": len(envs),
            "seeds": min(len(of[env].evaluations) for env in envs),
            "score": float(np.mean([of[env].values("score").mean() for env in envs])),
            "base": base,
            "crashed": sum(row["crashed"] for row in rows),
            "flights": sum(row["flights"] for row in rows),
            "violation_share": float(np.mean([row["violation_share"] for row in rows])),
            "decision_p50_ms": float(np.median([row["decision_p50_ms"] for row in rows])),
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
    groups: dict[tuple[str, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["table"], row["env"], row["condition"]), []).append(row)
    return [_table(group) for group in groups.values()]


def _table(rows: Sequence[Mapping[str, Any]]) -> Table:
    traced = any(math.isfinite(row.get(_ABOVE.name, math.nan)) for row in rows)
    beside = {
        "score": [column for column in SCORES.values() if traced or column is not _ABOVE],
        "quadratic_cost": [_COST],
    }
    team = any(name in rows[0] for name, column in COLUMNS.items() if column.has(TEAM))
    columns: list[Column] = []
    for column in shown(team, limits_in(rows[0])):
        columns += (column, *beside.get(column.name, ()))
    table = printed_table(rows, [*columns, *TRAININGS.values()], rows[0]["base"], drop_empty=team)
    names = [(row["policy"], row["kind"], str(row["seeds"])) for row in rows]
    lines = [[*name, *cells] for name, cells in zip(names, table.rows, strict=True)]
    title = ", ".join(filter(None, (rows[0]["table"], rows[0]["env"], rows[0]["condition"])))
    return Table((title,), ["policy", "kind", "seeds", *table.header], lines)
