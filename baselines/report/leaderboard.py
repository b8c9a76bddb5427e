"""The tables of an environment on the page: which columns they have, and their cells from the summary."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ..evaluation import column as evaluation
from ..evaluation.column import COMPARED, COUNTED, PERCENT, TAIL, UNSEEN
from ..evaluation.columns import COLUMNS, fallbacks, limits_in, shown
from ..sweeps.contenders import SCORES, SEEDS, TRAININGS
from .frontier import Point, Spread, draw_frontier
from .model import Board, Column, Row

# What answers the question, in this order: the first that an environment has stand in the first table.
_MAIN = (
    *("score", "score_minus_base", "violation_share", "crashed", "quadratic_cost", "estimate_rmse"),
    *("formation_rms", "decision_p50_ms"),
)
MAIN_COLUMNS = 6


def leaderboard(
    summary: Sequence[Mapping[str, Any]], base: str
) -> tuple[tuple[Column, ...], tuple[Row, ...]]:
    """Columns that say something in this environment, and a row per policy.

    Args:
        summary: Rows of `Results.summary` of one environment.
        base: Policy from which differences are taken.
    """
    every: list[Column] = []
    for column in shown("vehicles" in summary[0], limits_in(summary[0])):
        if column.has(UNSEEN):
            continue
        every.append(_page_column(column, base))
        if column.has(COMPARED):
            every.append(_page_column(column.difference(), base, "difference"))
    rows = tuple(_row(row, every) for row in summary)
    kept = [
        column
        for column in every
        if any(row.cells[column.key][0] is not None for row in rows)
        and not (column.kind == "difference" and len(rows) == 1)
    ]
    kept = _with_main(kept)
    keys = [column.key for column in kept]
    return tuple(kept), tuple(row._replace(cells={key: row.cells[key] for key in keys}) for row in rows)


def _with_main(columns: Sequence[Column]) -> list[Column]:
    """Those of the first table marked, and before the others."""
    keys = [column.key for column in columns]
    first = [key for key in _MAIN if key in keys]
    chosen = [*first[: MAIN_COLUMNS - 1], *first[-1:]] if len(first) > MAIN_COLUMNS else first
    main = [column._replace(main=True) for key in chosen for column in columns if column.key == key]
    return [*main, *(column for column in columns if column.key not in chosen)]


def _page_column(column: evaluation.Column, base: str, kind: str = "") -> Column:
    """As the page knows it."""
    unit = "%" if column.has(PERCENT) else column.unit.replace("^2", "²")
    about = column.about.format(base=base)
    return Column(column.name, column.title, unit, about, column.better, kind or _kind(column))


def _kind(column: evaluation.Column) -> str:
    if column.has(TAIL):
        return "interval"
    if column.has(PERCENT | COUNTED):
        return "percent" if column.has(PERCENT) else "count"
    return "score" if column.name == "score" else "number"


def _row(summary: Mapping[str, Any], columns: Sequence[Column]) -> Row:
    found = {**summary, "fallbacks": fallbacks(summary)}
    cells = {column.key: _cell(found, column) for column in columns}
    return Row(str(summary["policy"]), bool(summary.get("privileged", False)), cells)


def _cell(found: Mapping[str, Any], column: Column) -> tuple[float | None, ...]:
    """A mean and its half width, or a number and both ends of its interval, in the unit that is shown."""
    if column.kind != "interval":
        return _number(found.get(column.key)), _number(found.get(f"{column.key}_ci"))
    factor = 100.0 if column.unit == "%" else 1.0
    numbers = (found.get(f"{column.key}{end}") for end in ("", "_low", "_high"))
    return tuple(_number(None if number is None else factor * number) for number in numbers)


def _number(value: Any) -> float | None:
    """To seven digits, which is more than the page shows; None where there is no number."""
    return float(f"{value:.7g}") if value is not None and math.isfinite(value) else None


# What the page shows of contenders.csv; those of SCORES have their interval in two more columns.
_CONTENDERS = (
    *(COLUMNS["score"], *SCORES.values(), SEEDS, COLUMNS["crashed"], COLUMNS["violation_share"]),
    *(COLUMNS["quadratic_cost"], COLUMNS["constraint_cost"], COLUMNS["position_rms"], COLUMNS["effort"]),
    *(COLUMNS["decision_p50_ms"], *TRAININGS.values()),
)


def contender_board(every: Sequence[Mapping[str, str]], title: str = "", about: str = "") -> Board | None:
    """What `contenders.csv` says of one environment and condition; None if it says nothing.

    Args:
        every: Rows as text, of this environment and condition.
        title: Of the suite's table.
        about: What its policies have in common.
    """
    here = [row for row in every if row.get("table", "") == title]
    rows = [row for row in here if not row.get("trace")]
    if not rows:
        return None
    base = rows[0]["base"]
    kinds = dict.fromkeys(SCORES, "interval") | {"score": "score"}
    columns = [_page_column(column, base, kinds.get(column.name, "")) for column in _CONTENDERS]
    out = []
    for row in rows:
        cells: dict[str, tuple[float | None, ...]] = {}
        for column in columns:
            value, *ends = (_text_number(row.get(column.key + end)) for end in ("", "_low", "_high"))
            cells[column.key] = (value, *ends) if column.kind == "interval" else (value, _half(*ends))
        out.append(Row(_titled(row), False, cells))
    kept = _with_main([c for c in columns if any(row.cells[c.key][0] is not None for row in out)])
    titles = [one.policy for row, one in zip(rows, out, strict=True) if row["policy"] == base]
    names = {row["policy"]: _titled(row) for row in rows}
    board = Board(title, about, titles[0] if titles else base, tuple(kept), tuple(out), names)
    places = {row["policy"]: k for k, row in enumerate(rows)}
    return board._replace(frontier=draw_frontier([_point(row, places.get(row["policy"], 0)) for row in here]))


def _titled(row: Mapping[str, str]) -> str:
    """A contender and its kind."""
    return f"{row['policy']} ({row['kind']})"


def _half(low: float | None, high: float | None) -> float | None:
    """Half the width of an interval."""
    return None if low is None or high is None else 0.5 * (high - low)


def _point(row: Mapping[str, str], colour: int) -> Point:
    """A contender in the plane of score and cost."""
    score, cost = (
        Spread(*(float(row.get(name + end) or "nan") for end in ("", "_low", "_high")))
        for name in ("score", "quadratic_cost")
    )
    return Point(row["policy"], row.get("trace", ""), colour, score, cost)


def _text_number(text: str | None) -> float | None:
    return _number(float(text)) if text else None
