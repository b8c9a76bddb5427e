"""Tracking observations in axes that are turned, about the vertical, by the present heading of the reference.

The equations of motion do not know where north is. In these axes a trajectory that is turned together with
its heading looks the same: what a network has learned in one direction holds in all.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..compilation.decorators import entry_of, kernel
from ..references.table_row import N_REFERENCE
from .team import AgentLayout
from .tracking import TrackingLayout

_Floats = NDArray[np.float32]
_SIN_PSI = 5  # in an observation; its cosine follows
_V, _HEADING = 3, 6  # in a stage of the preview: velocity, sine and cosine of the heading
_FORCE = 3  # in a disturbance, behind the torque, which is in body axes


@kernel
def _turn_pair(row: _Floats, x: int, sine: float, cosine: float) -> None:
    """Components of a horizontal vector at x and x + 1 in axes turned by an angle."""
    a, b = row[x], row[x + 1]
    row[x], row[x + 1] = cosine * a + sine * b, cosine * b - sine * a


@kernel
def turn_rows(preview: int, stages: int, forces: NDArray[np.int64], rows: _Floats) -> None:
    """Turn observations, (n, d), in their place.

    Args:
        preview: Where the preview begins in a row.
        stages: Of the preview.
        forces: Where there are forces in inertial axes.
        rows: Observations.
    """
    for j in range(rows.shape[0]):
        row = rows[j]
        sine, cosine = np.float64(row[preview + _HEADING]), np.float64(row[preview + _HEADING + 1])
        # (sin a, cos a) is a vector whose angle from its second axis falls as axes turn: swapped signs.
        _turn_pair(row, _SIN_PSI, -sine, cosine)
        for q in range(stages):
            start = preview + N_REFERENCE * q
            _turn_pair(row, start, sine, cosine)
            _turn_pair(row, start + _V, sine, cosine)
            _turn_pair(row, start + _HEADING, -sine, cosine)
        for at in forces:
            _turn_pair(row, at, sine, cosine)


_turn = entry_of(turn_rows)


class HeadingAxes:
    """Turns observations of one layout; an observed position stays as it is, as its limits do.

    Args:
        layout: Of a task of one vehicle.

    Raises:
        ValueError: If it is that of a team, whose vehicles have other headings than their references.
    """

    def __init__(self, layout: TrackingLayout | AgentLayout) -> None:
        if not isinstance(layout, TrackingLayout):
            raise ValueError("heading_axes are for observations of one vehicle, got those of a team")
        self._start, self._stages, self._size = layout.preview_start, layout.preview + 1, layout.size
        parts = [
            layout.slices[name] for name in ("disturbance", "disturbance_estimate") if name in layout.slices
        ]
        self._forces = np.array([part.start + _FORCE for part in parts], dtype=np.int64)

    def turn(self, observations: NDArray[Any]) -> _Floats:
        """Observations (..., d) in these axes, a copy."""
        rows = np.array(observations, dtype=np.float32, order="C")
        _turn(self._start, self._stages, self._forces, rows.reshape(-1, self._size))
        return rows
