"""Compiled trilateration of one vehicle, see `trilateration.py`; no allocation."""

from __future__ import annotations

import math

from controllers.qp.linalg import cholesky, copy, fill, invert_spd, solve_lower, solve_lower_transposed
from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import Array

from .arguments import BoolArray

MIN_RANGES = 4
TRILATERATION_SCRATCH = 3 * 3 + 2 * 9
NEAREST_SCRATCH = TRILATERATION_SCRATCH
ACCEPTED, TOO_FEW, GEOMETRY, SINGULAR, RESIDUAL = range(5)  # the members of Reason, for compiled code
_STEPS = 50
_SMALLEST_STEP = 1e-9  # m
_SMALLEST_RANGE = 1e-9  # m, in divisions
_LARGEST = 1e9  # m: what is beyond is a fault
MAX_RATIO = 8.0  # of the largest and smallest singular value of the centred positions


@kernel
def condition_number(C: Array) -> float:
    """Ratio of the largest and smallest eigenvalue of a symmetric, positive semidefinite C (3, 3)."""
    mean = (C[0, 0] + C[1, 1] + C[2, 2]) / 3.0
    a, b, c = C[0, 0] - mean, C[1, 1] - mean, C[2, 2] - mean
    d, e, f = C[0, 1], C[0, 2], C[1, 2]
    spread = math.sqrt((a * a + b * b + c * c + 2.0 * (d * d + e * e + f * f)) / 6.0)
    if spread <= 1e-12 * mean:
        return 1.0 if mean > 0.0 else math.inf
    # Trigonometric solution of the characteristic cubic of (C - mean I) / spread.
    det = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
    cosine = min(max(0.5 * det / (spread * spread * spread), -1.0), 1.0)
    angle = math.acos(cosine) / 3.0
    largest = mean + 2.0 * spread * math.cos(angle)
    smallest = mean + 2.0 * spread * math.cos(angle + 2.0 * math.pi / 3.0)
    return largest / smallest if smallest > 0.0 else math.inf


@kernel
def _spread(position: Array, use: Array, centre: Array, C: Array) -> None:
    """The centre (3,) of the positions that count and C = sum c c' (3, 3), c taken from the centre."""
    count = 0.0
    fill(C, 0.0)
    for a in range(3):
        centre[a] = 0.0
    for j in range(position.shape[0]):
        if use[j] != 0.0:
            count += 1.0
            for a in range(3):
                centre[a] += position[j, a]
    for a in range(3):
        centre[a] /= count
    for j in range(position.shape[0]):
        if use[j] != 0.0:
            for a in range(3):
                for b in range(3):
                    C[a, b] += (position[j, a] - centre[a]) * (position[j, b] - centre[b])


@kernel
def solve_definite(A: Array, x: Array) -> bool:
    """Solve A y = x in place for A (3, 3), which is destroyed, and x (3, 1); False if A is not definite."""
    if cholesky(A) >= 0:
        return False
    solve_lower(A, x)
    solve_lower_transposed(A, x)
    return True


@kernel
def _linear_start(
    position: Array, distance: Array, use: Array, centre: Array, C: Array, x: Array, r: Array
) -> None:
    """Least squares of 2 c'r = y - mean(y), y_j = |c_j|^2 - rho_j^2: (9.3) for any number of vehicles."""
    fill(x, 0.0)
    for j in range(position.shape[0]):
        if use[j] != 0.0:
            y = -distance[j] * distance[j]
            for a in range(3):
                y += (position[j, a] - centre[a]) ** 2
            for a in range(3):  # the mean of y drops out, since the c_j add up to 0
                x[a, 0] += 0.5 * (position[j, a] - centre[a]) * y
    solve_definite(C, x)
    for a in range(3):
        r[a] = centre[a] + x[a, 0]


@kernel
def _residuals(position: Array, distance: Array, use: Array, r: Array, JJ: Array, gradient: Array) -> float:
    """Sum of squares of res = rho - |r - pos|, J'J (3, 3) of the unit lines of sight, J'res (3, 1)."""
    total = 0.0
    fill(JJ, 0.0)
    fill(gradient, 0.0)
    for j in range(position.shape[0]):
        if use[j] != 0.0:
            square = 0.0
            for a in range(3):
                square += (r[a] - position[j, a]) ** 2
            rho = math.sqrt(square)
            res = distance[j] - rho
            inverse = 1.0 / max(rho, _SMALLEST_RANGE)
            total += res * res
            for a in range(3):
                u = (r[a] - position[j, a]) * inverse
                gradient[a, 0] += u * res
                for b in range(3):
                    JJ[a, b] += u * (r[b] - position[j, b]) * inverse
    return total


@kernel
def _levenberg_marquardt(
    position: Array, distance: Array, use: Array, r: Array, trial: Array, x: Array, JJ: Array, A: Array
) -> float:
    """The r (3,) that fits the ranges best, from r, and J'J there; returns the sum of squares."""
    damping = 1e-3
    total = _residuals(position, distance, use, r, JJ, x)
    for _ in range(_STEPS):
        copy(JJ, A)
        added = damping * (JJ[0, 0] + JJ[1, 1] + JJ[2, 2] + 1e-9)  # alike in all directions: fewer than three
        for a in range(3):  # ranges leave some free, in which the step must not grow
            A[a, a] += added
        if not solve_definite(A, x):
            break
        length = 0.0
        for a in range(3):
            trial[a] = r[a] + x[a, 0]
            length += x[a, 0] * x[a, 0]
        if _residuals(position, distance, use, trial, JJ, x) < total:
            for a in range(3):
                r[a] = trial[a]
            damping = max(damping / 3.0, 1e-9)
        else:
            damping *= 4.0
        total = _residuals(position, distance, use, r, JJ, x)
        if length < _SMALLEST_STEP * _SMALLEST_STEP:
            break
    return total


@kernel
def nearest_point(position: Array, distance: Array, use: Array, r: Array, scratch: Array) -> None:
    """Move r (3,) to where it fits ranges from any number of vehicles: down the slope from r.

    From four vehicles on that are not nearly in one plane, from their linear solution instead. A row of
    `position` (m, 3) and `distance` (m,) counts where use (m,) is not 0; scratch (>= NEAREST_SCRATCH,).
    """
    centre, trial, x = scratch[:3], scratch[3:6], scratch[6:9].reshape(3, 1)
    C, JJ = scratch[9:18].reshape(3, 3), scratch[18:27].reshape(3, 3)
    count = 0
    for j in range(use.shape[0]):
        count += 1 if use[j] != 0.0 else 0
    if count >= MIN_RANGES:
        _spread(position, use, centre, C)
        if condition_number(C) <= MAX_RATIO * MAX_RATIO:
            _linear_start(position, distance, use, centre, C, x, r)
    _levenberg_marquardt(position, distance, use, r, trial, x, JJ, C)


@kernel
def _no_fix(reason: int, r: Array, P: Array) -> tuple[int, float, float]:
    for a in range(3):
        r[a] = 0.0
        for b in range(3):
            P[a, b] = math.inf if a == b else 0.0
    return reason, math.inf, math.inf


@kernel
def _select(position: Array, distance: Array, valid: BoolArray, use: Array) -> int:
    """Marks the ranges that count in use (m,), and returns how many do."""
    count = 0
    for j in range(use.shape[0]):
        good = valid[j] and 0.0 < distance[j] < _LARGEST
        for a in range(3):
            good = good and abs(position[j, a]) < _LARGEST
        use[j] = 1.0 if good else 0.0
        count += 1 if good else 0
    return count


@kernel
def trilaterate_kernel(
    position: Array,
    distance: Array,
    valid: BoolArray,
    sigma: float,
    start: Array,
    max_ratio: float,
    limits: Array,
    r: Array,
    P: Array,
    scratch: Array,
) -> tuple[int, float, float]:
    """Position of one target from the ranges that one vehicle holds.

    Args:
        position: Where they were measured, (m, 3), m.
        distance: Ranges, (m,), m.
        valid: Which are there, (m,); one that is not finite counts as not there.
        sigma: Standard deviation of a range, m.
        start: Predicted position, (3,), m; NaN for the linear start.
        max_ratio: Of the geometry test.
        limits: Largest accepted residual with 4, 5, ..., m ranges, see `acceptance_limits`.
        r: Result, (3,).
        P: Result, (3, 3).
        scratch: Overwritten, (>= m + TRILATERATION_SCRATCH,).

    Returns:
        Reason, PDOP and residual, see `Fix`.
    """
    m = position.shape[0]
    use, scratch = scratch[:m], scratch[m:]
    centre, trial, x = scratch[:3], scratch[3:6], scratch[6:9].reshape(3, 1)
    C, JJ = scratch[9:18].reshape(3, 3), scratch[18:27].reshape(3, 3)
    count = _select(position, distance, valid, use)
    if count < MIN_RANGES:
        return _no_fix(TOO_FEW, r, P)
    _spread(position, use, centre, C)
    if not condition_number(C) <= max_ratio * max_ratio:
        return _no_fix(GEOMETRY, r, P)
    if abs(start[0]) < _LARGEST and abs(start[1]) < _LARGEST and abs(start[2]) < _LARGEST:
        for a in range(3):
            r[a] = start[a]
    else:
        _linear_start(position, distance, use, centre, C, x, r)
    residual = _levenberg_marquardt(position, distance, use, r, trial, x, JJ, C) / (sigma * sigma)
    if not invert_spd(JJ, P):
        return _no_fix(SINGULAR, r, P)
    pdop = math.sqrt(P[0, 0] + P[1, 1] + P[2, 2])
    for a in range(3):
        for b in range(3):
            P[a, b] *= sigma * sigma
    return ACCEPTED if residual < limits[count - MIN_RANGES] else RESIDUAL, pdop, residual
