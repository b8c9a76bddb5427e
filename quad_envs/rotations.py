"""Rotations of the 3-2-1 sequence, Eq. (2.33): R_BI, the Euler rate matrix W, sine and cosine, angle wrap."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .compilation.decorators import inline_kernel
from .parameters import Array

_TWO_OVER_PI = 2.0 / np.pi
# pi/2 in three parts whose products with small integers are exact (Cody and Waite).
_PIO2_1 = 1.57079625129699707031e0
_PIO2_2 = 7.54978941586159635335e-8
_PIO2_3 = 5.39030285815811905290e-15


@inline_kernel
def sincos(angle: float) -> tuple[float, float]:
    """Sine and cosine without branches or calls, so that a loop around it vectorises (|angle| < 1e5)."""
    turns = np.floor(angle * _TWO_OVER_PI + 0.5)
    a = ((angle - turns * _PIO2_1) - turns * _PIO2_2) - turns * _PIO2_3
    z = a * a
    s = 1.58962301576546568060e-10 * z - 2.50507477628578072866e-8
    s = (s * z + 2.75573136213857245213e-6) * z - 1.98412698295895385996e-4
    s = (s * z + 8.33333333332211858878e-3) * z - 1.66666666666666307295e-1
    s = a + a * z * s
    c = -1.13585365213876817300e-11 * z + 2.08757008419747316778e-9
    c = (c * z - 2.75573141792967388112e-7) * z + 2.48015872888517045348e-5
    c = (c * z - 1.38888888888730564116e-3) * z + 4.16666666666665929218e-2
    c = 1.0 - 0.5 * z + z * z * c
    odd = turns - 2.0 * np.floor(0.5 * turns)  # 1 in quadrants 1 and 3, where sine and cosine change places
    half = 0.5 * (turns - odd)
    sign = 1.0 - 2.0 * (half - 2.0 * np.floor(0.5 * half))  # -1 in quadrants 2 and 3
    even = 1.0 - odd
    return sign * (even * s + odd * c), sign * (even - odd) * (even * c + odd * s)


@inline_kernel
def wrap_angle_scalar(angle: float) -> float:
    """The angle modulo 2 pi in [-pi, pi), compiled twin of `wrap_angle`."""
    return angle - 2.0 * np.pi * float(np.floor(angle / (2.0 * np.pi) + 0.5))


def wrap_angle(angle: ArrayLike) -> Array:
    """The angle modulo 2 pi in [-pi, pi), any shape, rad."""
    a = np.asarray(angle, dtype=np.float64)
    return np.asarray(a - 2.0 * np.pi * np.floor(a / (2.0 * np.pi) + 0.5))


def rotation_body_from_inertial(Theta: ArrayLike) -> Array:
    """R_BI of Eq. (2.33): takes inertial vectors to body axes.

    Args:
        Theta: Roll, pitch, yaw, (..., 3), rad.

    Returns:
        Rotation matrices, (..., 3, 3).
    """
    phi, theta, psi = np.moveaxis(np.asarray(Theta, dtype=np.float64), -1, 0)
    sf, cf, st, ct, ss, cs = np.sin(phi), np.cos(phi), np.sin(theta), np.cos(theta), np.sin(psi), np.cos(psi)
    rows = [
        [ct * cs, ct * ss, -st],
        [st * cs * sf - ss * cf, st * ss * sf + cs * cf, ct * sf],
        [st * cs * cf + ss * sf, st * ss * cf - cs * sf, ct * cf],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def euler_rate_matrix(Theta: ArrayLike) -> Array:
    """W of Eq. (2.33): Euler angle rates from body rates, singular at |pitch| = pi/2.

    Args:
        Theta: Roll, pitch, yaw, (..., 3), rad.

    Returns:
        (..., 3, 3).
    """
    phi, theta, _ = np.moveaxis(np.asarray(Theta, dtype=np.float64), -1, 0)
    sf, cf, ct, tt = np.sin(phi), np.cos(phi), np.cos(theta), np.tan(theta)
    one, zero = np.ones_like(sf), np.zeros_like(sf)
    rows = [[one, sf * tt, cf * tt], [zero, cf, -sf], [zero, sf / ct, cf / ct]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
