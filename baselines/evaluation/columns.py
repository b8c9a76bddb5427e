"""The columns of every table, once: a `Record` is one flight in numbers, and says of each what it is.

Summaries, printed tables, CSV files, the page of a report and the table of the documentation are computed
from it: they have the columns in this order.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Annotated, Any, NamedTuple, get_type_hints

from quad_envs.limits import UNITS

from .column import (
    COMPARED,
    COUNTED,
    CUT_SHORT,
    FALLBACK,
    LARGEST,
    LEAST,
    LESS,
    MORE,
    MOST,
    PERCENT,
    REPORTED,
    SINGLE,
    TAIL,
    TAILED,
    TEAM,
    TIMED,
    UNSEEN,
    WORST,
    Column,
)


class Record(NamedTuple):
    """One flight of one vehicle in numbers; nan where a column means nothing."""

    seed: int  # of the environment
    agent: str  # of a team; "" for a single vehicle
    steps: int  # control periods flown
    score: Annotated[
        float,
        Column(
            "Score", "", "summed reward / length of the full time limit, 0 to 1", MORE | COMPARED, "score"
        ),
    ]  # of the reward (1 - v) / (1 + l), whatever the environment's is
    quadratic_cost: Annotated[
        float,
        Column("Quadratic cost", "", "sum of the stage costs", LESS | CUT_SHORT | COMPARED, "quadratic cost"),
    ]  # l(x_{k+1}, u_k)
    constraint_cost: Annotated[
        float,
        Column("Constraint cost", "", 'sum of info["cost"]', LESS | CUT_SHORT, "constraint cost"),
    ]  # violation / scale over the limits, as in safe RL
    position_rms: Annotated[
        float,
        Column(
            *("Position RMS", "m", "distance to the reference"),
            LESS | SINGLE | CUT_SHORT | COMPARED | TAILED,
            "RMS",
        ),
    ]  # sqrt(mean |p_k - p_ref,k|^2), k = 0..T-1
    steady_rms: Annotated[
        float,
        Column(
            "Steady RMS",
            "m",
            "distance to the reference in the second half of the time limit",
            LESS | SINGLE | CUT_SHORT,
            "steady",
        ),
    ]
    settling_time: Annotated[
        float,
        Column("Settling", "s", "last sample above 5 % of the initial error", LESS | SINGLE | CUT_SHORT),
    ]  # nan if it stays above to the end, or begins below 0.1 m
    formation_rms: Annotated[
        float,
        Column(
            *("Slot RMS", "m", "distance to the own slot"),
            LESS | TEAM | CUT_SHORT | COMPARED | WORST | TAILED,
        ),
    ]
    formation_final: Annotated[
        float,
        Column(
            "Final error",
            "m",
            "distance to the own slot in the last second",
            LESS | TEAM | CUT_SHORT | WORST,
            "final",
        ),
    ]
    formation_settling: Annotated[
        float,
        Column("Settling", "s", "last sample above 0.1 m", LESS | TEAM | CUT_SHORT | LARGEST, "settling"),
    ]  # nan if it stays above to the end
    min_separation: Annotated[
        float,
        Column(
            "Separation", "m", "smallest between two vehicles", MORE | TEAM | COMPARED | LEAST, "separation"
        ),
    ]
    z_error_max: Annotated[
        float,
        Column(
            "Height error",
            "m",
            "largest height error to the slot",
            LESS | TEAM | CUT_SHORT | LARGEST,
            "z max",
        ),
    ]
    z_error_rms: Annotated[
        float, Column("Height RMS", "m", "height error to the slot", LESS | TEAM | CUT_SHORT | UNSEEN)
    ]
    messages: Annotated[float, Column("Messages", "/step", "heard per vehicle and step", TEAM, "messages")]
    estimate_rmse: Annotated[
        float,
        Column(
            *("Estimate RMSE", "m", "estimated position of the target"),
            LESS | TEAM | CUT_SHORT | COMPARED | WORST | TAILED,
            "estimate",
        ),
    ]
    estimate_sigma: Annotated[
        float,
        Column(
            "Believed error", "m", "root mean trace of the estimated position's covariance", TEAM | CUT_SHORT
        ),
    ]  # as the policy believes
    anees: Annotated[
        float,
        Column(
            "ANEES", "", "mean e' P^-1 e / 3 of the estimated position, 1 for an honest filter", TEAM, "ANEES"
        ),
    ]
    nis_ratio: Annotated[
        float,
        Column(
            "NIS",
            "",
            "squared innovation over its covariance, mean per number measured, 1 for an honest filter",
            TEAM,
            "NIS",
        ),
    ]
    trilateration_share: Annotated[
        float,
        Column("Trilaterated", "", "share of updates by a trilaterated position", TEAM | PERCENT | UNSEEN),
    ]  # nan if none was
    effort: Annotated[
        float, Column("Effort", "N^2", "mean |u - u_T|^2 of the commands", LESS | COMPARED, "effort")
    ]
    violation_share: Annotated[
        float,
        Column("Violating", "", "share of steps in which a limit was exceeded", LESS | PERCENT, "violating"),
    ]
    worst_violation: dict[str, float]  # constraint name -> largest excess over its limit, SI
    crashed: Annotated[
        bool,
        Column("Crashes", "", "flights that ended in a crash", LESS | COUNTED, "crashes"),
        Column(
            *("P(crash)", "", "share of flights that crashed, with its Clopper-Pearson interval"),
            LESS | PERCENT | TAIL,
            "P(crash)",
            "crash_probability",
        ),
    ]
    crash_cause: str  # one of `task.crash_causes`
    saturation_share: Annotated[
        float,
        Column("Saturated", "", "share of rotor commands at a face of their box", PERCENT, "saturated"),
    ]
    intervention_share: Annotated[
        float,
        Column(
            *(
                "Intervened",
                "",
                "share of commands that the safety filter changed",
                LESS | PERCENT | REPORTED,
            ),
            "intervened",
        ),
    ]  # nan without a safety filter, as the next two
    intervention_size: Annotated[
        float,
        Column(
            *("Intervention", "N", "largest change of a rotor's command, mean over those", LESS | REPORTED),
            "intervention",
        ),
    ]  # nan where none was changed
    unanswered_share: Annotated[
        float,
        Column(
            *("Unanswered", "", "share of commands of the filtered policy that were no numbers"),
            LESS | PERCENT | REPORTED,
            "unanswered",
        ),
    ]
    decision_p50_ms: Annotated[
        float,
        Column(
            *("Decision p50", "ms"),
            "wall time per vehicle of a decision, median: single ones in short flights from 20 starts that "
            "serve nothing else, or all where flights go one at a time",
            LESS | TIMED,
            "p50",
        ),
    ]  # nan if not timed
    decision_p99_ms: Annotated[
        float, Column("Decision p99", "ms", "the same, 99th percentile", LESS | TIMED, "p99")
    ]
    decision_max_ms: Annotated[
        float,
        Column("Decision max", "ms", "the slowest", LESS | TIMED | UNSEEN),
        Column("Team p50", "ms", "of a decision for the whole team", LESS | TEAM, "team p50", "team_p50_ms"),
        Column("Team p99", "ms", "the same, 99th percentile", LESS | TEAM, "team p99", "team_p99_ms"),
    ]
    relaxed: Annotated[
        int, Column("Relaxed", "", "decisions whose hard rows were made soft", LESS | FALLBACK | UNSEEN)
    ]
    previous_plan: Annotated[
        int, Column("Previous plan", "", "decisions by the shifted plan before", LESS | FALLBACK | UNSEEN)
    ]
    clipped_sdre: Annotated[
        int,
        Column("Clipped SDRE", "", "decisions by the clipped plan without limits", LESS | FALLBACK | UNSEEN),
    ]
    hover: Annotated[
        int,
        Column("Hover", "", "decisions that took hover thrust", LESS | FALLBACK | UNSEEN),
        Column("Fallbacks", "", "decisions by one of these four", LESS | COUNTED, "fallbacks", "fallbacks"),
    ]
    left_model: Annotated[
        int,
        Column("Left model", "", "decisions outside where the model holds", LESS | COUNTED, "left model"),
    ]  # whose state or plan left where the policy's model holds
    iterations_max: Annotated[
        int, Column("Iterations", "", "most of the solver in a decision", LESS | MOST | UNSEEN)
    ]

    @property
    def cost(self) -> float:
        """`quadratic_cost` by its name of before, with a warning: `info["cost"]` is the constraint signal."""
        text = 'Record.cost is now quadratic_cost; constraint_cost is the sum of info["cost"]'
        warnings.warn(text, DeprecationWarning, stacklevel=2)
        return self.quadratic_cost

    def row(self) -> dict[str, Any]:
        """Flat form for tables: `worst_violation` becomes one column per constraint."""
        flat = self._asdict()
        worst = flat.pop("worst_violation")
        flat = {name: value for name, value in flat.items() if self.agent or name not in _OF_TEAMS}
        return flat | {f"worst_{name}": value for name, value in worst.items()}


def _columns() -> Iterator[Column]:
    """Columns of the Record; what summaries add has a name of its own, worst and tail follow the mean."""
    for name, hint in get_type_hints(Record, include_extras=True).items():
        for column in getattr(hint, "__metadata__", ()):
            named = column if column.name else replace(column, name=name, source=name)
            yield named
            if named.has(WORST):
                yield named.worst()
            if named.has(TAILED):
                yield named.tail()


COLUMNS = {column.name: column for column in _columns()}
_OF_TEAMS = frozenset(name for name, column in COLUMNS.items() if column.has(TEAM))


def without_cut_short(record: Record) -> Record:
    """The record of a flight that crashed, without the numbers that are cheap because of that."""
    lost: dict[str, Any] = {column.source: math.nan for column in COLUMNS.values() if column.has(CUT_SHORT)}
    return record._replace(**lost)


def averaged(team: bool) -> list[Column]:
    """Columns that a summary averages, of a team or of a single vehicle."""
    return [column for column in COLUMNS.values() if column.averaged and (team or not column.has(TEAM))]


def shown(team: bool, limits: Iterable[str]) -> list[Column]:
    """Columns that tables of a team, or of single vehicles, may show.

    Args:
        team: Whether they are of a team.
        limits: Names of its constraints, whose largest excesses stand where `worst_violation` does.
    """
    hidden = SINGLE if team else TEAM
    columns = [column for column in COLUMNS.values() if not column.has(hidden)]
    place = columns.index(COLUMNS["crashed"])
    return [*columns[:place], *map(_limit_column, limits), *columns[place:]]


def _limit_column(limit: str) -> Column:
    about = f"largest excess over the limit on {limit}, all flights"
    words = f"Worst {limit.replace('_', ' ')}"
    return Column(words, UNITS.get(limit, ""), about, LESS, words.lower(), f"worst_{limit}")


def limits_in(row: Mapping[str, Any]) -> list[str]:
    """Names of the constraints of which a row of a table has the largest excess."""
    return [name.removeprefix("worst_") for name in row if name.startswith("worst_")]


def fallbacks(counts: Mapping[str, Any]) -> int:
    """Decisions without the solver's own answer, from the counts of a summary."""
    return int(sum(counts[name] for name, column in COLUMNS.items() if column.has(FALLBACK)))


# Columns that files of before do not have, or have under another name.
_REPORTED = {name: math.nan for name, column in COLUMNS.items() if column.has(REPORTED)}
_ADDED: Mapping[str, Any] = {"constraint_cost": math.nan, "crash_cause": "", "left_model": 0, **_REPORTED}
_RENAMED = {"cost": "quadratic_cost"}


def renamed(stored: Mapping[str, Any]) -> dict[str, Any]:
    """A row of a file under the names of today: `quadratic_cost` was `cost`."""
    return {_RENAMED.get(name, name): value for name, value in stored.items()}


_WORDS = ("agent", "crash_cause")  # fields of a Record; the others are numbers, or numbers by name


def read_record(stored: Mapping[str, Any]) -> Record:
    """A record as JSON stored it, nan as null, also from results of before `quadratic_cost`.

    Raises:
        TypeError: If a column is missing or not known, or is no number where it is to be one.
    """
    found = {name: math.nan if value is None else value for name, value in renamed(stored).items()}
    record = Record(**{**_ADDED, **found})
    for name, value in zip(Record._fields, record, strict=True):
        values = value.values() if name == "worst_violation" and isinstance(value, dict) else (value,)
        if not all(isinstance(one, str if name in _WORDS else int | float) for one in values):
            raise TypeError(f"{name} is {value!r}")
    return record
