"""Results of a suite: the tables in which policies stand side by side."""

from __future__ import annotations

import html
from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple, TypeVar

from ..evaluation.column import COMPARED, Column
from ..evaluation.columns import COLUMNS, fallbacks, limits_in, shown
from ..evaluation.evaluate import NO_SPANNING_TREE, Evaluation
from ..evaluation.metrics import paired_difference, said_causes, totals, worst_violations
from ..evaluation.table import Table, printed_table
from ..files import plain_json
from .choices import EnvChoice
from .contenders import contender_rows, contender_tables, find_contenders, plans, rank_of
from .protocol import protocol_facts
from .suite import BEST_MPC, Suite
from .units import Unit, suite_units

T = TypeVar("T")
_INTERVAL = Column("", "", "half width of its 95 % interval", printed="+-", name="score_minus_base_ci")


class Failure(NamedTuple):
    """A policy that did not fly in an environment."""

    env: str  # title
    policy: str  # title
    message: str  # what went wrong; of a policy from outside it names the line of its file

    def __str__(self) -> str:
        return f"{self.policy} did not fly in {self.env}: {self.message}"


@dataclass(frozen=True, slots=True)
class Results:
    """What `run_benchmark` found; prints as one table per environment."""

    suite: Suite
    evaluations: tuple[Evaluation, ...]  # one per unit of `flown`
    trainings: tuple[Mapping[str, Any], ...] = ()  # one per unit of `training_units`; empty if it failed
    failures: tuple[Failure, ...] = ()
    _known: dict[Any, Any] = field(default_factory=dict, init=False, repr=False, compare=False)  # by `_once`

    def _once(self, what: Hashable, make: Callable[[], T]) -> T:
        """What follows from the results is found once: tables and pages ask for it many times."""
        if what not in self._known:
            self._known[what] = make()
        found: T = self._known[what]
        return found

    def flown(self) -> list[Unit]:
        """Units of the suite but those that failed."""
        return list(self._once("units", self._find_units))

    def _find_units(self) -> list[Unit]:
        failed = {(one.env, one.policy) for one in self.failures}
        return [unit for unit in suite_units(self.suite) if (unit.env.title, unit.policy.title) not in failed]

    def get(self, env: str, policy: str) -> Evaluation:
        """The evaluation of a policy in an environment, by their titles."""
        found = self._once("evaluations", self._by_titles).get((env, policy))
        if found is not None:
            return found
        why = [f": {one.message}" for one in self.failures if (one.env, one.policy) == (env, policy)]
        raise KeyError(f"no evaluation of {policy!r} in {env!r}{''.join(why)}")

    def _by_titles(self) -> dict[tuple[str, str], Evaluation]:
        flown = zip(self.flown(), self.evaluations, strict=True)
        return {(unit.env.title, unit.policy.title): evaluation for unit, evaluation in flown}

    def rows(self) -> list[dict[str, Any]]:
        """One row per environment x policy x flight, of a team one per vehicle (column agent)."""
        return list(self.each_row())

    def each_row(self) -> Iterator[dict[str, Any]]:
        """Those rows one after another: of many flights they would take far more memory than the flights."""
        for unit, evaluation in zip(self.flown(), self.evaluations, strict=True):
            for record in evaluation.records:
                yield {"env": unit.env.title, "policy": unit.policy.title, **record.row()}

    def row_columns(self) -> list[str]:
        """Their columns."""
        firsts = (evaluation.records[0].row() for evaluation in self.evaluations)
        return list(dict.fromkeys(["env", "policy", *(name for row in firsts for name in row)]))

    def summary(self) -> list[dict[str, Any]]:
        """One row per environment x policy: means, half widths (_ci), paired differences (_minus_base)."""
        return [dict(row) for row in self._once("summary", self._summary)]

    def _summary(self) -> list[dict[str, Any]]:
        return [self._summary_row(unit) for unit in self.flown()]

    def base_of(self, env: str) -> str:
        """Title of the policy from which differences are taken: the suite's, else the first flown there."""
        return self._once(("base", env), partial(self._find_base, env))

    def _find_base(self, env: str) -> str:
        flown = [unit.policy for unit in self.flown() if unit.env.title == env]
        titles = [policy.title for policy in flown]
        if self.suite.base == BEST_MPC:
            mpcs = [policy.title for policy in flown if plans(policy) and not policy.trace]
            return min(mpcs, key=lambda title: rank_of([self.get(env, title)]), default=titles[0])
        return self.suite.base if self.suite.base in titles else titles[0]

    def _summary_row(self, unit: Unit) -> dict[str, Any]:
        ours = self.get(unit.env.title, unit.policy.title)
        base = self.get(unit.env.title, self.base_of(unit.env.title))
        row: dict[str, Any] = {
            "env": unit.env.title,
            "policy": unit.policy.title,
            "episodes": ours.flights,
        }
        summary = ours.summary()
        for name, value in summary.items():
            row[name], row[f"{name}_ci"] = value.mean, value.half_width
        for name in summary:
            if COLUMNS[name].has(COMPARED):
                difference = paired_difference(ours.records, base.records, name)
                row[f"{name}_minus_base"], row[f"{name}_minus_base_ci"] = (
                    difference.mean,
                    difference.half_width,
                )
        for name, tail in ours.tails().items():
            row |= {name: tail.value, f"{name}_low": tail.low, f"{name}_high": tail.high}
        row |= totals(ours.records) | {"crash_causes": said_causes(ours.records)}
        row["iterations_max"] = max(record.iterations_max for record in ours.records)
        row |= {f"worst_{name}": value for name, value in worst_violations(ours.records).items()}
        row |= _timed("decision", ours.decision_ms)
        if ours.spanning_tree is not None:
            row |= _timed("team", ours.team_ms)
            row |= {name: getattr(ours, name) for name in ("vehicles", "privileged", "spanning_tree")}
        return row

    def contender_rows(self) -> list[dict[str, Any]]:
        """One row per environment x contender, where all training seeds of an algorithm are one contender."""
        return [dict(row) for row in self._once("contenders", self._contender_rows)]

    def _contender_rows(self) -> list[dict[str, Any]]:
        names = {policy.title: policy.contender for policy in self.suite.policies} | {BEST_MPC: BEST_MPC}
        contenders = find_contenders(self.suite, self.flown(), self.evaluations, self.trainings)
        tables = [one.label for one in self.suite.tables] or [""]
        return contender_rows(contenders, names[self.suite.base], tables)

    def to_dict(self) -> dict[str, Any]:
        """As plain numbers for JSON."""
        found: dict[str, Any] = {
            "suite": self.suite.to_dict(),
            "evaluations": [one.to_dict() for one in self.evaluations],
            "failures": [one._asdict() for one in self.failures],
        }
        if self.suite.protocol:
            found["protocol"] = protocol_facts(self.suite)
        if self.suite.learned:
            found |= {
                "contenders": plain_json(self.contender_rows()),
                "trainings": [one for one in self.trainings if one],
            }
        return found

    def __str__(self) -> str:
        return "\n\n".join([*map(str, self._tables()), *map(str, self.failures)])

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        failures = (f"<div>{html.escape(str(one))}</div>" for one in self.failures)
        return "".join([*(table.html() for table in self._tables()), *failures])

    def _tables(self) -> list[Table]:
        """One per environment."""
        if self.suite.learned:
            return contender_tables(self.contender_rows())
        flown = dict.fromkeys(unit.env.title for unit in self.flown())
        envs = [one for env in self.suite.envs for one in self.suite.flown(env).values()]
        return [self._table(env) for env in envs if env.title in flown]

    def _table(self, env: EnvChoice) -> Table:
        rows = [{**row, "fallbacks": fallbacks(row)} for row in self.summary() if row["env"] == env.title]
        team = "vehicles" in rows[0]
        columns: list[Column] = []
        for column in shown(team, limits_in(rows[0])):
            columns += (column, column.difference(), _INTERVAL) if column.name == "score" else (column,)
        table = printed_table(rows, columns, self.base_of(env.title), drop_empty=team)
        names = [row["policy"] + (" (privileged)" if row.get("privileged") else "") for row in rows]
        lines = [[name, *cells] for name, cells in zip(names, table.rows, strict=True)]
        seeds = f"seeds {self.suite.seed} to {self.suite.seed + self.suite.episodes - 1}"
        notes = () if rows[0].get("spanning_tree", True) else (f"note: {NO_SPANNING_TREE}",)
        return Table((f"{env.title}, {seeds}", *notes), ["policy", *table.header], lines)


def _timed(what: str, quantiles: tuple[float, float, float]) -> dict[str, float]:
    return dict(zip((f"{what}_p50_ms", f"{what}_p99_ms", f"{what}_max_ms"), quantiles, strict=True))
