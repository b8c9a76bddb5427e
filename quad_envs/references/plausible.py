"""What a person should be told of a trajectory that can be read but hardly be meant."""

from __future__ import annotations

import numpy as np

from ..parameters import Array

FASTEST = 100.0  # m/s; the fastest multicopters of 2020 reach it
_FASTEST_TARGET = 1e4  # m/s; nothing near the ground is faster
_WINDOW = 0.5  # s, over which a displacement is compared with velocities; rounded positions are noisy
_RELATIVE, _ABSOLUTE = 0.2, 0.05  # of the displacement; m/s, noise of measured velocities
_SHARE = 0.25  # of the windows; a step of a set point contradicts in one
_UP = 0.3  # m above the first height


def contradiction(t: Array, p: Array, v: Array) -> str:
    """Said of velocities (n, 3) that are not those of the positions (n, 3); empty if they are."""
    first = np.searchsorted(t, np.arange(t[0], t[-1], _WINDOW))
    ends = np.unique(np.append(first, t.size - 1))
    flown = np.zeros_like(p)
    flown[1:] = np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t)[:, None], axis=0)
    moved, told = np.diff(p[ends], axis=0), np.diff(flown[ends], axis=0)
    allowed = _RELATIVE * np.linalg.norm(moved, axis=1) + _ABSOLUTE * np.diff(t[ends])
    wrong = np.linalg.norm(told - moved, axis=1) > allowed
    if wrong.mean() <= _SHARE:
        return ""
    speed, other = (float(np.linalg.norm(part, axis=1).sum() / (t[-1] - t[0])) for part in (moved, told))
    return (
        f"the velocities contradict the positions by more than {_RELATIVE:.0%} in {wrong.mean():.0%} of the "
        f"time (mean speed {other:.3g} m/s told, {speed:.3g} m/s by positions): velocities are inertial, in "
        "the axes of the positions, in m/s; without them they are differenced"
    )


def points_up(p: Array) -> str:
    """Said of positions (n, 3) whose z seems to point up, so that the vehicle would dive; else empty."""
    low, high = float(p[:, 2].min()), float(p[:, 2].max())
    if low < -0.1 or high - p[0, 2] < _UP:
        return ""
    return (
        f"z is from {low:.3g} to {high:.3g} m, and positive z is down (NED): the vehicle descends. If z "
        "points up in the table, say axes='enu' or 'flu'; axes='ned' says that it is meant"
    )


def target_too_fast(v: Array, times: Array) -> str:
    """As `too_fast`, of a target, which may be faster than who follows it."""
    return too_fast(v, times, _FASTEST_TARGET, "target moves")


def too_fast(v: Array, times: Array, fastest: float = FASTEST, who: str = "quadrotor flies") -> str:
    """Said of velocities (n, 3) at times (n,) that no vehicle flies; empty if there are none."""
    speed = np.linalg.norm(v, axis=1)
    k = int(np.argmax(speed > fastest))
    if not speed[k] > fastest:
        return ""
    return (
        f"moves at {speed[k]:.4g} m/s at t = {times[k]:g} s; no {who} faster than {fastest:g} m/s: "
        "look at its units, and for a jump or a lost row"
    )
