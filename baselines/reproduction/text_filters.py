"""Filters as chapter 6 prints them, and their repairs one by one; none of them is offered as a policy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from controllers.estimation import ekf, polar_ekf
from controllers.estimation.kalman import kalman_update
from controllers.estimation.trilateration import trilaterate
from quad_envs.parameters import Array
from quad_envs.sensors import jacobian, range_azimuth_elevation

from .scenes import Filter, Held, Scene, Track, Update, ekf_update

_Updated = tuple[Filter, Array, NDArray[np.int64]]
NO_NOISE = 1e-4  # of the noise's standard deviation, in place of none: with four ranges H P H' has no inverse


def without_noise(state: Filter, held: Held) -> _Updated:
    """The gain of Eq. (6.4), P H' [H P H']^-1."""
    return ekf_update(state, held._replace(sigma=NO_NOISE * held.sigma))


def squared_range(constant: bool) -> Update:
    """The measurement of Eq. (6.3), rho^2.

    Args:
        constant: Whether its noise has the variance sigma^2 whatever the range, as printed; else
            4 rho^2 sigma^2 + 2 sigma^4, and the bias sigma^2 is taken off.
    """

    def update(state: Filter, held: Held) -> _Updated:
        x, _ = state
        d = x[:, None, :3] - held.places
        rho2, s2 = (d**2).sum(axis=-1), held.sigma[0] ** 2
        H = np.zeros((*rho2.shape, x.shape[1]))
        H[..., :3] = np.where(held.valid[..., None], 2.0 * d, 0.0)
        seen = held.z[..., 0] ** 2 - (0.0 if constant else s2)
        nu = np.where(held.valid, seen - rho2, 0.0)
        variance = np.full_like(rho2, s2) if constant else 4.0 * rho2 * s2 + 2.0 * s2**2
        return _joint_update(state, nu, H, variance, held)

    return update


def range_update(state: Filter, held: Held) -> _Updated:
    """An update with ranges for a state of any size whose first three entries are the position."""
    x, _ = state
    d = x[:, None, :3] - held.places
    H = np.zeros((*d.shape[:2], x.shape[1]))
    H[..., :3] = np.where(held.valid[..., None], jacobian(d)[..., 0, :], 0.0)
    nu = np.where(held.valid, held.z[..., 0] - range_azimuth_elevation(d)[..., 0], 0.0)
    return _joint_update(state, nu, H, np.full_like(nu, held.sigma[0] ** 2), held)


def _joint_update(state: Filter, nu: Array, H: Array, variance: Array, held: Held) -> _Updated:
    """Rows that are not held have nu = 0 and H = 0, and change nothing."""
    new = kalman_update(*state, nu, H, variance[:, :, None] * np.eye(nu.shape[1]))
    return (new.x, new.P), new.nis, held.valid.sum(axis=1)


def random_walk(q: float, dt: float = 0.05) -> Callable[[Filter], Filter]:
    """Prediction of the 3-state filter of 6.2, the position alone; q is the density of its motion, m^2/s."""

    def predict(state: Filter) -> Filter:
        return state[0], state[1] + q * dt * np.eye(3)

    return predict


def polar_model(speed: polar_ekf.Speed, dt: float = 0.05) -> Callable[[Filter], Filter]:
    """Prediction of the filter (6.12) for the aircraft: "decaying" as printed, "constant" corrected."""

    def predict(state: Filter) -> Filter:
        new = polar_ekf.predict(ekf.TargetFilter(*state), dt, speed=speed)
        return new.x, new.P

    return predict


def fixes_alone(scene: Scene, vehicle: int, part: slice) -> Track:
    """Trilaterated positions of a vehicle that holds four ranges, without any filter, 6.2.1.1."""
    n = scene.task.vehicles
    z, places, held = (values[part, vehicle::n] for values in (scene.z[..., 0], scene.places, scene.held))
    T, runs, m = z.shape
    ranges, valid = z.reshape(-1, m), held.reshape(-1, m)
    fix = trilaterate(places.reshape(-1, m, 3), ranges, scene.task.sensor_sigma[0], valid)
    whole = fix.accepted.reshape(T, runs).all(axis=0)  # no refusal: samples stay neighbours in time
    error = fix.r.reshape(T, runs, 3) - scene.target[part, vehicle::n, :3]
    P, residual = fix.P.reshape(T, runs, 3, 3), fix.residual.reshape(T, runs)
    rows = held.sum(axis=-1) - 3
    runs_left = np.flatnonzero(whole)[:, None]
    return Track(error[:, runs_left], P[:, runs_left], residual[:, runs_left], rows[:, runs_left])
