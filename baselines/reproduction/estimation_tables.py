"""Chapter 6 in numbers, beside those of an independent prototype: the dissertation prints none."""

from __future__ import annotations

from .estimation_claims import ALL, usable
from .estimation_scenes import SETTLED, aircraft, bounds, range_filter, range_scene, ring
from .results import Measured
from .scenes import INTERVALS
from .text_filters import fixes_alone

_WHEN = ("0 to 2.5 s", "2.5 to 5 s", "5 to 10 s")
# RMSE, m, of vehicles 1 (4, 3, 2 ranges) and 2 (2, 3, 4 ranges).
_RANGE = {
    "EKF": ((0.110, 0.108, 0.692), (0.889, 0.148, 0.098)),
    "mean bound": ((0.106, 0.117, 0.606), (0.872, 0.113, 0.100)),
    "position only": ((0.177, 0.228, 1.245), (1.228, 0.214, 0.193)),
    "squared range, constant R": ((0.154, 0.198, 2.58), (3.75, 4.16, 4.11)),
}
_FIXES = {(0, 0): 0.235, (1, 2): 0.311}  # vehicle, interval
_AIRCRAFT = {
    "decaying": ((0.085, 0.128, 0.187), (0.149, 0.158, 0.120)),
    "constant": ((0.055, 0.073, 0.096), (0.086, 0.087, 0.069)),
    "Cartesian": ((0.059, 0.074, 0.102), (0.091, 0.081, 0.074)),
}
_RING = {
    "own": (0.0730, 1.01),
    "shared": (0.0414, 0.99),
    "naive": (1.31, 2.5e5),
    "trace": (0.0409, 0.45),
    "determinant": (0.0546, 0.91),
    "central": (0.0359, 0.98),
}


def _of_range(name: str, vehicle: int) -> list[float]:
    if name == "mean bound":
        return [float(value) for value in bounds(vehicle)[0]]
    track = usable(vehicle) if name == "EKF" else range_filter(name)
    return [track.rmse(vehicle, part) for part in INTERVALS]


def tables() -> list[Measured]:
    """Filters with ranges, on the aircraft, and fused in a ring."""
    cells = []
    for name, rows in _RANGE.items():
        for vehicle, row in enumerate(rows):
            for when, before, ours in zip(_WHEN, row, _of_range(name, vehicle), strict=True):
                cells.append(
                    Measured(f"range, vehicle {vehicle + 1}, {when}, {name}", "RMSE, m", before, ours)
                )
    for (vehicle, i), before in _FIXES.items():
        ours = fixes_alone(range_scene(), vehicle, INTERVALS[i]).rmse(0, ALL)
        cells.append(Measured(f"range, vehicle {vehicle + 1}, {_WHEN[i]}, fixes", "RMSE, m", before, ours))
    for name, rows in _AIRCRAFT.items():
        for vehicle, row in zip((0, 3), rows, strict=True):
            found = [aircraft(name).rmse(vehicle, part) for part in INTERVALS]
            for when, before, ours in zip(_WHEN, row, found, strict=True):
                where = f"aircraft, vehicle {vehicle + 1}, {when}, {name}"
                cells.append(Measured(where, "RMSE, m", before, ours))
    for name, (rmse, consistency) in _RING.items():
        track = ring(name)
        cells.append(Measured(f"ring, {name}", "RMSE, m", rmse, track.rmse(ALL, SETTLED)))
        cells.append(Measured(f"ring, {name}", "ANEES/3", consistency, track.anees(ALL, SETTLED)))
    return cells
