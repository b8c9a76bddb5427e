"""Position from four or more ranges, sections 6.2.1.1 and 9.3 of the dissertation.

Geometry test, start, Levenberg-Marquardt on the ranges, acceptance by the residual, covariance
sigma^2 (J'J)^-1 with the unit lines of sight J.

**Mirror twins.** Three vehicles, or more in one plane, measure the same ranges to a target and to its mirror
image in that plane, and no residual or covariance tells them apart. Nearly coplanar vehicles tell them apart
only if the noise is smaller than the difference of the ranges: at a spread ratio of 13.5 one fix in ten is
the twin, at 7 fewer than one in a hundred, at 4.5 hardly any (sigma 0.1 m, target 3 m away). The geometry
test refuses ratios above 8, and a start from a filter's prediction keeps to the right side.

The covariance is a linearisation, honest while errors are small against the distance: with a PDOP of 5 and
more, or noise of a tenth of the distance, NEES/3 rises above 1.2.

Deviation: (9.3) takes the condition number of chained differences, which depends on the vehicles' order, and
the dissertation's covariance (H'H)^-1 of squared ranges has neither noise nor the right unit.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quad_envs.arguments.names import shown
from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import Array

from .arguments import BoolArray, IntArray, as_floats, as_mask
from .consistency import chi2_quantile
from .trilateration_kernels import MAX_RATIO, MIN_RANGES, TRILATERATION_SCRATCH, trilaterate_kernel

ACCEPTANCE = 0.999  # share of fixes with honest noise that pass the residual test


class Reason(IntEnum):
    """Why a fix was refused."""

    ACCEPTED = 0
    TOO_FEW = 1  # fewer than four finite ranges above 0
    GEOMETRY = 2  # the vehicles are nearly in one plane: a mirror twin is possible
    SINGULAR = 3  # the lines of sight do not determine a position: the target is too far, or in line
    RESIDUAL = 4  # the ranges contradict each other by more than their noise


class Fix(NamedTuple):
    """Positions from ranges; those that were not accepted are for study only."""

    r: Array  # (n, 3), m; zero where there is none (TOO_FEW, GEOMETRY, SINGULAR)
    P: Array  # (n, 3, 3), m^2; infinite diagonal where there is none
    accepted: BoolArray  # (n,)
    pdop: Array  # (n,), sqrt(tr (J'J)^-1): position error per range error; inf where there is none
    residual: Array  # (n,), sum res^2 / sigma^2, chi^2 with m - 3 degrees of freedom; inf where there is none
    reason: IntArray  # (n,), Reason


@kernel
def _trilaterate_rows(
    position: Array,
    distance: Array,
    valid: BoolArray,
    sigma: float,
    start: Array,
    max_ratio: float,
    limits: Array,
    r: Array,
    P: Array,
    numbers: Array,
    reason: IntArray,
    scratch: Array,
) -> None:
    for i in range(r.shape[0]):
        reason[i], numbers[0, i], numbers[1, i] = trilaterate_kernel(
            position[i], distance[i], valid[i], sigma, start[i], max_ratio, limits, r[i], P[i], scratch
        )


def acceptance_limits(ranges: int, level: float = ACCEPTANCE) -> Array:
    """Residuals that a fix from 4, 5, ..., `ranges` honest ranges stays below with probability `level`."""
    return np.array([chi2_quantile(level, m - 3) for m in range(MIN_RANGES, max(ranges, MIN_RANGES) + 1)])


def trilaterate(
    position: ArrayLike,
    distance: ArrayLike,
    sigma: float,
    valid: ArrayLike | None = None,
    start: ArrayLike | None = None,
    max_ratio: float = MAX_RATIO,
    level: float = ACCEPTANCE,
) -> Fix:
    """Positions of targets from four or more ranges each.

    A fix enters the filter as a position measurement: `kalman_update` with H = [I 0] and R = P.

    Args:
        position: Where the ranges were measured, (n, m, 3), m.
        distance: Ranges, (n, m), m.
        sigma: Standard deviation of a range, m.
        valid: Which are there, (n, m), bool; None: all.
        start: Predicted positions, (n, 3), m; rows of NaN, or None: the linear solution.
        max_ratio: Vehicles whose spread (largest by smallest singular value) exceeds it are refused.
        level: Share of honest fixes that pass the residual test.

    Returns:
        Fixes; whatever the geometry or the numbers are, the answer is a value with its reason.

    Raises:
        ValueError: If a shape is wrong or sigma is not positive.
    """
    places = as_floats("position", position, (None, None, 3), finite=False)
    n, m, _ = places.shape
    ranges = as_floats("distance", distance, (n, m), finite=False)
    if not 0.0 < sigma < np.inf:
        raise ValueError(f"sigma must be a finite number > 0 m, got {shown(sigma)}")
    guess = np.full((n, 3), np.nan) if start is None else as_floats("start", start, (n, 3), finite=False)
    r, P, numbers, reason = (
        np.empty((n, 3)),
        np.empty((n, 3, 3)),
        np.empty((2, n)),
        np.empty(n, dtype=np.int64),
    )
    mask, limits = as_mask("valid", valid, (n, m)), acceptance_limits(m, level)
    scratch = np.empty(m + TRILATERATION_SCRATCH)
    options = (float(sigma), guess, float(max_ratio), limits)
    _trilaterate_rows(places, ranges, mask, *options, r, P, numbers, reason, scratch)
    return Fix(r, P, reason == Reason.ACCEPTED, numbers[0], numbers[1], reason)
