"""Sensors of the target: range, azimuth and elevation, h with its H in one place, Eqs. (6.3), (6.11), (6.13).

With d = r_t - p_i in NED axes, rho = |d| and s the horizontal distance:

| row | h | H = dh/dr_t |
|---|---|---|
| range | rho | d' / rho |
| azimuth | atan2(d_y, d_x) | [-d_y, d_x, 0] / s^2 |
| elevation, positive up | asin(-d_z / rho) | [d_x d_z, d_y d_z, -s^2] / (rho^2 s) |

Straight above or below the target s = 0: both angles turn there faster than any linearisation, and the
divisions are held at s^2 >= MIN_HORIZONTAL_SQUARED, which bounds H. Where `is_overhead` says so, filters put
the horizontal direction d_h / rho in place of the angles. With e_r = (cos az, sin az) and e_t = (-sin az,
cos az) of the MEASURED azimuth, so that nothing turns with the prediction,

| row | z | h | H = dh/dr_t | variance of z - h |
|---|---|---|---|---|
| along | cos el | u = e_r' d_h / rho | ([e_r; 0]' - u d' / rho) / rho | `direction_variances` |
| across | 0 | w = e_t' d_h / rho | ([e_t; 0]' - w d' / rho) / rho | `direction_variances` |

Deviation: the dissertation writes tan^-1(d_y / d_x), z up, and the square of the range with constant noise;
here four quadrants, z down, and rho itself, whose noise is the sensor's.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from .arguments.names import unknown_name
from .compilation.decorators import Int, inline_kernel
from .parameters import Array

N_MEASUREMENT = 3  # range, m; azimuth, rad; elevation, rad
RANGE, AZIMUTH, ELEVATION = range(N_MEASUREMENT)
# Name -> entries of a measurement that the sensor reads; all else follows from them.
SENSORS = {
    "range": slice(RANGE, AZIMUTH),
    "range-azimuth-elevation": slice(RANGE, N_MEASUREMENT),
    "azimuth-elevation": slice(AZIMUTH, N_MEASUREMENT),
}
DEFAULT_SENSOR = "range-azimuth-elevation"
MIN_HORIZONTAL_SQUARED = 1e-6  # m^2, smallest s^2 in a division
OVERHEAD = 8.0  # the angles count where s > OVERHEAD sigma_el rho, the direction elsewhere

_PER_FIRST = 4  # in `sensor_rows`
_Row = tuple[float, float, float]


def sensor_rows(sensor: str) -> int:
    """What of range, azimuth, elevation this sensor reads, as one number: how many, + 4 times the first.

    So 1 is the range, 3 are all of them; `first_row` and `row_count` take it apart.

    Raises:
        ValueError: If there is no such sensor.
    """
    if not isinstance(sensor, str) or sensor not in SENSORS:
        raise ValueError(unknown_name("sensor", sensor, tuple(SENSORS)))
    read = SENSORS[sensor]
    return int(read.stop - read.start + _PER_FIRST * read.start)


@inline_kernel
def first_row(rows: Int) -> int:
    """The first entry of a measurement that a sensor reads, see `sensor_rows`."""
    return int(rows // _PER_FIRST)


@inline_kernel
def row_count(rows: Int) -> int:
    """How many entries of a measurement a sensor reads, see `sensor_rows`."""
    return int(rows % _PER_FIRST)


@inline_kernel
def reads(rows: Int, entry: int) -> bool:
    """Whether a sensor reads RANGE, AZIMUTH or ELEVATION, see `sensor_rows`."""
    return bool(first_row(rows) <= entry < first_row(rows) + row_count(rows))


@inline_kernel
def measure(dx: float, dy: float, dz: float) -> _Row:
    """Range, azimuth and elevation of d, without noise; compiled twin of `range_azimuth_elevation`."""
    horizontal = math.sqrt(dx * dx + dy * dy)
    rho = math.sqrt(dx * dx + dy * dy + dz * dz)
    # asin(-dz / rho) loses half of its digits near the zenith; this is the same angle.
    return rho, math.atan2(dy, dx), math.atan2(-dz, horizontal)


@inline_kernel
def jacobian_rows(dx: float, dy: float, dz: float) -> tuple[_Row, _Row, _Row]:
    """Derivatives of range, azimuth and elevation with respect to r_t; compiled twin of `jacobian`."""
    s2 = max(dx * dx + dy * dy, MIN_HORIZONTAL_SQUARED)
    s = math.sqrt(s2)
    rho2 = s2 + dz * dz
    rho = math.sqrt(rho2)
    along = dz / (rho2 * s)
    return (dx / rho, dy / rho, dz / rho), (-dy / s2, dx / s2, 0.0), (dx * along, dy * along, -s / rho2)


@inline_kernel
def is_overhead(dx: float, dy: float, dz: float, sigma_elevation: float) -> bool:
    """Whether a prediction d is so close to the vertical that the direction is to replace the angles.

    There the azimuth turns by more within the uncertainty of d than its linearisation can follow. With the
    factor 6 a target that hovers at s = 0.075 rho reaches a normalised error of 190, with 8 one of 28. At all
    distances the direction serves worse: it does not tell above from below, and a bad first guess stays bad.
    """
    limit = OVERHEAD * sigma_elevation
    s2 = dx * dx + dy * dy
    return s2 <= limit * limit * (s2 + dz * dz)


@inline_kernel
def direction_rows(dx: float, dy: float, dz: float, azimuth: float) -> tuple[float, float, _Row, _Row]:
    """Along and across a measured azimuth: h and H; compiled twin of `direction`, `direction_jacobian`."""
    c, s = math.cos(azimuth), math.sin(azimuth)
    rho = math.sqrt(max(dx * dx + dy * dy + dz * dz, MIN_HORIZONTAL_SQUARED))
    x, y, z = dx / rho, dy / rho, dz / rho
    u, w = c * x + s * y, c * y - s * x
    along = (c - u * x) / rho, (s - u * y) / rho, -u * z / rho
    across = (-s - w * x) / rho, (c - w * y) / rho, -w * z / rho
    return u, w, along, across


@inline_kernel
def direction_variances(
    dx: float, dy: float, dz: float, elevation: float, sigma_azimuth: float, sigma_elevation: float
) -> tuple[float, float]:
    """Variances of the noise along and across, for a predicted d and the measured elevation.

    Along: sin^2 el sigma_el^2, and the second order, cos^2 el (sigma_el^4 + sigma_az^4) / 2, without which a
    reading of el = 0 would be exact. Across: sigma_az^2 times the true (s / rho)^2. Its reading cos^2 el
    vanishes by chance at el = 90 degrees, where the true one is about sigma_el^2: hence + sigma_el^2. If the
    prediction is larger it counts instead: the largest normalised error of slow passes falls from 91 to 37.
    """
    c, s = math.cos(elevation), math.sin(elevation)
    az2, el2 = sigma_azimuth * sigma_azimuth, sigma_elevation * sigma_elevation
    h2 = dx * dx + dy * dy
    predicted = h2 / max(h2 + dz * dz, MIN_HORIZONTAL_SQUARED)
    return s * s * el2 + 0.5 * c * c * (el2 * el2 + az2 * az2), (max(c * c, predicted) + el2) * az2


def range_azimuth_elevation(d: ArrayLike) -> Array:
    """What the sensor at p_i would read without noise, Eq. (6.11).

    Args:
        d: r_t - p_i, (..., 3), m, NED.

    Returns:
        Range, m, azimuth in [-pi, pi], rad, elevation in [-pi/2, pi/2], rad, positive up, (..., 3).
    """
    x, y, z = np.moveaxis(np.asarray(d, dtype=np.float64), -1, 0)
    horizontal = np.sqrt(x**2 + y**2)
    return np.stack([np.sqrt(x**2 + y**2 + z**2), np.arctan2(y, x), np.arctan2(-z, horizontal)], axis=-1)


def jacobian(d: ArrayLike) -> Array:
    """Derivatives of `range_azimuth_elevation` with respect to the target's position, Eq. (6.13).

    Args:
        d: r_t - p_i, (..., 3), m, NED.

    Returns:
        (..., 3, 3), rows range, azimuth, elevation; finite everywhere, see `MIN_HORIZONTAL_SQUARED`.
    """
    x, y, z = np.moveaxis(np.asarray(d, dtype=np.float64), -1, 0)
    s2 = np.maximum(x**2 + y**2, MIN_HORIZONTAL_SQUARED)
    s, rho2 = np.sqrt(s2), s2 + z**2
    rho = np.sqrt(rho2)
    rows = [
        [x / rho, y / rho, z / rho],
        [-y / s2, x / s2, np.zeros_like(s2)],
        [x * z / (rho2 * s), y * z / (rho2 * s), -s / rho2],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _measured_axes(azimuth: ArrayLike) -> Array:
    """e_r and e_t, (..., 2, 3)."""
    c, s = np.cos(azimuth), np.sin(azimuth)
    o = np.zeros_like(c)
    return np.stack([np.stack([c, s, o], axis=-1), np.stack([-s, c, o], axis=-1)], axis=-2)


def _distance(d: Array) -> Array:
    """The distance rho, held away from 0, (...)."""
    rho: Array = np.sqrt(np.maximum((d**2).sum(axis=-1), MIN_HORIZONTAL_SQUARED))
    return rho


def direction(d: ArrayLike, azimuth: ArrayLike) -> Array:
    """Horizontal direction d_h / rho along and across a measured azimuth.

    Args:
        d: r_t - p_i, (..., 3), m, NED.
        azimuth: Measured, (...), rad.

    Returns:
        e_r' d_h / rho and e_t' d_h / rho, (..., 2); without noise cos el and 0.
    """
    d = np.asarray(d, dtype=np.float64)
    along_across: Array = (_measured_axes(azimuth) @ (d / _distance(d)[..., None])[..., None])[..., 0]
    return along_across


def direction_jacobian(d: ArrayLike, azimuth: ArrayLike) -> Array:
    """Derivatives of `direction` with respect to the target's position.

    Args:
        d: r_t - p_i, (..., 3), m, NED.
        azimuth: Measured, (...), rad.

    Returns:
        (..., 2, 3), rows along and across; at most 1 / rho, rho held at sqrt(MIN_HORIZONTAL_SQUARED).
    """
    d = np.asarray(d, dtype=np.float64)
    rho = _distance(d)[..., None, None]
    rows: Array = (_measured_axes(azimuth) - direction(d, azimuth)[..., None] * d[..., None, :] / rho) / rho
    return rows
