"""The leaderboard of an environment: which columns it has, and their cells from the summary."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from .model import Board, Column, Row

_FALLBACKS = ("relaxed", "previous_plan", "clipped_sdre", "hover")
_UNITS = {"tilt": "rad", "velocity": "m/s", "position": "m", "rate": "N", "separation": "m"}
# Key of the summary row, title, unit, what it is, better, kind. "{base}" is the policy of the differences.
_FIRST = (
    ("score", "Score", "", "sum of the reward over the full time limit, 0 to 1", 1, "score"),
    ("score_minus_base", "Δ score", "", "score minus that of {base}, same starts", 1, "difference"),
    ("cost", "Cost", "", "summed quadratic cost", -1, "number"),
    ("cost_minus_base", "Δ cost", "", "cost minus that of {base}, same starts", -1, "difference"),
)
_TRACKING = (
    ("position_rms", "Position RMS", "m", "distance to the reference, whole flight", -1, "number"),
    ("position_rms_minus_base", "Δ RMS", "m", "position RMS minus that of {base}", -1, "difference"),
    ("steady_rms", "Steady RMS", "m", "the same over the second half", -1, "number"),
    ("settling_time", "Settling", "s", "last sample above 5 % of the initial error", -1, "number"),
)
_TEAM = (
    ("formation_rms", "Slot RMS", "m", "distance to the own slot, mean of the vehicles", -1, "number"),
    ("formation_rms_minus_base", "Δ slot RMS", "m", "slot RMS minus that of {base}", -1, "difference"),
    ("formation_final", "Final error", "m", "distance to the slot over the last second", -1, "number"),
    ("formation_final_worst", "Final, worst", "m", "the same of the worst vehicle", -1, "number"),
    ("formation_settling", "Settling", "s", "last sample above 0.1 m", -1, "number"),
    ("min_separation", "Separation", "m", "smallest distance between two vehicles", 1, "number"),
    ("min_separation_minus_base", "Δ separation", "m", "separation minus that of {base}", 1, "difference"),
    ("z_error_max", "Height error", "m", "largest height error to the slot", -1, "number"),
    ("messages", "Messages", "/step", "heard per vehicle and step", 0, "number"),
    ("estimate_rmse", "Estimate RMSE", "m", "estimated position of the target", -1, "number"),
    ("estimate_rmse_minus_base", "Δ RMSE", "m", "estimate RMSE minus that of {base}", -1, "difference"),
    ("estimate_rmse_worst", "RMSE, worst", "m", "the same of the worst vehicle", -1, "number"),
    ("estimate_sigma", "Believed error", "m", "root mean trace of the covariance", 0, "number"),
    ("anees", "ANEES", "", "1 for an honest filter", 0, "number"),
    ("nis_ratio", "NIS", "", "per row; 1 for an honest filter", 0, "number"),
)
_LAST = (
    ("effort", "Effort", "N²", "mean |u - u_T|²", -1, "number"),
    ("effort_minus_base", "Δ effort", "N²", "effort minus that of {base}", -1, "difference"),
    ("violation_share", "Violating", "%", "share of steps in which a limit was exceeded", -1, "percent"),
)
_END = (
    ("crashed", "Crashes", "", "flights that ended in a crash", -1, "count"),
    ("saturation_share", "Saturated", "%", "share of rotor commands at a face of their box", 0, "percent"),
    ("decision_p50_ms", "Decision p50", "ms", "wall time of a decision per vehicle, median", -1, "number"),
    ("decision_p99_ms", "Decision p99", "ms", "its 99th percentile", -1, "number"),
    ("team_p50_ms", "Team p50", "ms", "the same for the whole team", -1, "number"),
    ("team_p99_ms", "Team p99", "ms", "its 99th percentile", -1, "number"),
    ("fallbacks", "Fallbacks", "", "decisions without the solver's own answer", -1, "count"),
    ("left_model", "Left model", "", "decisions outside where the policy's model holds", -1, "count"),
)


def leaderboard(
    summary: Sequence[Mapping[str, Any]], base: str
) -> tuple[tuple[Column, ...], tuple[Row, ...]]:
    """Columns that say something in this environment, and a row per policy.

    Args:
        summary: Rows of `Results.summary` of one environment.
        base: Policy from which differences are taken.
    """
    team = "vehicles" in summary[0]
    before = (*_FIRST, *(_TEAM if team else _TRACKING), *_LAST)
    every = [Column(*entry)._replace(about=entry[3].format(base=base)) for entry in before]
    for key in summary[0]:
        if key.startswith("worst_"):
            name = key.removeprefix("worst_")
            about = f"largest excess over the limit on {name}, all flights"
            every.append(Column(key, f"Worst {name}", _UNITS.get(name, ""), about, -1))
    every += [Column(*entry) for entry in _END]
    rows = tuple(_row(row, every) for row in summary)
    kept = [
        column
        for column in every
        if any(row.cells[column.key][0] is not None for row in rows)
        and not (column.kind == "difference" and len(rows) == 1)
    ]
    keys = [column.key for column in kept]
    return tuple(kept), tuple(row._replace(cells={key: row.cells[key] for key in keys}) for row in rows)


def _row(summary: Mapping[str, Any], columns: Sequence[Column]) -> Row:
    found = {**summary, "fallbacks": sum(summary[name] for name in _FALLBACKS)}
    cells: dict[str, tuple[float | None, ...]] = {
        column.key: (_number(found.get(column.key)), _number(found.get(f"{column.key}_ci")))
        for column in columns
    }
    return Row(str(summary["policy"]), bool(summary.get("privileged", False)), cells)


def _number(value: Any) -> float | None:
    """To seven digits, which is more than the page shows; None where there is no number."""
    return float(f"{value:.7g}") if value is not None and math.isfinite(value) else None


# Column of contenders.csv, title, unit, what it is, better, kind; "[]" has its interval in two more columns.
_CONTENDERS = (
    ("score", "Score", "", "mean over training seeds and starts", 1, "number"),
    ("iqm", "IQM", "", "interquartile mean of the score", 1, "interval"),
    ("score_minus_base", "Δ score", "", "score minus that of {base}, same starts", 1, "interval"),
    ("improvement", "P(better)", "", "probability to score more than {base} on a start", 1, "interval"),
    ("seeds", "Seeds", "", "of the training", 0, "count"),
    ("crashed", "Crashes", "", "flights that ended in a crash", -1, "count"),
    ("violation_share", "Violating", "%", "share of steps in which a limit was exceeded", -1, "percent"),
    ("decision_p50_ms", "Decision p50", "ms", "wall time of a decision, median", -1, "number"),
    ("training_cpu_s", "Training", "CPU-s", "CPU time of one training, mean of the seeds", -1, "number"),
    ("training_steps", "Training", "steps", "environment steps of one training", -1, "number"),
)


def contender_board(rows: Sequence[Mapping[str, str]]) -> Board | None:
    """What `contenders.csv` says of one environment and condition; None if it says nothing.

    Args:
        rows: As text, of this environment and condition.
    """
    if not rows:
        return None
    base = rows[0]["base"]
    columns = [Column(*entry)._replace(about=entry[3].format(base=base)) for entry in _CONTENDERS]
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
