"""Tables 4.1 and 4.2: RMS and effort of LMPC and SDC-NMPC on three tasks at five horizons.

Both are fitted. The text shows its trajectories as pictures, and ours were identified from these very cells
(`identification`): that the numbers agree is no evidence for the implementation. What is left as a prediction
is an order, that NMPC has the lower RMS: it holds for the whole families that were searched.
"""

from __future__ import annotations

from collections.abc import Sequence

from .flights import CLIMBING, DESCENDING, Flight, Outcome, fly_all
from .published import TABLE_4_1, TABLE_4_2, Printed
from .results import Cell, Section

HORIZONS = (10, 15, 25, 35, 45)
FITTED_TO = (
    "The text shows its trajectories as pictures, and ours were identified from these very cells: that they "
    "agree is no evidence, and what is left as a prediction is that NMPC has the lower RMS, which holds for "
    "the whole family of each trajectory (quad-envs reproduce identification)."
)


_FLOWN: dict[tuple[bool, str, int, str], Outcome] = {}  # flights of this process, by (climbing, *key)


def table_flights(
    controllers: Sequence[str], climbing: bool = False, jobs: int = 1
) -> dict[tuple[str, int, str], Outcome]:
    """(task, horizon, controller) -> flight, over all cells of the tables.

    Each is flown once in a process and kept: both tables and several claims look at the same flights. How
    many jobs flew them changes decision times only, and nobody reads those here.
    """
    tasks = CLIMBING if climbing else DESCENDING
    keys = [(task, N, name) for task in tasks for N in HORIZONS for name in controllers]
    missing = [key for key in keys if (climbing, *key) not in _FLOWN]
    flights = [Flight(name, tasks[task], horizon=N) for task, N, name in missing]
    for key, outcome in zip(missing, fly_all(flights, jobs), strict=True):
        _FLOWN[(climbing, *key)] = outcome
    return {key: _FLOWN[(climbing, *key)] for key in keys}


def _cells(printed: Sequence[Printed], quantity: str, ours: dict[tuple[str, int, str], float]) -> list[Cell]:
    cells = []
    for row in printed:
        for label, controller, value in (("LMPC", "LMPC", row.lmpc), ("NMPC", "SDC 1/2", row.nmpc)):
            where = f"{row.task}, N = {row.horizon}, {label}"
            cells.append(Cell(where, quantity, value, ours[row.task, row.horizon, controller]))
    return cells


def table_4_1(jobs: int = 1) -> Section:
    """Average position RMS."""
    flown = table_flights(("LMPC", "SDC 1/2"), jobs=jobs)
    ours = {key: outcome.record.position_rms for key, outcome in flown.items()}
    cells = _cells(TABLE_4_1, "RMS, m", ours)
    title = "Table 4.1, average position RMS, m (NMPC with alpha = 1/2)"
    return Section("table-4.1", title, cells, [], fitted=FITTED_TO)


def table_4_2(jobs: int = 1) -> Section:
    """Average input effort."""
    flown = table_flights(("LMPC", "SDC 1/2"), jobs=jobs)
    ours = {key: outcome.record.effort for key, outcome in flown.items()}
    cells = _cells(TABLE_4_2, "effort, N^2", ours)
    title = "Table 4.2, average input effort, N^2 (NMPC with alpha = 1/2)"
    return Section("table-4.2", title, cells, [], fitted=FITTED_TO)
