"""Numbers of a flight in a team, and of a whole team from those of its vehicles.

Vehicles of one flight share its start, its target and each other's mistakes: they are no independent samples.
A team's number is formed first, flight by flight, and intervals are over flights.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quad_envs.parameters import POSITION, Array
from quad_envs.tasks import TeamTask

from .episode import Episode
from .record import TEAM_COLUMNS, Record

FORMATION_SETTLED = 0.1  # m, distance to the slot below which a vehicle has settled
FINAL = 1.0  # s, end of a flight over which `formation_final` is taken
_HEIGHT = 2

# How a team's number comes from its vehicles'; the mean of those that have one where nothing is said.
_LEAST, _LARGEST = ("min_separation",), ("formation_settling", "z_error_max")
# Of these the worst vehicle is told beside the mean, as `<column>_worst`.
WITH_WORST = ("formation_rms", "formation_final", "estimate_rmse")
TEAM_SUMMARY = tuple(
    name for column in TEAM_COLUMNS for name in (column, *[f"{column}_worst"] * (column in WITH_WORST))
)
# Columns that are nan after a crash.
TEAM_CUT_SHORT = (
    *("formation_rms", "formation_rms_worst", "formation_final", "formation_final_worst"),
    *("formation_settling", "z_error_max", "z_error_rms"),
    *("estimate_rmse", "estimate_rmse_worst", "estimate_sigma"),
)


def measure_team(episode: Episode) -> dict[str, float]:
    """The columns TEAM_COLUMNS of one vehicle's flight; nan where they mean nothing."""
    found = dict.fromkeys(TEAM_COLUMNS, float("nan"))
    if not isinstance(episode.task, TeamTask):
        return found
    found["messages"] = float(episode.signals["messages"].mean())
    found |= _estimates(episode)
    if episode.task.mission != "estimation":
        found |= _formation(episode)
    if episode.crashed:
        found |= {name: float("nan") for name in TEAM_CUT_SHORT if name in found}
    return found


def _formation(episode: Episode) -> dict[str, float]:
    """How the slot was kept, and the distance to the others."""
    task, steps = episode.task, len(episode.rewards)
    error = episode.signals["formation_error"]
    above = np.flatnonzero(error > FORMATION_SETTLED)
    last = int(above[-1]) + 1 if above.size else 0  # the error at index k is that of sample k + 1
    final = round(FINAL / task.dt)
    height = np.abs(episode.states[1:, _HEIGHT] - episode.references[1 : steps + 1, _HEIGHT])
    return {
        "formation_rms": _rms(error),
        "formation_final": float(error[-final:].mean()),
        "formation_settling": last * task.dt if last < steps else float("nan"),
        "min_separation": float(episode.signals["min_separation"].min()),
        "z_error_max": float(height.max()),
        "z_error_rms": _rms(height),
    }


def _estimates(episode: Episode) -> dict[str, float]:
    """Error and honesty of the estimated position of the target."""
    from controllers.estimation.consistency import anees

    signals = episode.signals
    if "estimate_error" not in signals:
        return {}
    error, P = signals["estimate_error"][:, POSITION], signals["estimate_covariance"][:, :3, :3]
    known = np.isfinite(error).all(axis=1)
    given = known & np.isfinite(P).all(axis=(1, 2))
    given[given] = np.linalg.det(P[given]) > 0.0
    rows, nis = signals["nis_rows"], signals["nis"]
    updated = (rows > 0) & np.isfinite(nis)
    found = {"estimate_rmse": _rms(np.linalg.norm(error[known], axis=1))}
    if given.any():
        trace = np.trace(P[given], axis1=1, axis2=2)
        found["estimate_sigma"] = float(np.sqrt(trace.mean()))
        found["anees"] = anees(error[given], P[given])
    if updated.any():
        found["nis_ratio"] = float((nis[updated] / rows[updated]).mean())
    if "trilaterated" in signals:
        found["trilateration_share"] = float(signals["trilaterated"].mean())
    return found


def _rms(error: Array) -> float:
    return float(np.sqrt(np.mean(error * error))) if error.size else float("nan")


def by_flight(records: Sequence[Record]) -> dict[int, list[Record]]:
    """Seed -> records of the vehicles of that flight."""
    flights: dict[int, list[Record]] = {}
    for record in records:
        flights.setdefault(record.seed, []).append(record)
    return flights


def flight_values(records: Sequence[Record], column: str) -> dict[int, float]:
    """Seed -> the number of the whole flight, from those of its vehicles."""
    return {seed: _of_team(team, column) for seed, team in by_flight(records).items()}


def _of_team(team: Sequence[Record], column: str) -> float:
    values = np.array([getattr(record, column.removesuffix("_worst")) for record in team], dtype=np.float64)
    if column in _LEAST:
        return float(values.min())
    if column in _LARGEST or column.endswith("_worst"):
        return float(values.max())
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else float("nan")


def has_team(records: Sequence[Record]) -> bool:
    """Whether records are those of teams' vehicles."""
    return any(record.agent for record in records)
