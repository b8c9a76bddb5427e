"""Axes of tables: which way x, y and z point, and from quaternions and headings in them to psi in NED."""

from __future__ import annotations

import numpy as np

from ..arguments.names import shown, unknown_name
from ..parameters import Array

_Z_DOWN = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_FORWARD_LEFT_UP = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
# M with p_NED = M p.
AXES: dict[str, tuple[tuple[float, float, float], ...]] = {
    "ned": _Z_DOWN,  # north, east, down
    "frd": _Z_DOWN,  # forward, right, down
    "enu": ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),  # east, north, up: ROS, MAVROS
    "nwu": _FORWARD_LEFT_UP,  # north, west, up
    "flu": _FORWARD_LEFT_UP,  # forward, left, up: Crazyflie
}
_NORM_ERROR = 0.05  # of a quaternion; three digits after the point leave 1e-3


def to_ned(axes: str) -> Array:
    """M (3, 3) that takes vectors to NED.

    Raises:
        ValueError: If there are no axes of that name.
    """
    if not isinstance(axes, str) or axes.lower() not in AXES:
        name = axes if isinstance(axes, str) else shown(axes)
        raise ValueError(unknown_name("axes", name, AXES))
    return np.array(AXES[axes.lower()])


def heading_in_ned(psi: Array, M: Array) -> Array:
    """Heading in NED, (n,), unwrapped, rad, of headings from x towards y of other axes (n,)."""
    forward = M[:2, :2] @ np.stack([np.cos(psi), np.sin(psi)])
    return np.unwrap(np.arctan2(forward[1], forward[0]))


def heading_of_quaternions(q: Array) -> Array:
    """Angle from x towards y of the body's x axis, (n,), rad.

    Args:
        q: Body to world as x, y, z, w, (n, 4).

    Raises:
        ValueError: If one is no unit quaternion; the message begins with its row, counted from 0.
    """
    norm = np.linalg.norm(q, axis=1)
    bad = np.abs(norm - 1.0) > _NORM_ERROR
    if bad.any():
        raise ValueError(f"{int(np.argmax(bad))}: a quaternion of length {norm[np.argmax(bad)]:.3g}")
    x, y, z, w = (q / norm[:, None]).T
    return np.asarray(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
