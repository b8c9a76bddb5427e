"""`evaluate`: one policy in one environment, over several starts."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .environments import make_env
from .metrics import (
    Estimate,
    Record,
    decision_quantiles,
    measure,
    summarize,
    totals,
    worst_violations,
)
from .policy import Policy
from .results import plain_json
from .rollout import Episode, run_episodes
from .table import format_number, format_table

_UNITS = {
    "score": "-",
    "cost": "-",
    "position_rms": "m",
    "steady_rms": "m",
    "effort": "N^2",
    "settling_time": "s",
    "violation_share": "-",
    "saturation_share": "-",
}


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What `evaluate` found; prints as a table."""

    env_id: str
    policy: str
    seed: int  # of the first flight
    records: tuple[Record, ...]
    decision_ms: tuple[float, float, float]  # p50, p99, max over all decisions, ms; nan if not timed

    def summary(self) -> dict[str, Estimate]:
        """Column -> mean and 95 % interval over the flights."""
        return summarize(self.records)

    def to_dict(self) -> dict[str, Any]:
        """As plain numbers for JSON; what is not a number is None."""
        p50, p99, slowest = self.decision_ms
        found = {
            "env": self.env_id,
            "policy": self.policy,
            "seed": self.seed,
            "episodes": len(self.records),
            "summary": {name: value._asdict() for name, value in self.summary().items()},
            **totals(self.records),
            "iterations_max": max(record.iterations_max for record in self.records),
            "worst_violation": dict(worst_violations(self.records)),
            "decision_ms": {"p50": p50, "p99": p99, "max": slowest},
            "records": [record.row() for record in self.records],
        }
        plain: dict[str, Any] = plain_json(found)
        return plain

    def to_plain(self) -> dict[str, Any]:
        """Everything in it, for storage as JSON; `from_plain` reads it."""
        records = [record._asdict() for record in self.records]
        names = ("env_id", "policy", "seed", "decision_ms")
        found = {name: getattr(self, name) for name in names} | {"records": records}
        plain: dict[str, Any] = plain_json(found)
        return plain

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Evaluation:
        """What `to_plain` stored."""

        def read(value: Any) -> Any:
            return math.nan if value is None else value

        records = (
            Record(**{key: read(value) for key, value in record.items()}) for record in plain["records"]
        )
        p50, p99, slowest = map(read, plain["decision_ms"])
        return cls(plain["env_id"], plain["policy"], plain["seed"], tuple(records), (p50, p99, slowest))

    def __str__(self) -> str:
        rows = []
        for name, value in self.summary().items():
            found = (getattr(record, name) for record in self.records)
            column = [entry for entry in found if math.isfinite(entry) and value.n]
            spread = [min(column), max(column)] if column else [math.nan, math.nan]
            cells = [value.mean, value.half_width, *spread]
            rows.append([name, _UNITS[name], *map(format_number, cells), str(value.n)])
        table = format_table(["metric", "unit", "mean", "+- 95 %", "min", "max", "flights"], rows)
        p50, p99, slowest = map(format_number, self.decision_ms)
        counts = totals(self.records).items()
        counted = ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in counts)
        lines = [
            f"{self.policy} on {self.env_id}, {len(self.records)} flights from seed {self.seed}",
            table,
            f"decisions: p50 {p50} ms, p99 {p99} ms, max {slowest} ms",
            f"counts: {counted}",
        ]
        worst = worst_violations(self.records)
        if worst:
            lines.append("worst violation: " + ", ".join(f"{k} {format_number(v)}" for k, v in worst.items()))
        return "\n".join(lines)


def evaluate(
    policy: Policy,
    env: Any,
    episodes: int = 20,
    seed: int = 0,
    on_episode: Callable[[Episode], None] | None = None,
) -> Evaluation:
    """Fly a policy from several starts and measure it.

    Only numbers are kept of each flight, so that memory does not grow with its length.

    Args:
        policy: From `make_policy`, or anything with `predict`.
        env: An id, a Gymnasium environment (decisions are timed), a vector environment or a ParallelEnv.
        episodes: Number of flights, >= 1.
        seed: Flight i starts with the environment seed `seed + i`.
        on_episode: Called with each flight, to save or plot it.

    Raises:
        ValueError: If the id is unknown or episodes < 1.
    """
    env = make_env(env) if isinstance(env, str) else env
    records, times = [], []
    for episode in run_episodes(policy, env, episodes, seed):
        records.append(measure(episode))
        times.append(episode.decision_times.astype(np.float32))
        if on_episode is not None:
            on_episode(episode)
    env_id, slowness = env.unwrapped.task.env_id, decision_quantiles(np.concatenate(times))
    return Evaluation(env_id, policy_name(policy), seed, tuple(records), slowness)


def policy_name(policy: Any) -> str:
    """Name of a policy for tables."""
    return str(getattr(policy, "name", type(policy).__name__))
