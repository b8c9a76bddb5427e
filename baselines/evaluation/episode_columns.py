"""A flight as a table: one row per control period, columns by their names in the mathematics.

| column | unit | content |
|---|---|---|
| t | s | k dt, k = 0..T |
| x, y, z | m | position, NED: z points down |
| u, v, w | m/s | velocity, body axes |
| phi, theta, psi | rad | roll, pitch, yaw |
| p, q, r | rad/s | body rates |
| F1 ... F4 | N | rotor forces |
| x_ref ... z_ref, vx_ref ... vz_ref | m, m/s | reference and its velocity, NED |
| psi_ref | rad | reference heading |
| F1_command ... F4_command | N | commanded from k to k + 1, as all below; nan in the last row |
| reward, stage_cost | - | of the step |
| constraint_cost | - | sum of violation / scale over the limits |
| violated | 0, 1 | whether any limit was exceeded |
| limit_... | SI | value minus limit, one column per row of `task.constraint_names` |
| decision_time | s | wall time in `predict` per vehicle; nan where it was not measured |
| others | | what a team adds, see `team_signals.py`; entries of arrays as name_0, name_0_1, ... |
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_envs.parameters import Array

_FORCES = ("F1", "F2", "F3", "F4")
_STATE = ("x", "y", "z", "u", "v", "w", "phi", "theta", "psi", "p", "q", "r", *_FORCES)
_REFERENCE = ("x_ref", "y_ref", "z_ref", "vx_ref", "vy_ref", "vz_ref")
_STEP = {
    "reward": "rewards",
    "stage_cost": "stage_costs",
    "constraint_cost": "costs",
    "violated": "violations",
    "decision_time": "decision_times",
}


def episode_columns(episode: Any) -> dict[str, Array]:
    """Name -> (T+1,), the table above, of an `Episode`; what the environment does not show is left out."""
    steps, task = len(episode.rewards), episode.task
    found: dict[str, Array] = {"t": np.arange(steps + 1.0) * float(task.dt)}
    if episode.states.shape[1] == len(_STATE):
        found |= dict(zip(_STATE, episode.states.T, strict=True))
    if len(episode.references) > steps:
        found |= dict(zip(_REFERENCE, episode.references[:, :6].T, strict=True))
        found["psi_ref"] = np.arctan2(episode.references[:, 6], episode.references[:, 7])
    per_step: dict[str, NDArray[Any]] = {
        f"{name}_command": values for name, values in zip(_FORCES, episode.commands.T, strict=True)
    }
    per_step |= {name: getattr(episode, field) for name, field in _STEP.items()}
    limits = zip(task.constraint_names, episode.constraint_values.T, strict=True)
    per_step |= {f"limit_{name}": values for name, values in limits}
    per_step |= dict(_entries(episode.signals))
    for name, values in per_step.items():
        found[name] = np.append(np.asarray(values, dtype=np.float64), np.nan)
    return found


def _entries(signals: Mapping[str, NDArray[Any]]) -> Iterator[tuple[str, NDArray[Any]]]:
    """Signals of one number per step, and each entry of the others."""
    for name, values in signals.items():
        for index in np.ndindex(*values.shape[1:]):
            yield "_".join([name, *map(str, index)]), values[(slice(None), *index)]


def as_csv(columns: Mapping[str, Array]) -> str:
    """The text of a table; what is not a number stays empty, and numbers come back as they were."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in np.stack(list(columns.values()), axis=1).tolist():
        writer.writerow("" if value != value else repr(value) for value in row)
    return text.getvalue()
