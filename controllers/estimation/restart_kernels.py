"""Where a target filter begins anew when its measurements say that it is lost; compiled, without allocation.

A lost filter cannot come back by itself: linearised at the wrong place it takes a small gain for a large
error, or throws the velocity. So it becomes a new one: with range and angles a measurement is a position,
ranges alone give the nearest place that they allow, angles alone the place where lines of sight
meet, and the velocity is what is known before anything is measured.
"""

from __future__ import annotations

import math

from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import Array
from quad_envs.sensors import AZIMUTH, ELEVATION, RANGE

from .arguments import BoolArray
from .trilateration_kernels import NEAREST_SCRATCH, condition_number, nearest_point, solve_definite

RESTART_SCRATCH = NEAREST_SCRATCH + 3  # and 4 per measurement
_N = 6  # states
_PARALLEL = 100.0  # condition of A, above which lines meet nowhere in particular: two within 11 degrees


@kernel
def _measured_point(z: Array, position: Array, age: float, x: Array, out: Array) -> None:
    """Where a measurement of range and angles puts the target now, (3,)."""
    level = z[RANGE] * math.cos(z[ELEVATION])
    out[0] = position[0] + level * math.cos(z[AZIMUTH]) + age * x[3]
    out[1] = position[1] + level * math.sin(z[AZIMUTH]) + age * x[4]
    out[2] = position[2] - z[RANGE] * math.sin(z[ELEVATION]) + age * x[5]


@kernel
def begin_anew(x: Array, P: Array, restart: Array) -> None:
    """What does not depend on the measurements: x_4..x_6 and a diagonal P."""
    for i in range(_N):
        for j in range(_N):
            P[i, j] = restart[3 + i] if i == j else 0.0
    for a in range(3):
        x[3 + a] = restart[a]


@kernel
def restart_at_directions(
    x: Array, P: Array, z: Array, position: Array, age: Array, sigma: Array, restart: Array, use: Array
) -> int:
    """Put x and P where the most central measurement of range and angles says; returns which it is.

    Most central: with the smallest sum of distances to what the others say, so that of three or more a false
    one is not chosen. P = R diag(sigma_rho^2, (rho max(cos el, sigma_el) sigma_az)^2, (rho sigma_el)^2) R',
    plus age^2 times the variance of the velocity.
    """
    begin_anew(x, P, restart)
    point, other = P[3, :3], P[4, :3]  # scratch: zero again below
    best, least = -1, math.inf
    for j in range(use.shape[0]):
        if use[j] != 0.0:
            _measured_point(z[j], position[j], age[j], x, point)
            total = 0.0
            for k in range(use.shape[0]):
                if use[k] != 0.0:
                    _measured_point(z[k], position[k], age[k], x, other)
                    square = 0.0
                    for a in range(3):
                        square += (point[a] - other[a]) ** 2
                    total += math.sqrt(square)
            if total < least:
                best, least = j, total
    for a in range(3):
        point[a], other[a] = 0.0, 0.0
    _measured_point(z[best], position[best], age[best], x, x[:3])
    rho = z[best, RANGE]
    se, ce = math.sin(z[best, ELEVATION]), math.cos(z[best, ELEVATION])
    sa, ca = math.sin(z[best, AZIMUTH]), math.cos(z[best, AZIMUTH])
    across = rho * max(abs(ce), sigma[ELEVATION]) * sigma[AZIMUTH]
    axes = ((ce * ca, ce * sa, -se), (-sa, ca, 0.0), (-se * ca, -se * sa, -ce))
    spread = (sigma[RANGE], across, rho * sigma[ELEVATION])
    for a in range(3):
        for b in range(3):
            P[a, b] = age[best] ** 2 * restart[6 + a] if a == b else 0.0
            for k in range(3):
                P[a, b] += spread[k] ** 2 * axes[k][a] * axes[k][b]
    return best


@kernel
def move_to_lines(
    z: Array, position: Array, age: Array, use: Array | BoolArray, x: Array, scratch: Array
) -> bool:
    """Move the position of x (6,) to where the measured lines of sight meet; False where they fix no place.

    It minimises sum |(I - u u')(r - p)|^2 over the measurements that count, u a line of sight: A r = b with
    A = sum (I - u u'). A line leaves the distance along itself open, and so do lines that are parallel.
    """
    A, b = scratch[:9].reshape(3, 3), scratch[9:12].reshape(3, 1)
    lines = 0
    for i in range(12):
        scratch[i] = 0.0
    for j in range(use.shape[0]):
        if use[j] != 0.0:
            lines += 1
            ce = math.cos(z[j, ELEVATION])
            u = (ce * math.cos(z[j, AZIMUTH]), ce * math.sin(z[j, AZIMUTH]), -math.sin(z[j, ELEVATION]))
            for i in range(3):
                for k in range(3):
                    across = (1.0 if i == k else 0.0) - u[i] * u[k]
                    A[i, k] += across
                    b[i, 0] += across * (position[j, k] + age[j] * x[3 + k])
    if lines < 2 or condition_number(A) > _PARALLEL or not solve_definite(A, b):
        return False
    for i in range(3):
        x[i] = b[i, 0]
    return True


@kernel
def restart_at_ranges(
    x: Array, P: Array, z: Array, position: Array, age: Array, restart: Array, use: Array, scratch: Array
) -> None:
    """Put x at the nearest place that the ranges allow; the update with them is still to be made.

    The position's standard deviation per axis is that of the restart, or the way that x moved if that is
    longer, but not beyond the shortest range: so far the direction is unknown.
    """
    m = use.shape[0]
    start, moved, distance = scratch[:3], scratch[3 : 3 + 3 * m].reshape(m, 3), scratch[3 + 3 * m : 3 + 4 * m]
    begin_anew(x, P, restart)
    shortest = math.inf
    for j in range(m):
        distance[j] = z[j, RANGE]
        if use[j] != 0.0:
            shortest = min(shortest, z[j, RANGE])
        for a in range(3):  # a range made `age` ago at p counts as one made now at p + age v
            moved[j, a] = position[j, a] + age[j] * x[3 + a]
    for a in range(3):
        start[a] = x[a]
    nearest_point(moved, distance, use, x[:3], scratch[3 + 4 * m :])
    way = 0.0
    for a in range(3):
        way += (x[a] - start[a]) ** 2
    spread = min(math.sqrt(way), shortest)
    for a in range(3):
        P[a, a] = max(restart[3 + a], spread * spread)
