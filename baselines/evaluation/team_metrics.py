"""Numbers of a flight in a team, and of a whole team from those of its vehicles.

Vehicles of one flight share its start, its target and each other's mistakes: they are no independent samples.
A team's number is formed first, flight by flight, and intervals are over flights.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quad_envs.parameters import POSITION, Array
from quad_envs.tasks import TeamTask

from .column import TEAM
from .columns import COLUMNS, Record
from .episode import Episode

FORMATION_SETTLED = 0.1  # m, distance to the slot below which a vehicle has settled
FINAL = 1.0  # s, end of a flight over which `formation_final` is taken
_HEIGHT = 2
_NOTHING = {column.source: float("nan") for column in COLUMNS.values() if column.has(TEAM) and column.source}


def measure_team(episode: Episode) -> dict[str, float]:
    """The columns that only a team's vehicle has; nan where they mean nothing."""
    found = dict(_NOTHING)
    if not isinstance(episode.task, TeamTask):
        return found
    found["messages"] = float(episode.signals["messages"].mean())
    found |= _estimates(episode)
    if episode.task.mission != "estimation":
        found |= _formation(episode)
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
    about = COLUMNS[column]
    return {
        seed: about.of_team([getattr(record, about.source) for record in team])
        for seed, team in by_flight(records).items()
    }


def has_team(records: Sequence[Record]) -> bool:
    """Whether records are those of teams' vehicles."""
    return any(record.agent for record in records)
