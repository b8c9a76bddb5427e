"""From what a user gives as a reference to a Reference."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

from ..names import shown, unknown_name
from .tables import CsvTable
from .trajectories import (
    Helix,
    Lemniscate,
    Line,
    OutAndBack,
    Racetrack,
    RandomSmooth,
    Reference,
    SetPoint,
    SphericalSpiral,
)

ReferenceLike: TypeAlias = "str | os.PathLike[str] | Reference"
TABLE_SUFFIXES = (".csv", ".txt", ".tsv", ".dat", ".tum")
_PATHS = f"the path of a table ({', '.join(TABLE_SUFFIXES)})"
_BY_NAME: dict[str, Callable[[], Reference]] = {
    "setpoint": SetPoint,
    "helix": Helix,
    "spiral": SphericalSpiral,
    "lines": OutAndBack,
    "lemniscate": Lemniscate,
    "racetrack": Racetrack,
    "random": RandomSmooth,
    "line": Line,
    "fast-line": lambda: Line((1.5, 0.0, -0.5)),
    "slow-helix": lambda: Helix(2.0, 0.3, -0.1),
}


def is_table(what: object) -> bool:
    """Whether it is the path of a table."""
    if isinstance(what, str):
        return Path(what[:4096]).suffix.lower() in TABLE_SUFFIXES
    return isinstance(what, os.PathLike)


def make_reference(what: object) -> Reference:
    """A reference from a name, the path of a table, or itself.

    Raises:
        ValueError: If it is none of these.
    """
    if isinstance(what, Reference):
        return what
    if isinstance(what, str) and what in _BY_NAME:
        return _BY_NAME[what]()
    if is_table(what):
        return CsvTable(what)  # type: ignore[arg-type]
    if isinstance(what, str):
        raise ValueError(f"{unknown_name('reference', what, _BY_NAME)}, or {_PATHS}")
    raise ValueError(f"reference must be a name, {_PATHS} or a Reference, got {shown(what)}")
