"""What a picture of a flight shows, as data, and how space comes to lie in it. Nothing here draws.

The projection is orthographic from above the team's left, with a fixed direction, so that lengths compare
anywhere in a picture and up in the world is up on the screen although z points down.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..parameters import Array

Bools = NDArray[np.bool_]

_HEADING = math.radians(-52.0)  # of the line of sight; flights to the north go to the right and away
_ELEVATION = math.radians(28.0)  # from which the camera looks down
_SINE, _COSINE = math.sin(_ELEVATION), math.cos(_ELEVATION)
# Rows: right on the screen, up on the screen, away from the camera; orthonormal, NED.
CAMERA: Array = np.array(
    [
        [-math.sin(_HEADING), math.cos(_HEADING), 0.0],
        [_SINE * math.cos(_HEADING), _SINE * math.sin(_HEADING), -_COSINE],
        [_COSINE * math.cos(_HEADING), _COSINE * math.sin(_HEADING), _SINE],
    ]
)

_WIDE = 4.0  # m, half of the picture up to which the whole episode fits and the camera stands still
_LEAST = 1.2  # m, half of the narrowest picture
_WINDOWS = (4.0, 2.0, 1.0, 0.5, 0.25)  # s, before and after, of the way that is seen where the camera follows
_FLOOR = 1.0  # m below the lowest wanted position
_RETURN = 0.93  # per step, how fast the picture narrows once everybody is back


class Scene(NamedTuple):
    """One moment of a flight. n vehicles fly; positions are NED, m."""

    title: str
    lines: tuple[str, ...]  # time, score and what else is worth a line
    limits: tuple[tuple[str, bool], ...]  # text of each limit, whether it is violated
    ended: str  # why the episode is over; empty while it goes on
    plants: Array  # (n, 16)
    numbers: tuple[int, ...]  # of the vehicles in their team
    leader: int  # row of the leader, -1 for none
    violated: Bools  # (n,), any limit
    crowded: Bools  # (n,), the separation
    trails: Array  # (m, n, 3), oldest first, the present last
    wrecks: Array  # (c, 3), where vehicles crashed
    behind: Array  # (a, 3), the reference up to now
    ahead: Array  # (b, 3), and from now on
    slots: Array  # (n, 3), where each should be now
    overview: Array  # (q, 3), the reference of the whole episode; no rows where all of it is in view
    target: Array  # (m, 3), trail of the target, the present last; no rows for none
    estimates: Array  # (e, 3), where vehicles believe the target to be
    sights: Bools  # (n,), who measures the target
    links: NDArray[np.int64]  # (l, 2), rows of hearer and sender
    strength: Array  # (l, 2), weight relative to the largest, freshness in [0, 1]
    box: Array  # (2, 3), limits of the position, lower and upper; no rows for none
    view: Array  # (4,), part of the image plane that must be seen: left, bottom, right, top, m
    ground: tuple[float, float, float, float]  # middle x, y, z and radius of the grid, m
    arm: float  # m
    arms: Array  # (4, 2), places of the rotors over the arm, body axes
    separation: float  # m, 0 for none
    forces: tuple[float, Array]  # rotor force in hover; largest, (4,), N


def project(points: ArrayLike) -> Array:
    """Image-plane coordinates (right, up), m, of positions: (..., 3) to (..., 2)."""
    return np.asarray(np.asarray(points, dtype=np.float64) @ CAMERA[:2].T)


def depth(points: ArrayLike) -> Array:
    """Distance along the line of sight, (..., 3) to (...,), m; larger is farther away."""
    return np.asarray(np.asarray(points, dtype=np.float64) @ CAMERA[2])


class Framing:
    """Which part of the image plane a picture shows at each step of an episode.

    The picture follows what is known beforehand, the wanted positions: they lie still in it where a whole
    episode fits, else it moves with a window of time, as smoothly as they do. It widens at once for a vehicle
    that is elsewhere, and narrows slowly when that is over.

    Args:
        wanted: Positions of whatever should be seen, (n, T+1, 3), m.
        box: Limits of the position, (2, 3) or no rows.
        dt: Control period, s.
    """

    def __init__(self, wanted: Array, box: Array, dt: float) -> None:
        if box.size and np.isfinite(box).all():
            corners = np.repeat(box_corners(box)[:, None], wanted.shape[1], axis=1)
            wanted, margin = np.concatenate([wanted, corners]), 0.0
        else:
            margin = _FLOOR
        steps = wanted.shape[1]
        low, high = _extremes(wanted)
        everything = float((high - low)[:, :5].max())
        for window in (steps, *(max(1, round(seconds / dt)) for seconds in _WINDOWS)):
            least, most = _running(low, window, np.min), _running(high, window, np.max)
            if 0.5 * float((most - least)[:, :5].max()) <= max(_WIDE, 0.6 * everything):
                break
        self.follows = window < steps
        middle, half = 0.5 * (least + most), 0.5 * (most - least).max(axis=0)
        floor = most[:, 4] + margin
        radius = float(np.hypot(half[2], half[3])) + _FLOOR
        self._grounds = np.column_stack([middle[:, 2:4], floor, np.full(steps, radius)])
        # What is wanted, and the ground below it.
        below = least[:, 5] + CAMERA[1, 2] * floor
        least, most = np.column_stack([least[:, 0], np.minimum(least[:, 1], below)]), most[:, :2]
        middle, half = 0.5 * (least + most), np.maximum(0.5 * (most - least).max(axis=0), _LEAST)
        self._rects = np.concatenate([middle - half, middle + half], axis=1)
        self._more, self._step = np.zeros(4), 0

    def view(self, k: int, seen: Array) -> Array:
        """Left, bottom, right, top at step k, (4,), m, so that the positions seen (n, 3) are inside."""
        rect = self._rects[min(k, len(self._rects) - 1)]
        self._more *= _RETURN ** max(0, k - self._step)
        self._step = k
        if seen.size:
            uv = project(seen)
            beyond = np.concatenate([rect[:2] - uv.min(axis=0), uv.max(axis=0) - rect[2:]])
            self._more = np.maximum(self._more, beyond)
        return np.asarray(rect + self._more * (-1.0, -1.0, 1.0, 1.0))

    def ground(self, k: int) -> tuple[float, float, float, float]:
        """Middle x, y, z and radius of the grid at step k, m."""
        x, y, z, radius = self._grounds[min(k, len(self._grounds) - 1)].tolist()
        return x, y, z, radius


def _extremes(points: Array) -> tuple[Array, Array]:
    """Smallest and largest u, v, x, y, z, and v if z were 0, of points (n, T, 3) at each step, (T, 6)."""
    uv = project(points)
    six = np.concatenate([uv, points, uv[..., 1:] - CAMERA[1, 2] * points[..., 2:]], axis=-1)
    return six.min(axis=0), six.max(axis=0)


def _running(rows: Array, window: int, extreme: Callable[..., Array]) -> Array:
    """Extreme of the rows (T, c) over up to `window` steps before and after each, (T, c)."""
    if window >= len(rows):
        return np.broadcast_to(extreme(rows, axis=0), rows.shape)
    padded = np.pad(rows, ((window, window), (0, 0)), mode="edge")
    slices = np.lib.stride_tricks.sliding_window_view(padded, 2 * window + 1, axis=0)
    return extreme(slices, axis=-1)


def box_corners(box: Array) -> Array:
    """Corners of a box (2, 3), (8, 3); corner number 4 a + 2 b + c has bound a in x, b in y, c in z."""
    which = np.array([[n >> 2, n >> 1 & 1, n & 1] for n in range(8)])
    return np.asarray(np.take_along_axis(box, which, axis=0))
