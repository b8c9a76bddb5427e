"""Monte Carlo runs of chapter 6: four vehicles on rails, a target, and who holds whose measurements.

Also the readable twin of the update.
"""

from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from controllers.estimation import Measurements, ekf
from controllers.estimation.consistency import nees
from controllers.estimation.kalman import kalman_update
from quad_envs.rotations import wrap_angle
from quad_envs.sensors import OVERHEAD, direction, direction_jacobian, jacobian, range_azimuth_elevation

DT, STEPS = 0.05, 200
SIGMA = np.array([0.1, 0.02, 0.02])  # m, rad, rad
RAILS = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, -1.0], [0.0, 4.0, 1.0], [4.0, 4.0, -2.0]])
RAIL_VELOCITY = np.array([0.8, 0.3, -0.1])
START = np.array([3.0, 3.0, -6.0, 0.8, 0.3, -0.1])
INTERVALS = (slice(0, 50), slice(50, 100), slice(100, 200))  # 0 to 2.5, 2.5 to 5, 5 to 10 s
# Topologies of figures 6.2 to 6.5, interval by interval: whose measurements vehicles 1 to 4 hold.
HELD = (
    ((0, 1, 2, 3), (0, 1, 2), (0, 1)),
    ((1, 2), (1, 2, 3), (0, 1, 2, 3)),
    ((0, 2, 3), (2, 3), (2, 3)),
    ((2, 3), (2, 3), (1, 2, 3)),
)


class Truth(NamedTuple):
    target: np.ndarray  # (steps, runs, 6)
    vehicles: np.ndarray  # (steps, 4, 3)
    z: np.ndarray  # (steps, runs, 4, 3)


class Runs(NamedTuple):
    x: np.ndarray  # (steps, runs, vehicles, 6)
    P: np.ndarray  # (steps, runs, vehicles, 6, 6)
    error: np.ndarray  # (steps, runs, vehicles, 3), position
    nis: np.ndarray  # (steps, runs, vehicles)
    rows: np.ndarray  # (steps, runs, vehicles)

    def rmse(self, vehicle, interval):
        return np.sqrt((self.error[interval, :, vehicle] ** 2).sum(axis=-1).mean())

    def anees(self, vehicle, interval):
        """Mean normalised error of the position over its 3 degrees of freedom; 1 for a consistent filter."""
        return nees(self.error[interval, :, vehicle], self.P[interval, :, vehicle, :3, :3]).mean() / 3.0

    def anis(self, vehicle, interval):
        """Mean normalised innovation per row; 1 for a consistent filter."""
        return self.nis[interval, :, vehicle].sum() / self.rows[interval, :, vehicle].sum()


def measurements(target, rng):
    """Vehicles on their rails and what they measure of the target (steps, runs, 6)."""
    times = DT * np.arange(len(target))
    vehicles = RAILS + times[:, None, None] * RAIL_VELOCITY
    z = range_azimuth_elevation(target[:, :, None, :3] - vehicles[:, None])
    return Truth(target, vehicles, z + SIGMA * rng.normal(size=z.shape))


def cv_truth(runs, rng, q=0.02):
    """The constant-velocity target of chapter 6."""
    F, Q = ekf.constant_velocity_model(DT, q)
    noise = np.linalg.cholesky(Q)
    x, target = np.tile(START, (runs, 1)), np.empty((STEPS, runs, 6))
    for k in range(STEPS):
        x = x @ F.T + rng.normal(size=(runs, 6)) @ noise.T
        target[k] = x
    return measurements(target, rng)


def aircraft_rate(t, X):
    """Point-mass aircraft, Eq. (6.10) with z down, and its default manoeuvre."""
    _, _, _, V, gamma, chi = X
    V_c, a_v, a_h = 2.0 + 0.5 * np.sin(0.4 * t), 0.5 * np.cos(0.5 * t), np.sin(0.3 * t)
    v = V * np.array([np.cos(chi) * np.cos(gamma), np.sin(chi) * np.cos(gamma), -np.sin(gamma)])
    return [*v, V_c - V, a_v / V, a_h / (V * np.cos(gamma))]


def aircraft_truth(runs, rng):
    """The aircraft, measured in each run anew. Also its polar states, (steps, 6)."""
    start = [6.0, -2.0, -5.0, 2.0, 0.05, 0.6]
    times = DT * np.arange(1, STEPS + 1)
    polar = solve_ivp(aircraft_rate, (0.0, times[-1]), start, t_eval=times, rtol=1e-9, atol=1e-9).y.T
    velocity = np.array([aircraft_rate(t, X)[:3] for t, X in zip(times, polar, strict=True)])
    target = np.concatenate([polar[:, :3], velocity], axis=1)
    return measurements(np.tile(target[:, None], (1, runs, 1)), rng), polar


def held(k, own_only=False):
    """Whose measurements each vehicle holds in step k, (4, 4)."""
    if own_only:
        return np.eye(4, dtype=bool)
    interval = next(i for i, part in enumerate(INTERVALS) if k < part.stop)
    mask = np.zeros((4, 4), dtype=bool)
    for i, rows in enumerate(HELD):
        mask[i, list(rows[interval])] = True
    return mask


def start_filters(truth_0, P_0, rng):
    """Filters of all vehicles in all runs, drawn from their own covariance: state (runs 4, 6)."""
    runs = len(truth_0)
    x = np.repeat(truth_0, 4, axis=0) + rng.normal(size=(4 * runs, 6)) @ np.linalg.cholesky(P_0).T
    return ekf.TargetFilter(x, np.tile(P_0, (4 * runs, 1, 1)))


def fly(truth, state, predict, rows, held=held, fuse=None, update=ekf.update):
    """Run the filters over a truth; `fuse(state)` after each step, `held(k)` (4, 4)."""
    runs = truth.z.shape[1]
    parts = []
    for k in range(len(truth.z)):
        z = np.repeat(truth.z[k], 4, axis=0)
        places = np.tile(truth.vehicles[k], (4 * runs, 1, 1))
        valid = np.tile(held(k), (runs, 1))
        state, innovation = update(predict(state), Measurements(z, places, None, valid, SIGMA, rows))
        state = fuse(state) if fuse else state
        error = state.x[:, :3] - np.repeat(truth.target[k, :, :3], 4, axis=0)
        parts.append((*state, error, innovation.nis, innovation.rows))
    return Runs(
        *(
            np.array(part).reshape(len(parts), runs, 4, *part[0].shape[1:])
            for part in zip(*parts, strict=True)
        )
    )


def readable_variances(d, elevation):
    """Variances along and across the measured azimuth, of a predicted d."""
    horizontal = max(np.cos(elevation) ** 2, (d[0] ** 2 + d[1] ** 2) / (d @ d))
    second_order = 0.5 * np.cos(elevation) ** 2 * (SIGMA[1] ** 4 + SIGMA[2] ** 4)
    along = np.sin(elevation) ** 2 * SIGMA[2] ** 2 + second_order
    return np.array([along, (horizontal + SIGMA[2] ** 2) * SIGMA[1] ** 2])


def rows_of(x, z, position, age, rows, wrap=True, overhead=True):
    """Readable linearisation of one vehicle's measurements: nu, H, variances."""
    parts = []
    for z_j, p_j, age_j in zip(z, position, age, strict=True):
        d = x[:3] - age_j * x[3:] - p_j
        nu = z_j - range_azimuth_elevation(d)
        nu[1] = wrap_angle(nu[1]) if wrap else nu[1]
        H_r, variance = jacobian(d), SIGMA**2
        limit = OVERHEAD * SIGMA[2] * np.linalg.norm(d)
        if overhead and rows == 3 and np.hypot(d[0], d[1]) <= limit and z_j[2] * d[2] <= 0.0:
            order = [1, 0]  # across, along
            nu[1:] = (np.array([np.cos(z_j[2]), 0.0]) - direction(d, z_j[1]))[order]
            H_r[1:] = direction_jacobian(d, z_j[1])[order]
            variance = np.array([SIGMA[0] ** 2, *readable_variances(d, z_j[2])[order]])
        parts.append((nu[:rows], np.hstack([H_r, -age_j * H_r])[:rows], variance[:rows]))
    return [np.concatenate(part) for part in zip(*parts, strict=True)]


def readable_update(x, P, nu, H, R):
    R = np.diag(R) if R.ndim == 1 else R
    S = H @ P @ H.T + R
    K = np.linalg.solve(S, H @ P).T
    A = np.eye(6) - K @ H
    return x + K @ nu, A @ P @ A.T + K @ R @ K.T, nu @ np.linalg.solve(S, nu)


def curved(x, P, position, age, nu, H, variance):
    """Second order of ranges: the mean and the covariance of d'D d / 2 with d ~ N(0, P)."""
    DP = []
    for p_j, age_j in zip(position, age, strict=True):
        d = x[:3] - age_j * x[3:] - p_j
        rho = np.linalg.norm(d)
        DP.append((np.eye(3) - np.outer(d, d) / rho**2) / rho @ P[:3, :3])
    bias = [0.5 * np.trace(a) for a in DP]
    more = [[0.5 * np.trace(a @ b) for b in DP] for a in DP]
    return nu - bias, H, np.diag(variance) + np.array(more)


def measured_point(z, position, age, v):
    rho, az, el = z
    ray = rho * np.array([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), -np.sin(el)])
    return position + ray + age * v


def readable_restart(z, position, age, restart):
    """The filter that begins anew at the most central measurement, updated with the others."""
    v, variance = np.array(restart.rest), np.square(restart.sigma)
    points = np.array([measured_point(*one, v) for one in zip(z, position, age, strict=True)])
    best = np.linalg.norm(points[:, None] - points, axis=-1).sum(axis=1).argmin()
    J = np.array([(measured_point(z[best] + h, position[best], 0.0, v)
                   - measured_point(z[best] - h, position[best], 0.0, v)) / 2e-6
                  for h in 1e-6 * np.eye(3)]).T  # fmt: skip
    P = np.diag(variance)
    P[:3, :3] = J @ np.diag(SIGMA**2) @ J.T + age[best] ** 2 * np.diag(variance[3:])
    x = np.concatenate([points[best], v])
    others = np.delete(np.arange(len(z)), best)
    if not len(others):
        return x, P
    parts = rows_of(x, z[others], position[others], age[others], 3)
    new_x, new_P, nis = readable_update(x, P, *parts)
    return (new_x, new_P) if nis <= 50.0 * len(parts[0]) else (x, P)


def sweep(path, runs, rng, overhead=True, wrap=True):
    """A target passes the origin: errors and covariances, and errors and NEES of a naive filter."""
    vehicle = np.zeros((1, 3))
    velocity = np.gradient(path, DT, axis=0)
    x = np.concatenate([path[0], velocity[0]]) + 0.1 * rng.normal(size=(runs, 6))
    mine = ekf.TargetFilter(x, np.tile(0.01 * np.eye(6), (runs, 1, 1)))
    other = ekf.TargetFilter(*mine)
    errors, covariances, other_errors, other_nees = [], [], [], []
    for k in range(len(path)):
        z = range_azimuth_elevation(path[k]) + SIGMA * rng.normal(size=(runs, 1, 3))
        z[..., 1] = wrap_angle(z[..., 1])
        place = np.tile(vehicle, (runs, 1, 1))
        mine, _ = ekf.update(ekf.predict(mine, DT, 0.2), Measurements(z, place, None, None, SIGMA, 3))
        other = ekf.predict(other, DT, 0.2)
        parts = [rows_of(other.x[i], z[i], vehicle, [0.0], 3, wrap, overhead) for i in range(runs)]
        nu, H, variance = (np.array(part) for part in zip(*parts, strict=True))
        new = kalman_update(other.x, other.P, nu, H, variance[:, :, None] * np.eye(3))
        other = ekf.TargetFilter(new.x, new.P)
        errors.append(mine.x[:, :3] - path[k])
        covariances.append(mine.P[:, :3, :3])
        other_errors.append(other.x[:, :3] - path[k])
        other_nees.append(nees(other_errors[-1], other.P[:, :3, :3]))
    return np.array(errors), np.array(covariances), np.array(other_errors), np.array(other_nees)
