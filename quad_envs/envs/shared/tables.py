"""What is drawn or tabulated at reset, for one vehicle or many: references, disturbances, the vehicle itself.

Everything that comes from a user's object is checked here, so that the compiled step reads only good rows.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...arguments.names import shown
from ...compilation.decorators import entry_of
from ...disturbances import Disturbance
from ...observations.tracking import N_REFERENCE
from ...parameters import Array
from ...references import Reference, too_fast
from ...references.plausible import FASTEST
from ...references.table_row import N_TABLE
from ...references.turning import tabulate
from ...tasks import BaseTask

_tabulate = entry_of(tabulate)


def reference_rows(reference: Reference, times: Array, rng: np.random.Generator) -> Array:
    """Reference rows at the control samples (n,) >= 2, with rate and angle of the heading, (n, N_TABLE).

    Raises:
        ValueError: If the reference gives another shape or a number that is not finite, or is too fast.
    """
    given = reference.rows(times, rng)
    rows = np.ascontiguousarray(given, dtype=np.float64)
    table = np.empty((times.size, N_TABLE))
    if rows.shape == (times.size, N_REFERENCE) and _tabulate(rows, times[1] - times[0], FASTEST, table):
        return table
    rows = checked_rows("reference", reference, given, times, N_REFERENCE)
    said = too_fast(rows[:, 3:6], times)
    if said:
        raise ValueError(f"reference {shown(reference)} {said}")
    return table


def checked_rows(kind: str, source: object, rows: Any, times: Array, width: int) -> Array:
    """Rows that a user's object gave for times (n,), as a float64 array (n, width).

    Raises:
        ValueError: If the shape is another or a number is not finite.
    """
    found = np.asarray(rows, dtype=np.float64)
    if found.shape != (times.size, width):
        raise ValueError(
            f"{kind} {shown(source)} must give rows of shape {(times.size, width)}, got {found.shape}"
        )
    if not np.isfinite(found).all():
        k = int(np.argmin(np.isfinite(found).all(axis=1)))
        raise ValueError(f"{kind} {shown(source)} is not finite at t = {times[k]:g} s")
    return found


def disturbance_rows(disturbance: Disturbance, nodes: Array, dt: float, rng: np.random.Generator) -> Array:
    """Disturbances at the stage times nodes (n_steps, n_nodes), (n_steps, n_nodes, 6).

    Raises:
        ValueError: If the disturbance gives another shape or a number that is not finite.
    """
    rows = np.asarray(disturbance.values(nodes, rng), dtype=np.float64)
    if rows.shape != (*nodes.shape, 6):
        raise ValueError(
            f"disturbance {shown(disturbance)} must give values of shape {(*nodes.shape, 6)}, "
            f"got {rows.shape}"
        )
    if not np.isfinite(rows).all():
        k = int(np.argmin(np.isfinite(rows).all(axis=(1, 2))))
        raise ValueError(f"disturbance {shown(disturbance)} is not finite at t = {k * dt:g} s")
    return rows


def stage_times(task: BaseTask, substeps: int) -> Array:
    """Times of the integrator's stages in each control period, (episode_steps, 2 substeps + 1), s."""
    periods = np.arange(task.episode_steps, dtype=np.float64)[:, None]
    return np.asarray(task.dt * (periods + np.linspace(0.0, 1.0, 2 * substeps + 1)))
