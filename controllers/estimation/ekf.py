"""The target filter: an extended Kalman filter with constant velocity, section 6.2.1 of the dissertation.

State x = [r_t; v_t] (6), m and m/s, inertial axes; the origin may be any point that moves without turning,
such as the observing vehicle: `shift` follows it. One joint update takes all measurements of a step, made
from any places and some time ago.

Deviation: the dissertation's "constant velocity" filter has r_t alone for its state, squares the range and
leaves R out of the gain (6.4). It also takes a range to the first order. Here the second one counts as well:
the mean of the curvature leaves the innovation, and its covariance enters S (Gaussian second order filter).
A belief that is wide beside the distance otherwise takes the tangent plane for the sphere of a range.
Ranges of 0.1 m in the scenario of chapter 6, 300 flights, first and second order:

| prior, and ranges held | ANEES/3 | share of flights with a mean NEES/3 above 10 |
|---|---|---|
| 0.5 m; 4 | 1.0, 1.0 | 0, 0 |
| 0.5 m; 2 | 5.7, 2.1 | 11 %, 3 % |
| 0.5 m; 2 after 2 others | 274, 13.5 | 55 %, 8 % |
| 2 m; 4 | 12.4, 1.1 (RMSE 0.49, 0.21 m) | 22 %, 0 |
| 2 m; 2 | 153, 4.8 | 58 %, 7 % |
| 2 m; 3 | 43, 30 | 21 %, 3 % |

What is left is not curvature: with two ranges the target can be anywhere on a circle, with three or with
vehicles in one plane at a mirror twin, and a filter with one mean may have settled on the wrong one.

Deviation: (6.13) is singular straight overhead, and section 7 of the specification drops the azimuth there.
Then a vehicle alone loses the horizontal direction of a target that stays above it. Here the direction along
and across the measured azimuth replaces both angles (`quad_envs.sensors`), so that no information is lost.
Largest normalised error (NEES) of 8 x 40 runs, 4 m above, own measurements alone:

| | 0.8 m/s | 0.2 m/s | 0.05 m/s | hovering 0.3 m beside |
|---|---|---|---|---|
| azimuth dropped (6 sigma_el rho) | 3000 | 25000 | 25000 | 25000 |
| direction (8 sigma_el rho) | 23 | 24 | 37 | 28 |

The mean one, ANEES/3, of the scenario of chapter 6 on its seeds 0 to 7: 0.98 to 1.73, and now 0.98 to 1.03.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quad_envs.arguments.names import shown
from quad_envs.compilation.decorators import Int, kernel
from quad_envs.parameters import Array
from quad_envs.sensors import N_MEASUREMENT, SENSORS, sensor_rows

from .arguments import BoolArray, IntArray, as_floats, as_mask, require_non_negative
from .ekf_kernels import N_TARGET, ekf_scratch, ekf_update_kernel, predict_kernel
from .protocol import Measurements

TARGET_POSITION = slice(0, 3)
TARGET_VELOCITY = slice(3, 6)


class TargetFilter(NamedTuple):
    """What is believed of the target, one row per vehicle."""

    x: Array  # (n, 6), r_t and v_t, m and m/s
    P: Array  # (n, 6, 6)


class Innovation(NamedTuple):
    """How well the measurements of a step agree with the prediction, one row per vehicle."""

    nis: Array  # (n,), nu' S^-1 nu, chi^2 with `rows` degrees of freedom; 0 without measurement
    rows: IntArray  # (n,), rows used
    rejected: IntArray  # (n,), measurements left out: not finite, no range, S not positive definite, false
    restarted: BoolArray  # (n,), whether the filter was lost and began anew; nis and rows are what said so


class Restart(NamedTuple):
    """What a lost filter begins anew with, besides its measurements."""

    rest: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the last three states: v_t, m/s
    sigma: tuple[float, ...] = (3.0, 3.0, 3.0, 1.0, 1.0, 1.0)  # standard deviations of all six, m, m/s

    def data(self) -> Array:
        """The same for compiled code, (9,).

        Raises:
            ValueError: If a number is not finite or a standard deviation not positive.
        """
        rest, sigma = as_floats("rest", self.rest, (3,)), as_floats("sigma", self.sigma, (N_TARGET,))
        if not (sigma > 0.0).all():
            raise ValueError(f"sigma of a restart must be six standard deviations > 0, got {self.sigma}")
        return np.concatenate([rest, np.square(sigma)])


RESTART = Restart()


def initial_filter(r: ArrayLike, v: ArrayLike, sigma: tuple[float, float]) -> TargetFilter:
    """A filter that starts from a guess.

    Args:
        r: Guessed positions, (n, 3), m.
        v: Guessed velocities, (n, 3) or (3,), m/s.
        sigma: Standard deviations per axis of position, m, and velocity, m/s.

    Raises:
        ValueError: If a shape is wrong, a number is not finite, or a standard deviation not positive.
    """
    position = as_floats("r", r, (None, 3))
    velocity = as_floats("v", np.broadcast_to(v, position.shape), position.shape)
    if not (0.0 < sigma[0] < np.inf and 0.0 < sigma[1] < np.inf):
        raise ValueError(f"sigma must be two finite numbers > 0 (m, m/s), got {sigma}")
    variances = np.repeat(np.square(sigma), 3)
    P = np.tile(np.diag(variances), (len(position), 1, 1))
    return TargetFilter(np.concatenate([position, velocity], axis=1), P)


def constant_velocity_model(dt: float, q: float) -> tuple[Array, Array]:
    """Transition F and noise Q of a target with white acceleration, exactly discretised.

    Args:
        dt: Step, s.
        q: Density of the acceleration, m^2/s^3, per axis.

    Returns:
        F (6, 6) and Q (6, 6).
    """
    F = np.kron(np.array([[1.0, dt], [0.0, 1.0]]), np.eye(3))
    Q = q * np.kron(np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]]), np.eye(3))
    return F, Q


@kernel
def _predict_rows(x: Array, P: Array, dt: float, q: float) -> None:
    for i in range(x.shape[0]):
        predict_kernel(x[i], P[i], dt, q)


@kernel
def _update_rows(
    x: Array,
    P: Array,
    z: Array,
    position: Array,
    age: Array,
    valid: BoolArray,
    sigma: Array,
    rows: Int,
    restart: Array,
    curved: bool,
    nis: Array,
    counts: IntArray,
    restarted: BoolArray,
    scratch: Array,
) -> None:
    for i in range(x.shape[0]):
        nis[i], counts[0, i], counts[1, i], restarted[i] = ekf_update_kernel(
            x[i], P[i], z[i], position[i], age[i], valid[i], sigma, rows, restart, curved, scratch
        )


def _copied(state: TargetFilter) -> TargetFilter:
    """Checked copies, which the kernels may change."""
    x = as_floats("x", state.x, (None, N_TARGET)).copy()
    return TargetFilter(x, as_floats("P", state.P, (len(x), N_TARGET, N_TARGET)).copy())


def predict(state: TargetFilter, dt: float, q: float) -> TargetFilter:
    """Predict: x <- F x, P <- F P F' + Q with the F and Q of `constant_velocity_model`.

    Args:
        state: n filters.
        dt: Step, s.
        q: Density of the target's acceleration, m^2/s^3: 0.02 for a target of constant velocity with small
            disturbances, 0.4 for an aircraft that manoeuvres.

    Raises:
        ValueError: If a shape is wrong, a number is not finite, or dt or q is negative.
    """
    new = _copied(state)
    _predict_rows(new.x, new.P, require_non_negative("dt", dt, "s"), require_non_negative("q", q, "m^2/s^3"))
    return new


def shift(state: TargetFilter, displacement: ArrayLike) -> TargetFilter:
    """The same belief seen from an origin that moved by the displacement, (n, 3), m."""
    new = _copied(state)
    new.x[:, TARGET_POSITION] -= as_floats("displacement", displacement, (len(new.x), 3))
    return new


def update(
    state: TargetFilter,
    measurements: Measurements,
    *former: Any,
    restart: Restart | None = RESTART,
    second_order: bool = True,
) -> tuple[TargetFilter, Innovation]:
    """One joint update per vehicle with all measurements it holds.

    The innovation of the azimuth is wrapped; straight overhead the direction along and across the measured
    azimuth replaces the angles. A measurement made `age` ago is of the target at r - age v; the noise of the
    motion since then is neglected. Ranges without angles count to the second order.

    A normalised innovation above 50 a row is no chance, nor is one above 16 a row of half of the measurements
    with angles, each by itself. If more than half of the measurements agree with the prediction, the others
    are left out as false; else the filter is lost and begins anew: with angles at the most central measured
    position with its covariance, with ranges at the nearest place that they allow, as uncertain as it was
    far.

    Args:
        state: n predicted filters.
        measurements: What the vehicles hold, in the frame of the state; a vehicle without any keeps its
            prediction.
        former: Nothing: the parts of the measurements were arguments of their own before.
        restart: What a lost filter begins anew with; None: it never does, and takes every measurement.
        second_order: Whether ranges without angles count to the second order; the dissertation's do not.

    Returns:
        The filters and their innovations. A measurement that is not finite, whose range is not positive, that
        makes S indefinite, or that alone contradicts all others is left out and counted as rejected.

    Raises:
        TypeError: If the parts of the measurements are given one by one.
        ValueError: If a shape is wrong, a state is not finite, sigma is not positive, or there is no sensor
            of such rows.
    """
    if former:
        raise TypeError(f"update takes (state, Measurements({', '.join(Measurements._fields)}), restart=...)")
    new = _copied(state)
    n = len(new.x)
    z, position, age, valid, sigma, rows = _checked(measurements, n)
    m = z.shape[1]
    nis, counts = np.empty(n), np.empty((2, n), dtype=np.int64)
    restarted = np.empty(n, dtype=np.bool_)
    anew = np.empty(0) if restart is None else restart.data()
    scratch = np.empty(ekf_scratch(m, rows))
    _update_rows(
        new.x, new.P, z, position, age, valid, sigma, rows, anew, bool(second_order), nis, counts, restarted,
        scratch,
    )  # fmt: skip
    return new, Innovation(nis, counts[0], counts[1], restarted)


def _checked(measurements: Measurements, n: int) -> Measurements:
    """The measurements of n vehicles as arrays of the right shapes.

    Raises:
        ValueError: See `update`.
    """
    z = as_floats("z", measurements.z, (n, None, N_MEASUREMENT), finite=False)
    m, age, rows = z.shape[1], measurements.age, measurements.rows
    sigma = as_floats("sigma", measurements.sigma, (N_MEASUREMENT,))
    if not (sigma > 0.0).all():
        raise ValueError(f"sigma must be three standard deviations > 0 (m, rad, rad), got {sigma}")
    known = {sensor_rows(name): name for name in SENSORS}
    if rows not in known:
        allowed = " or ".join(f"{number} ({name})" for number, name in known.items())
        raise ValueError(f"rows must be {allowed}, got {shown(rows)}")
    return Measurements(
        z,
        as_floats("position", measurements.position, (n, m, 3), finite=False),
        np.zeros((n, m)) if age is None else as_floats("age", age, (n, m), finite=False),
        as_mask("valid", measurements.valid, (n, m)),
        sigma,
        rows,
    )
