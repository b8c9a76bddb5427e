"""Chapter 5 in numbers, beside those of an independent prototype: the dissertation prints none."""

from __future__ import annotations

from typing import Any

import numpy as np

from .formation_claims import MEETINGS, UNION, formation, head_on, switched
from .results import Measured
from .team_flights import FROZEN, NO_ROWS, TeamFlight, fly_teams

_FREE: dict[str, Any] = {**NO_ROWS, "reach": np.inf, "speed": np.inf}
_OLD: dict[str, Any] = {**FROZEN, **NO_ROWS}
# (formation, leader, neighbours as, options, weights toward the leader, prototype's lag in m).
_LAG: tuple[tuple[str, str, str, dict[str, Any], float], ...] = (
    ("triangle", "line", "frozen (text)", _OLD, 0.277),
    ("triangle", "line", "cv, own term not advanced", {**_FREE, "feed_forward": False}, 0.054),
    ("triangle", "line", "cv", _FREE, 0.0),
    ("triangle", "line", "plan", {**_FREE, "neighbour": "plan"}, 0.0),
    ("hexagon", "line", "frozen (text)", _OLD, 0.416),
    ("hexagon", "line", "cv", _FREE, 0.0),
    ("triangle", "fast-line", "frozen, N = 5", _OLD, 0.816),
    ("triangle", "fast-line", "frozen, N = 10", {**_OLD, "horizon": 10}, 1.950),
    ("triangle", "slow-helix", "frozen (text)", _OLD, 0.402),
    ("triangle", "slow-helix", "cv", _FREE, 0.278),
    ("triangle", "slow-helix", "plan", {**_FREE, "neighbour": "plan"}, 0.181),
    ("triangle", "slow-helix", "ca", {**_FREE, "neighbour": "ca"}, 0.141),
    ("triangle", "slow-helix", "ca, attitude", {**_FREE, "neighbour": "ca", "attitude": True}, 0.019),
    ("hexagon", "slow-helix", "cv", _FREE, 0.429),
    ("hexagon", "slow-helix", "ca, attitude", {**_FREE, "neighbour": "ca", "attitude": True}, 0.029),
)
# Strong triangle and weight toward the leader: prototype's error after 20 s, line leader, no avoidance.
_DENSITY = ((_OLD, "frozen", 1.0, 1.74), (_OLD, "frozen", 10.0, 0.380), (_FREE, "cv", 10.0, 0.0))
# Dwell, lifetime, leader -> (quantity, prototype).
_LIFETIME = (
    ("static", 1, 0.0, "settling, s", 20.5),
    ("static", 1, 0.5, "settling, s", 3.9),
    ("static", 20, 0.5, "settling, s", 10.8),
    ("static", 1, 2.0, "settling, s", 3.9),
    ("static", 5, 2.0, "settling, s", 4.6),
    ("static", 20, 2.0, "settling, s", 7.5),
    ("line", 1, 0.0, "error after 30 s, m", 3.4),
    ("line", 20, 0.5, "error after 30 s, m", 2.4),
    ("line", 20, 2.0, "error after 30 s, m", 0.0),
)
_DROP_OUT = ((0.3, 0.0, 0.96), (0.6, 0.0, 2.74), (0.6, 0.5, 0.047), (0.3, 2.0, 0.0), (0.6, 2.0, 0.0))
# Smallest distance, m, over all runs of MEETINGS.
_HEAD_ON = {
    "none": (0.004, 0.008, 0.023, 0.005),
    "text, sign fixed": (0.348, 0.258, 0.009, 0.272),
    "frozen centre, no braking row": (0.402, 0.324, 0.299, 0.377),
    "moving centre, no braking row": (0.402, 0.297, 0.299, 0.348),
    "default": (0.422, 0.450, 0.412, 0.418),
}
# Default controller, line start: final error, settling, smallest distance, largest z error.
_DEFAULT = {
    ("triangle", "static"): (0.0, 5.75, 0.431, 0.063),
    ("triangle", "line"): (0.0, 5.45, 0.645, 0.117),
    ("triangle", "slow-helix"): (0.278, np.inf, 0.657, 0.052),
    ("hexagon", "static"): (0.0, 12.0, 0.419, 0.201),
    ("hexagon", "line"): (0.0, 10.7, 0.437, 0.273),
    ("hexagon", "slow-helix"): (0.429, np.inf, 0.433, 0.309),
}


def lag_table(jobs: int = 1) -> list[Measured]:
    """Error of the last in the tree behind a moving leader after 20 s, without avoidance."""
    flights = []
    for shape, leader, _, policy, _ in _LAG:
        plans = {"comm": "plan"} if policy.get("neighbour") == "plan" else {}
        preview = {"preview": policy["horizon"]} if "horizon" in policy else {}
        start = "sorted" if shape == "triangle" else "line"
        flights.append(formation(shape, "weak", leader, policy, start=start, **plans, **preview))
    cells = [
        Measured(f"{shape}, {leader}, {how}", "lag, m", before, outcome.final)
        for (shape, leader, how, _, before), outcome in zip(_LAG, fly_teams(flights, jobs), strict=True)
    ]
    dense = [formation("triangle", "strong", "line", policy, start="sorted", leader_weight=weight)
             for policy, _, weight, _ in _DENSITY]  # fmt: skip
    for (_, how, weight, before), outcome in zip(_DENSITY, fly_teams(dense, jobs), strict=True):
        where = f"triangle, strong, line, {how}, {weight:g} toward the leader"
        cells.append(Measured(where, "error after 20 s, m", before, outcome.final))
    return cells


def lifetime_table(jobs: int = 1) -> list[Measured]:
    """Switching graphs without a tree each, and lost messages."""
    switches = [
        switched(UNION, dwell, leader, lifetime, _FREE) for leader, dwell, lifetime, _, _ in _LIFETIME
    ]
    cells = []
    for (leader, dwell, lifetime, quantity, before), outcome in zip(
        _LIFETIME, fly_teams(switches, jobs), strict=True
    ):
        ours = outcome.settling if quantity.startswith("settling") else outcome.final
        cells.append(Measured(f"{leader}, dwell {dwell}, lifetime {lifetime:g} s", quantity, before, ours))
    lossy = []
    for p, lifetime, _ in _DROP_OUT:
        env = {"time_limit": 30.0, "drop_out": p, "message_lifetime": lifetime}
        lossy.append(formation("triangle", "weak", "line", _FREE, start="sorted", **env))
    for (p, lifetime, before), outcome in zip(_DROP_OUT, fly_teams(lossy, jobs), strict=True):
        where = f"line, drop-out {p:g}, lifetime {lifetime:g} s"
        cells.append(Measured(where, "error after 30 s, m", before, outcome.final))
    return cells


def head_on_table(jobs: int = 1) -> list[Measured]:
    """Vehicles that exchange places, N = 5."""
    cells = []
    for rule, row in _HEAD_ON.items():
        for case, before in zip(MEETINGS, row, strict=True):
            where = f"{case[1]} meet at {case[0]:g} m/s, {rule}"
            cells.append(Measured(where, "least gap, m", before, float(head_on(rule, case).min())))
    return cells


def default_table(jobs: int = 1) -> list[Measured]:
    """Weak graphs, default controller, from a line with crossing paths."""
    flights: list[TeamFlight] = [formation(shape, "weak", leader, {}) for shape, leader in _DEFAULT]
    names = ("error, m", "settling, s", "least gap, m", "largest z, m")
    cells = []
    for ((shape, leader), row), outcome in zip(_DEFAULT.items(), fly_teams(flights, jobs), strict=True):
        found = (outcome.final, outcome.settling, outcome.gap, outcome.height[0])
        for name, before, ours in zip(names, row, found, strict=True):
            if np.isfinite(before) or np.isfinite(ours):
                cells.append(Measured(f"default, {shape}, weak, {leader}", name, before, ours))
    return cells


def tables(jobs: int = 1) -> list[Measured]:
    """All of them."""
    return [*lag_table(jobs), *lifetime_table(jobs), *head_on_table(jobs), *default_table(jobs)]
