"""Reference trajectories, as data: rows [p_ref 3, v_ref 3, sin psi_ref, cos psi_ref] at given times.

A trajectory of your own is `from_function(f)`, `from_csv(path)`, or any object with `random` and
`rows(t, rng)`. One that has an end says so as `interval`, (first, last) time in s; one that depends on the
episode has `in_episode(dt, time_limit)`, which returns what is flown.
"""

from .arrays import ArrayTable
from .choices import REFERENCES, ReferenceLike, is_frame, is_table, make_reference, plain_reference
from .episodes import in_episode, length_of, mismatch, state_on
from .functions import from_function
from .mixture import Mixture
from .plausible import too_fast
from .tables import ColumnTable, CsvTable, from_csv
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
    pack_rows,
)

__all__ = [
    "REFERENCES",
    "ArrayTable",
    "ColumnTable",
    "CsvTable",
    "Heading",
    "Helix",
    "Lemniscate",
    "Line",
    "Mixture",
    "OutAndBack",
    "Racetrack",
    "RandomSmooth",
    "Reference",
    "ReferenceLike",
    "SetPoint",
    "SphericalSpiral",
    "from_csv",
    "from_function",
    "in_episode",
    "is_frame",
    "is_table",
    "length_of",
    "make_reference",
    "mismatch",
    "pack_rows",
    "plain_reference",
    "state_on",
    "too_fast",
]
