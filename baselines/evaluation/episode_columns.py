"""A flight as a table: one row per control period, columns by their names in the mathematics.

`GROUPS` says what they are. Behind them stand `limit_<name>` for each of `task.constraint_names`, value minus
limit, SI, and what a team adds, see `team_signals.py`, entries of arrays as name_0, name_0_1, ... What
belongs to the step from k to k + 1 is nan in the last row.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_envs.parameters import ATTITUDE, FORCES, POSITION, RATES, VELOCITY, Array


class Group(NamedTuple):
    """Columns that are read together."""

    names: tuple[str, ...]
    unit: str  # "" if they have none
    about: str
    read: Callable[[Any], NDArray[Any]]  # an `Episode` -> (T+1 or T, number of names)


def _plant(part: slice) -> Callable[[Any], NDArray[Any]]:
    return lambda episode: np.asarray(episode.states[:, part])


def _reference(part: slice) -> Callable[[Any], NDArray[Any]]:
    return lambda episode: np.asarray(episode.references[:, part])


def _step(field: str) -> Callable[[Any], NDArray[Any]]:
    return lambda episode: np.asarray(getattr(episode, field))[:, None]


def _time(episode: Any) -> Array:
    return np.arange(len(episode.rewards) + 1.0)[:, None] * float(episode.task.dt)


def _heading(episode: Any) -> Array:
    return np.asarray(np.arctan2(episode.references[:, 6], episode.references[:, 7]))[:, None]


_ROTORS = ("F1", "F2", "F3", "F4")
_PLANT = (
    Group(("x", "y", "z"), "m", "position, NED: z points down", _plant(POSITION)),
    Group(("u", "v", "w"), "m/s", "velocity, body axes", _plant(VELOCITY)),
    Group(("phi", "theta", "psi"), "rad", "roll, pitch, yaw", _plant(ATTITUDE)),
    Group(("p", "q", "r"), "rad/s", "body rates", _plant(RATES)),
    Group(_ROTORS, "N", "rotor forces", _plant(FORCES)),
)
_REFERENCE = (
    Group(("x_ref", "y_ref", "z_ref"), "m", "reference, NED", _reference(POSITION)),
    Group(("vx_ref", "vy_ref", "vz_ref"), "m/s", "its velocity, NED", _reference(VELOCITY)),
    Group(("psi_ref",), "rad", "its heading", _heading),
)
_STEPS = (
    Group(tuple(f"{name}_command" for name in _ROTORS), "N", "commands", lambda episode: episode.commands),
    Group(("reward",), "", "of the step", _step("rewards")),
    Group(("stage_cost",), "", "of the step, l", _step("stage_costs")),
    Group(("constraint_cost",), "", "sum of violation / scale over the limits", _step("costs")),
    Group(("violated",), "", "whether any limit was exceeded, 0 or 1", _step("violations")),
    Group(("decision_time",), "s", "wall time in predict per vehicle", _step("decision_times")),
)
_TIME = Group(("t",), "s", "k dt, k = 0..T", _time)
GROUPS = (_TIME, *_PLANT, *_REFERENCE, *_STEPS)


def episode_columns(episode: Any) -> dict[str, Array]:
    """Name -> (T+1,), the columns of an `Episode`; what the environment does not show is left out."""
    steps = len(episode.rewards)
    shown = (
        _TIME,
        *(_PLANT if episode.states.shape[1] else ()),
        *(_REFERENCE if len(episode.references) > steps else ()),
        *_STEPS,
    )
    found: dict[str, NDArray[Any]] = {}
    for group in shown:
        found |= dict(zip(group.names, group.read(episode).T, strict=True))
    limits = zip(episode.task.constraint_names, episode.constraint_values.T, strict=True)
    found |= {f"limit_{name}": values for name, values in limits}
    found |= dict(_entries(episode.signals))
    return {name: _full(values, steps + 1) for name, values in found.items()}


def _full(values: NDArray[Any], rows: int) -> Array:
    """(rows,), nan behind what is shorter."""
    out = np.full(rows, np.nan)
    out[: len(values)] = values
    return out


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
