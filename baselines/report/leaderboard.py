"""The leaderboard of an environment: which columns it has, and their cells from the summary."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ..evaluation import column as evaluation
from ..evaluation.column import COMPARED, COUNTED, PERCENT, UNSEEN
from ..evaluation.columns import COLUMNS, fallbacks, limits_in, shown
from ..sweeps.contenders import SCORES, SEEDS, TRAININGS
from .model import Board, Column, Row


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
    keys = [column.key for column in kept]
    return tuple(kept), tuple(row._replace(cells={key: row.cells[key] for key in keys}) for row in rows)


def _page_column(column: evaluation.Column, base: str, kind: str = "") -> Column:
    """As the page knows it."""
    unit = "%" if column.has(PERCENT) else column.unit.replace("^2", "²")
    about = column.about.format(base=base)
    return Column(column.name, column.title, unit, about, column.better, kind or _kind(column))


def _kind(column: evaluation.Column) -> str:
    if column.has(PERCENT | COUNTED):
        return "percent" if column.has(PERCENT) else "count"
    return "score" if column.name == "score" else "number"


def _row(summary: Mapping[str, Any], columns: Sequence[Column]) -> Row:
    found = {**summary, "fallbacks": fallbacks(summary)}
    cells: dict[str, tuple[float | None, ...]] = {
        column.key: (_number(found.get(column.key)), _number(found.get(f"{column.key}_ci")))
        for column in columns
    }
    return Row(str(summary["policy"]), bool(summary.get("privileged", False)), cells)


def _number(value: Any) -> float | None:
    """To seven digits, which is more than the page shows; None where there is no number."""
    return float(f"{value:.7g}") if value is not None and math.isfinite(value) else None


# What the page shows of contenders.csv; those of SCORES have their interval in two more columns.
_CONTENDERS = (
    *(COLUMNS["score"], *SCORES.values(), SEEDS, COLUMNS["crashed"], COLUMNS["violation_share"]),
    *(COLUMNS["decision_p50_ms"], *TRAININGS.values()),
)


def contender_board(rows: Sequence[Mapping[str, str]]) -> Board | None:
    """What `contenders.csv` says of one environment and condition; None if it says nothing.

    Args:
        rows: As text, of this environment and condition.
    """
    if not rows:
        return None
    base = rows[0]["base"]
    kinds = dict.fromkeys(SCORES, "interval") | {"score": "number"}
    columns = [_page_column(column, base, kinds.get(column.name, "")) for column in _CONTENDERS]
    out = []
    for row in rows:
        cells: dict[str, tuple[float | None, ...]] = {}
        for column in columns:
            ends = ("_low", "_high") if column.kind == "interval" else ()
            cells[column.key] = tuple(_text_number(row.get(column.key + end)) for end in ("", *ends))
        out.append(Row(f"{row['policy']} ({row['kind']})", False, cells))
    kept = tuple(c for c in columns if any(row.cells[c.key][0] is not None for row in out))
    titles = [one.policy for row, one in zip(rows, out, strict=True) if row["policy"] == base]
    return Board(titles[0] if titles else base, kept, tuple(out))


def _text_number(text: str | None) -> float | None:
    return _number(float(text)) if text else None
