"""One policy in one environment, or one team of its vehicles, over several starts: what it is worth."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from quad_envs.parameters import Array
from quad_envs.tasks import BaseTask, TeamTask

from ..files import plain_json
from ..policies.environments import make_env
from ..policies.outside import is_policy
from ..policies.protocol import Policy
from ..policies.registry import make_policy, policy_name
from .column import CUT_SHORT, PERCENT, REPORTED, Column
from .columns import COLUMNS, Record, read_record
from .episode import Episode
from .metrics import (
    Estimate,
    crash_causes,
    decision_quantiles,
    measure,
    said_causes,
    summarize,
    totals,
    worst_violations,
)
from .rollout import check_flights, is_privileged, run_episodes, time_decisions, with_times
from .row_forms import has_row_form, row_form
from .rows import row_episodes
from .statistics import Interval
from .table import Table, format_number, said_interval
from .tails import tails
from .team_metrics import by_flight, flight_values, has_team

_NOT_TIMED = (math.nan, math.nan, math.nan)
NO_SPANNING_TREE = (
    "no spanning tree: from the leader, or from those who measure, news does not reach every vehicle, "
    "and who is not reached cannot follow"
)


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What `evaluate` found; prints as a table."""

    env_id: str
    policy: str
    seed: int  # of the first flight
    records: tuple[Record, ...]
    decision_ms: tuple[float, float, float]  # p50, p99, max over all decisions, ms; nan if not timed
    team_ms: tuple[float, float, float] = _NOT_TIMED  # the same for all vehicles of a team at once
    vehicles: int = 1  # of a team
    spanning_tree: bool | None = None  # whether news can reach every vehicle of a team; None for one vehicle
    privileged: bool = False  # whether the policy saw the whole truth

    @property
    def title(self) -> str:
        """Name of the policy for tables, which says if it is privileged."""
        return f"{self.policy} (privileged)" if self.privileged else self.policy

    @property
    def flights(self) -> int:
        """Flights, each of one vehicle or of one team."""
        return len(by_flight(self.records))

    @property
    def notes(self) -> tuple[str, ...]:
        """What one has to know to read the numbers."""
        return (NO_SPANNING_TREE,) if self.spanning_tree is False else ()

    def summary(self) -> dict[str, Estimate]:
        """Column -> mean and 95 % interval over the flights."""
        return summarize(self.records)

    def tails(self) -> dict[str, Interval]:
        """Column -> how bad rare flights are, see `tails`; empty below 1000 flights."""
        return tails(self.records)

    def to_dict(self) -> dict[str, Any]:
        """As plain numbers for JSON; what is not a number is None."""
        p50, p99, slowest = self.decision_ms
        rare = {name: value._asdict() for name, value in self.tails().items()}
        found = {
            "env": self.env_id,
            "policy": self.title,
            "seed": self.seed,
            "episodes": self.flights,
            "summary": {name: value._asdict() for name, value in self.summary().items()},
            **totals(self.records),
            "crash_causes": crash_causes(self.records),
            **({"tails": rare} if rare else {}),
            "iterations_max": max(record.iterations_max for record in self.records),
            "worst_violation": dict(worst_violations(self.records)),
            "decision_ms": {"p50": p50, "p99": p99, "max": slowest},
            **self._of_team(),
            "records": [record.row() for record in self.records],
        }
        plain: dict[str, Any] = plain_json(found)
        return plain

    def _of_team(self) -> dict[str, Any]:
        """What only a team has."""
        if self.spanning_tree is None:
            return {}
        return {
            "vehicles": self.vehicles,
            "privileged": self.privileged,
            "spanning_tree": self.spanning_tree,
            "notes": self.notes,
            "team_decision_ms": dict(zip(("p50", "p99", "max"), self.team_ms, strict=True)),
        }

    def to_plain(self) -> dict[str, Any]:
        """Everything in it, for storage as JSON; `from_plain` reads it."""
        records = [record._asdict() for record in self.records]
        found = {entry.name: getattr(self, entry.name) for entry in fields(self)} | {"records": records}
        plain: dict[str, Any] = plain_json(found)
        return plain

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Evaluation:
        """What `to_plain` stored."""

        def read(value: Any) -> Any:
            return math.nan if value is None else value

        times = {name: tuple(map(read, plain[name])) for name in ("decision_ms", "team_ms")}
        return cls(**{**plain, **times, "records": tuple(map(read_record, plain["records"]))})

    @classmethod
    def joined(cls, parts: Sequence[Evaluation], starts: range) -> Evaluation:
        """One evaluation of what several found of the same policy in the same environment.

        Args:
            parts: Each of some starts.
            starts: Those that are wanted, by their seeds. Decision times are those of the first part.
        """
        parts = sorted(parts, key=lambda part: part.seed)
        records = tuple(record for part in parts for record in part.records if record.seed in starts)
        return replace(parts[0], seed=starts.start, records=records)

    def __str__(self) -> str:
        return str(self._table())

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        return self._table().html()

    def _table(self) -> Table:
        rows = []
        for name, value in self.summary().items():
            found = flight_values(self.records, name)
            if not self._tells(name, found.values()):
                continue
            finite = [number for number in found.values() if math.isfinite(number)]
            spread = (min(finite), max(finite)) if math.isfinite(value.mean) else (math.nan, math.nan)
            cells = [value.mean, value.half_width, *spread]
            rows.append([name, COLUMNS[name].unit or "-", *map(format_number, cells), str(value.n)])
        counts = totals(self.records).items()
        counted = ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in counts)
        of_team = f" of {self.vehicles} vehicles" if has_team(self.records) else ""
        flights = f"{self.flights} flight{'s' * (self.flights != 1)}{of_team}"
        title = f"{self.title} on {self.env_id}, {flights} from seed {self.seed}"
        notes = (f"note: {note}" for note in self.notes)
        lines = [f"decisions: {_times(self.decision_ms)}" + (" per vehicle" if of_team else "")]
        if of_team:
            lines.append(f"decisions of the whole team: {_times(self.team_ms)}")
        lines.append(f"counts: {counted}")
        worst = worst_violations(self.records)
        if crash_causes(self.records):
            lines.append(f"crashes by: {said_causes(self.records)}")
        lines += [_tail_line(COLUMNS[name], value) for name, value in self.tails().items()]
        if worst:
            lines.append("worst violation: " + ", ".join(f"{k} {format_number(v)}" for k, v in worst.items()))
        header = ["metric", "unit", "mean", "+- 95 %", "min", "max", "flights"]
        return Table((title, *notes), header, rows, tuple(lines))

    def _tells(self, name: str, values: Iterable[float]) -> bool:
        """Whether a column has anything to say: a number, or that a crash left none."""
        if COLUMNS[name].has(REPORTED):
            return any(map(math.isfinite, values))
        if not has_team(self.records):
            return True
        lost = COLUMNS[name].has(CUT_SHORT) and not name.startswith("estimate")
        return any(map(math.isfinite, values)) or (lost and any(record.crashed for record in self.records))


def _tail_line(column: Column, value: Interval) -> str:
    """How bad rare flights are, as "Position RMS, 99.9 %: 0.21 m [0.2, 0.23]"."""
    unit = "%" if column.has(PERCENT) else column.unit
    shown = Interval(*(column.factor * number for number in value))
    return f"{column.title}: {said_interval(*shown, unit)}, 95 % interval"


def _times(quantiles: tuple[float, float, float]) -> str:
    p50, p99, slowest = map(format_number, quantiles)
    return f"p50 {p50} ms, p99 {p99} ms, max {slowest} ms"


def _side_by_side(policy: Policy, env: Any, episodes: int, seed: int) -> Iterator[Episode]:
    return row_episodes(policy, row_form(env, episodes), episodes, seed, refill=True)


def fly_and_measure(
    policy: Policy | Any,
    env: Any,
    episodes: int = 20,
    seed: int = 0,
    on_episode: Callable[[Episode], None] | None = None,
    *,
    mismatch: bool = False,
    timed: Sequence[Array] | None = None,
) -> Evaluation:
    """What `evaluate` does where nothing is to be written.

    Flights go side by side where there is a row form, see `row_forms`. Only numbers are kept of each. A team
    gives one record per vehicle and flight; means and intervals are over flights.

    The arguments are those of `baselines.evaluate`. `timed` are decision times that `time_decisions` has
    found, or none; None to find them now, where flights go side by side.

    Raises:
        ValueError: If the id or the policy's name is unknown, episodes < 1, or as `run_episodes` says.
    """
    env, size = make_env(env) if isinstance(env, str) else env, 1
    name = policy if isinstance(policy, str) else ""
    policy = policy if is_policy(policy) else make_policy(policy, env)
    check_flights(policy, env, episodes, seed, mismatch)
    episodes, seed = int(episodes), int(seed)  # numpy's whole numbers are no seeds of Gymnasium
    if has_row_form(policy, env):
        timed = time_decisions(policy, env, seed) if timed is None else timed
        flights = with_times(_side_by_side(policy, env, episodes, seed), seed, timed)
    else:
        timed, flights = None, run_episodes(policy, env, episodes, seed, mismatch=mismatch)
    records, times = [], []
    for episode in flights:
        records.append(measure(episode))
        size = episode.team_size
        if timed is None:
            times.append(episode.decision_times.astype(np.float32))
        if on_episode is not None:
            on_episode(episode)
    seconds = np.concatenate([np.zeros(0), *(times if timed is None else timed)], dtype=np.float64)
    task: BaseTask = env.unwrapped.task
    return Evaluation(
        env_id=task.env_id,
        policy=policy_name(policy, name),
        seed=seed,
        records=tuple(records),
        decision_ms=decision_quantiles(seconds),
        team_ms=decision_quantiles(size * seconds) if size > 1 else _NOT_TIMED,
        vehicles=size,
        spanning_tree=task.spanning_tree if isinstance(task, TeamTask) else None,
        privileged=is_privileged(policy),
    )
