"""Results of a suite: the tables in which policies stand side by side."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from .evaluation import Evaluation
from .metrics import paired_difference, totals, worst_violations
from .suite import EnvChoice, Suite, Unit, suite_units
from .table import format_number, format_table

COMPARED = ("score", "cost", "position_rms", "effort")  # columns with paired differences


@dataclass(frozen=True, slots=True)
class Results:
    """What `run_benchmark` found; prints as one table per environment."""

    suite: Suite
    evaluations: tuple[Evaluation, ...]  # environments x policies, in the order of the suite

    def get(self, env: str, policy: str) -> Evaluation:
        """The evaluation of a policy in an environment, by their titles."""
        for unit, evaluation in zip(suite_units(self.suite), self.evaluations, strict=True):
            if (unit.env.title, unit.policy.title) == (env, policy):
                return evaluation
        raise KeyError(f"no evaluation of {policy!r} in {env!r}")

    def rows(self) -> list[dict[str, Any]]:
        """One row per environment x policy x flight."""
        units = suite_units(self.suite)
        return [
            {"env": unit.env.title, "policy": unit.policy.title, **record.row()}
            for unit, evaluation in zip(units, self.evaluations, strict=True)
            for record in evaluation.records
        ]

    def summary(self) -> list[dict[str, Any]]:
        """One row per environment x policy: means, half widths (_ci), paired differences (_minus_base)."""
        return [self._summary_row(unit) for unit in suite_units(self.suite)]

    def _summary_row(self, unit: Unit) -> dict[str, Any]:
        ours, base = self.get(unit.env.title, unit.policy.title), self.get(unit.env.title, self.suite.base)
        row: dict[str, Any] = {
            "env": unit.env.title,
            "policy": unit.policy.title,
            "episodes": len(ours.records),
        }
        for name, value in ours.summary().items():
            row[name], row[f"{name}_ci"] = value.mean, value.half_width
        for name in COMPARED:
            difference = paired_difference(ours.records, base.records, name)
            row[f"{name}_minus_base"], row[f"{name}_minus_base_ci"] = difference.mean, difference.half_width
        row |= totals(ours.records)
        row["iterations_max"] = max(record.iterations_max for record in ours.records)
        row |= {f"worst_{name}": value for name, value in worst_violations(ours.records).items()}
        row |= dict(
            zip(("decision_p50_ms", "decision_p99_ms", "decision_max_ms"), ours.decision_ms, strict=True)
        )
        return row

    def to_dict(self) -> dict[str, Any]:
        """As plain numbers for JSON."""
        return {"suite": self.suite.to_dict(), "evaluations": [one.to_dict() for one in self.evaluations]}

    def __str__(self) -> str:
        return "\n\n".join(self._table(env) for env in self.suite.envs)

    def _table(self, env: EnvChoice) -> str:
        rows = [row for row in self.summary() if row["env"] == env.title]
        limits = [key for key in rows[0] if key.startswith("worst_")]  # differ in unit, so never merged
        header = ["policy", "score", f"- {self.suite.base}", "+-", "cost", "RMS m", "steady m", "effort N^2"]
        header += ["violating %", *(key.replace("_", " ") for key in limits)]
        header += ["crashes", "saturated %", "p50 ms", "p99 ms", "fallbacks"]
        lines = []
        for row in rows:
            columns = [
                "score",
                "score_minus_base",
                "score_minus_base_ci",
                "cost",
                "position_rms",
                "steady_rms",
                "effort",
            ]
            numbers = [
                *(row[name] for name in columns),
                100.0 * row["violation_share"],
                *(row[key] for key in limits),
            ]
            failed = sum(row[name] for name in ("relaxed", "previous_plan", "clipped_sdre", "hover"))
            times = row["decision_p50_ms"], row["decision_p99_ms"]
            cells = [row["policy"], *map(format_number, numbers), str(row["crashed"])]
            cells += [*map(format_number, (100.0 * row["saturation_share"], *times)), str(failed)]
            lines.append(cells)
        seeds = f"seeds {self.suite.seed} to {self.suite.seed + self.suite.episodes - 1}"
        return f"{env.title}, {seeds}\n{format_table(header, lines)}"
