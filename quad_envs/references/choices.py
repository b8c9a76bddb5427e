"""From what a user gives as a reference to a Reference."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from ..arguments.kinds import make_kind, refuse_class, without_booleans
from ..arguments.names import shown, unknown_name
from .arrays import ArrayTable, from_numbers
from .functions import FunctionReference
from .mixture import Mixture
from .tables import ColumnTable, CsvTable
from .trajectories import (
    Heading,
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

ReferenceLike: TypeAlias = (
    "str | os.PathLike[str] | Reference | Mapping[str, Any] | Callable[[float], ArrayLike] | ArrayLike"
)
TABLE_SUFFIXES = (".csv", ".txt", ".tsv", ".dat", ".tum")
_PATHS = f"the path of a table ({', '.join(TABLE_SUFFIXES)})"
REFERENCES: dict[str, Any] = {
    "setpoint": SetPoint(),
    "helix": Helix(),
    "spiral": SphericalSpiral(),
    "lines": OutAndBack(),
    "lemniscate": Lemniscate(),
    "racetrack": Racetrack(),
    "random": RandomSmooth(),
    "mixture": Mixture(),
    "line": Line(),
    "fast-line": Line((1.5, 0.0, -0.5)),
    "slow-helix": Helix(2.0, 0.3, -0.1),
    "heading": Heading,
    "csv": CsvTable,
    "columns": ColumnTable,
    "array": ArrayTable,
}


def is_table(what: object) -> bool:
    """Whether it is the path of a table."""
    if isinstance(what, str):
        return Path(what[-4096:]).suffix.lower() in TABLE_SUFFIXES
    return isinstance(what, os.PathLike)


def is_frame(what: object) -> bool:
    """Whether it is a data frame, as of pandas or polars."""
    return hasattr(what, "columns") and hasattr(what, "to_numpy")


def plain_reference(what: Any) -> Reference | None:
    """A reference from a plain Python object: a mapping, a data frame, a function, an array; else None."""
    if isinstance(what, Mapping):
        if "kind" in what:
            made: Reference = make_kind("reference", what, REFERENCES, {"reference": make_reference})
            return made
        return ColumnTable(what)
    if is_frame(what):
        return ColumnTable({str(name): np.asarray(what[name]) for name in what.columns})
    if callable(what):
        return FunctionReference(what)
    if isinstance(what, np.ndarray | Sequence) and not isinstance(what, str | bytes):
        return from_numbers(what)
    return None


def make_reference(what: Any) -> Reference:
    """A reference from what a user has at hand.

    Args:
        what: A name, the path of a table, a mapping {"kind": "helix", "radius": 2}, columns {"t": ...,
            "x": ..., "y": ..., "z": ...} or a data frame, a function as `from_function` has it, an array as
            `ArrayTable` has it, three numbers (a set point), or a Reference.

    Raises:
        ValueError: If it is none of these.
    """
    refuse_class("reference", what)
    if isinstance(what, Reference):
        checked: Reference = without_booleans("reference", what, REFERENCES)
        return checked
    if isinstance(what, str) and what in REFERENCES:
        return make_reference({"kind": what})
    if is_table(what):
        return CsvTable(what)
    if isinstance(what, str):
        raise ValueError(f"{unknown_name('reference', what, REFERENCES)}, or {_PATHS}")
    made = plain_reference(what)
    if made is None:
        raise ValueError(
            f"reference must be a name, {_PATHS}, a mapping with 'kind', a function of time, an array or a "
            f"Reference, got {shown(what)}"
        )
    return made
