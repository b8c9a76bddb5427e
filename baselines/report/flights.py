"""From the file of a flight to the channels that the page draws."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baselines.evaluation.columns import Record
from quad_envs.parameters import ATTITUDE, FORCES, POSITION, Array

from .model import Flight
from .quantise import Blobs, encode

_MILLI = 1e3  # s to ms
_LOWER = (np.array([0, 1, 1, 2, 2, 2]), np.array([0, 0, 1, 0, 1, 2]))  # xx, yx, yy, zx, zy, zz
_LOG = ("decision", "nees")


class BadFlightError(ValueError):
    """A file of a flight that is missing or damaged; the text says which, for the person who looks."""


def read_flight(
    path: Path, policy: str, team: Sequence[Record], task: Mapping[str, Any], blobs: Blobs, stride: int = 1
) -> Flight:
    """The flight of a file in episodes/.

    Args:
        path: The file.
        policy: Title of who flew.
        team: Records of its vehicles, one without a team.
        task: See `folder.task_facts`.
        blobs: Where the series go.
        stride: Rows from one that is kept to the next.

    Raises:
        BadFlightError: If it is missing, damaged, or not the file of a flight.
    """
    try:
        if path.exists() and not path.is_file():  # a pipe would never end
            raise ValueError("it is not a regular file")
        # Opened here, because np.load leaves a damaged file open.
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = {key: file[key] for key in file.files}
        return _flight(arrays, policy, team, task, blobs, stride)
    except FileNotFoundError as error:
        raise BadFlightError(f"episodes/{path.name} is missing: this flight is not shown") from error
    except (OSError, ValueError, KeyError, IndexError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        what = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadFlightError(f"episodes/{path.name} is damaged ({what}): this flight is not shown") from error


def _flight(
    arrays: Mapping[str, NDArray[Any]],
    policy: str,
    team: Sequence[Record],
    task: Mapping[str, Any],
    blobs: Blobs,
    stride: int,
) -> Flight:
    """The flight of its arrays."""
    one = dict(arrays) if "lengths" in arrays else {key: value[None] for key, value in arrays.items()}
    steps = one["rewards"].shape[1]
    if not steps or one["states"].shape[1] != steps + 1:
        raise ValueError("its arrays do not fit together")
    lengths = one["lengths"] if "lengths" in arrays else np.array([steps])
    if len(lengths) != len(team):
        raise ValueError(f"it has {len(lengths)} vehicles and the results have {len(team)}")
    tables = _own_channels(one, task) | _team_channels(one)
    channels = tuple(
        encode(name, np.asarray(table[:, ::stride], dtype=np.float64), blobs, log=name in _LOG)
        for name, table in tables.items()
        if table.shape[2] and np.isfinite(table).any()
    )
    graphs, schedule = _links(arrays, stride)
    return Flight(
        policy=policy,
        seed=team[0].seed,
        dt=float(task["dt"]) * stride,
        lengths=tuple(int(-(-length // stride)) for length in lengths),
        crashed=tuple(record.crashed for record in team),
        score=float(np.mean([record.score for record in team])),
        channels=channels,
        graphs=graphs,
        schedule=schedule,
    )


def _own_channels(one: Mapping[str, NDArray[Any]], task: Mapping[str, Any]) -> dict[str, Array]:
    """What every vehicle has, name -> (vehicles, rows, components)."""
    states = one["states"]
    found = {
        "p": states[..., POSITION],
        "attitude": states[..., ATTITUDE],
        "forces": states[..., FORCES],
        "reference": one["references"][..., POSITION],
        "constraints": one["constraint_values"],
        "decision": _MILLI * one["decision_times"][..., None],
    }
    if task.get("mission") == "estimation":  # vehicles on rails follow nothing and command nothing
        for name in ("reference", "forces", "constraints", "attitude"):
            del found[name]
    return found


def _team_channels(one: Mapping[str, NDArray[Any]]) -> dict[str, Array]:
    """What a team adds to it."""
    found = {}
    for name, key in (("slot_error", "formation_error"), ("separation", "min_separation")):
        if key in one:
            found[name] = one[key][..., None]
    if "target" in one:
        found["target"] = one["target"][None, :, :3]
    if "target" not in one or "estimate_error" not in one:
        return found
    error, P = one["estimate_error"][..., :3], one["estimate_covariance"][..., :3, :3]
    found["estimate"] = error + found["target"][:, : error.shape[1]]
    root = _roots(P)
    found["root"] = root[..., _LOWER[0], _LOWER[1]]
    usable = np.isfinite(root).all(axis=(-2, -1)) & np.isfinite(error).all(axis=-1)
    white = np.linalg.solve(np.where(usable[..., None, None], root, np.eye(3)), error[..., None])[..., 0]
    found["nees"] = np.where(usable, (white * white).sum(axis=-1), np.nan)[..., None]
    return found


def _roots(P: Array) -> Array:
    """Lower Cholesky factors, (..., 3, 3); nan where a covariance is not given or not positive definite."""
    out = np.full(P.shape, np.nan)
    given = np.asarray(np.isfinite(P).all(axis=(-2, -1)))
    given[given] = np.linalg.eigvalsh(P[given])[:, 0] > 0.0
    out[given] = np.linalg.cholesky(P[given])
    return out


def _links(
    arrays: Mapping[str, NDArray[Any]], stride: int
) -> tuple[tuple[tuple[tuple[int, int], ...], ...], tuple[tuple[int, int], ...]]:
    """Links of each graph, and from which row on which one holds."""
    if "graphs" not in arrays:
        return (), ()
    graphs = tuple(
        tuple((int(i), int(j)) for i, j in np.argwhere(graph > 0.0) if i != j) for graph in arrays["graphs"]
    )
    which = arrays["graph_of_step"][::stride]
    changes = np.flatnonzero(np.diff(which, prepend=-1))
    return graphs, tuple((int(row), int(which[row])) for row in changes)
