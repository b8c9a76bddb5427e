"""One flight in numbers: the columns of every table, and those that only teams have."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

_NAN = float("nan")

# Column of a vehicle's record -> unit.
TEAM_COLUMNS = {
    "formation_rms": "m",
    "formation_final": "m",
    "formation_settling": "s",
    "min_separation": "m",
    "z_error_max": "m",
    "z_error_rms": "m",
    "messages": "-",
    "estimate_rmse": "m",
    "estimate_sigma": "m",
    "anees": "-",
    "nis_ratio": "-",
    "trilateration_share": "-",
}


class Record(NamedTuple):
    """One flight in numbers."""

    seed: int  # of the environment
    steps: int  # control periods flown
    score: float  # -, sum of (1 - v) / (1 + l) over the flight / length of the FULL time limit, 0 to 1
    cost: float  # -, sum of the stage costs l(x_{k+1}, u_k); nan after a crash
    position_rms: float  # m, sqrt(mean |p_k - p_ref,k|^2); nan after a crash
    steady_rms: float  # m, the same over the second half of the time limit; nan after a crash
    effort: float  # N^2, mean |u_k - u_T|^2 of the commands
    settling_time: float  # s, last sample above 5 % of the initial position error; nan if there is none
    violation_share: float  # -, share of steps in which a limit was exceeded
    crashed: bool
    saturation_share: float  # -, share of rotor commands at a face of the box
    decision_p50_ms: float  # ms of wall time in predict, median; nan if not timed
    decision_p99_ms: float  # ms
    decision_max_ms: float  # ms
    relaxed: int  # decisions whose hard rows were made soft
    previous_plan: int  # decisions that took the shifted previous plan
    clipped_sdre: int  # decisions that took the clipped unconstrained input
    hover: int  # decisions that took hover thrust
    iterations_max: int  # most solver iterations of a decision
    worst_violation: dict[str, float]  # constraint name -> largest excess over its limit, SI
    agent: str = ""
    crash_cause: str = ""  # one of `task.crash_causes`
    left_model: int = 0  # decisions whose state or plan left where the policy's model holds
    # Of a team's vehicle; nan where the task or the policy does not have them.
    formation_rms: float = _NAN  # m, distance to the own slot
    formation_final: float = _NAN  # m, its mean over the last second
    formation_settling: float = _NAN  # s, last sample above 0.1 m; nan if it stays above to the end
    min_separation: float = _NAN  # m, smallest distance to another vehicle
    z_error_max: float = _NAN  # m, largest height error to the slot
    z_error_rms: float = _NAN  # m
    messages: float = _NAN  # heard per step
    estimate_rmse: float = _NAN  # m, estimated position of the target, whole flight
    estimate_sigma: float = _NAN  # m, sqrt(mean trace P) of that position, as the policy believes
    anees: float = _NAN  # -, mean of e' P^-1 e of that position / 3; 1 for an honest filter
    nis_ratio: float = _NAN  # -, mean of NIS / rows over the updates; 1 for an honest filter
    trilateration_share: float = _NAN  # -, updates as a trilaterated position; nan if none was

    def row(self) -> dict[str, Any]:
        """Flat form for tables: `worst_violation` becomes one column per constraint."""
        flat = self._asdict()
        worst = flat.pop("worst_violation")
        if not self.agent:
            flat = drop_team_columns(flat)
        return flat | {f"worst_{name}": value for name, value in worst.items()}


def drop_team_columns(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row without the columns that only teams have."""
    return {name: value for name, value in row.items() if name not in TEAM_COLUMNS}
