"""Target filters with other models than constant velocity, as `Estimator`s: chapter 6's point mass and point.

`PolarEstimator` wraps the filter of section 6.2.2 (`polar_ekf.py`), `RandomWalkEstimator` is the filter whose
state is the position alone, which 6.2.1 calls "constant velocity".
"""

from __future__ import annotations

import math

import numpy as np

from quad_envs.arguments.names import shown
from quad_envs.parameters import Array
from quad_envs.sensors import N_MEASUREMENT

from . import ekf, polar_ekf
from .ekf import Restart, TargetFilter
from .ekf_kernels import N_TARGET
from .polar_ekf import CLIMB, COURSE, POLAR_NOISE, SPEED, Speed
from .protocol import Measurements, Prior

RANDOM_WALK_NOISE = 0.81  # m^2/s
_STATE = N_TARGET * (N_TARGET + 1)
_UNIFORM = math.pi / math.sqrt(3.0)  # rad, standard deviation of an angle of which nothing is known
_STEEPEST = 0.7  # rad, of a climb of which nothing is known
_SMALLEST_SPEED = 0.05  # m/s, in divisions
_SMALLEST_VARIANCE = 1e-6  # m^2/s^2: at rest the angles say nothing of the velocity


def _packed(state: TargetFilter) -> Array:
    return np.concatenate([state.x, state.P.reshape(-1, N_TARGET**2)], axis=1)


def _unpacked(memory: Array) -> TargetFilter:
    n = len(memory)
    return TargetFilter(
        memory[:, :N_TARGET].copy(), memory[:, N_TARGET:_STATE].reshape(n, N_TARGET, N_TARGET).copy()
    )


class PolarEstimator:
    """The dissertation's filter for an aircraft, X = [r; V, gamma, chi], r relative to the vehicle.

    The first angles place a vague mean, as in the Cartesian filter. At rest gamma and chi are not observable:
    a prior without velocity begins with a speed of one of its deviations and an unknown course.

    Args:
        q: Densities of the noise in V', m^2/s^3, gamma' and chi', rad^2/s.
        speed: "constant" or "decaying" (as printed).

    Raises:
        ValueError: If q is not three numbers >= 0, or there is no such speed.
    """

    size = _STATE + 10  # a flag for the first angles and the restart

    def __init__(self, q: tuple[float, float, float] = POLAR_NOISE, speed: Speed = "constant") -> None:
        self.q, self.speed = tuple(np.asarray(q, dtype=np.float64).reshape(-1).tolist()), speed
        polar_ekf.predict(polar_ekf.polar_filter(np.zeros((0, 6))), 0.0, self.q, speed)  # checks both

    def begin(self, prior: Prior) -> Array:
        """The prior in polar velocity; see `Estimator`."""
        n = len(prior.position)
        v, (position, spread) = np.asarray(prior.velocity, dtype=np.float64), prior.sigma
        V = max(float(np.linalg.norm(v)), float(spread))
        gamma = math.asin(min(max(-v[2] / V, -1.0), 1.0))
        angle = float(spread) / V if np.linalg.norm(v) >= spread else math.inf
        rest = np.array([V, gamma, math.atan2(v[1], v[0])])
        sigma = np.array([position] * 3 + [spread, min(angle, _STEEPEST), min(angle, _UNIFORM)])
        x = np.concatenate([prior.position, np.tile(rest, (n, 1))], axis=1)
        state = TargetFilter(x, np.tile(np.diag(sigma**2), (n, 1, 1)))
        kept = np.concatenate([[0.0], rest, sigma])
        return np.concatenate([_packed(state), np.tile(kept, (n, 1))], axis=1)

    def predict(self, memory: Array, dt: float, displacement: Array) -> Array:
        """See `Estimator`."""
        state = ekf.shift(polar_ekf.predict(_unpacked(memory), dt, self.q, self.speed), displacement)
        return np.concatenate([_packed(state), memory[:, _STATE:]], axis=1)

    def update(self, memory: Array, measurements: Measurements) -> Array:
        """See `Estimator`. A measurement made `age` ago at p counts as one made now at p + age v."""
        state, kept = _unpacked(memory), memory[:, _STATE:].copy()
        z, position, age, valid, _, rows = measurements
        v = polar_ekf.velocity(state.x)
        place = position + age[..., None] * v[:, None]
        if rows == N_MEASUREMENT and len(kept):
            first = (kept[:, 0] == 0.0) & valid.any(axis=1)
            state.x[first, :3] = _first_points(z[first], place[first], valid[first])
            kept[first, 0] = 1.0
        restart = None
        if len(kept):
            rest, spread = kept[0, 1:4].tolist(), kept[0, 4:].tolist()
            restart = Restart((rest[0], rest[1], rest[2]), tuple(spread))
        new, _ = ekf.update(
            state, measurements._replace(position=place, age=np.zeros_like(age)), restart=restart
        )
        return np.concatenate([_packed(new), kept], axis=1)

    def mean(self, memory: Array) -> Array:
        """See `Estimator`."""
        X = memory[:, :N_TARGET]
        return np.concatenate([X[:, :3], polar_ekf.velocity(X)], axis=1)

    def covariance(self, memory: Array) -> Array:
        """See `Estimator`; to the first order."""
        state = _unpacked(memory)
        T = _cartesian_by_polar(state.x)
        P = T @ state.P @ T.transpose(0, 2, 1)
        P[:, range(3, 6), range(3, 6)] += _SMALLEST_VARIANCE
        return np.asarray(0.5 * (P + P.transpose(0, 2, 1)))

    def replaced(self, memory: Array, x: Array, P: Array) -> Array:
        """The memory with another belief, Cartesian."""
        V = np.maximum(np.linalg.norm(x[:, 3:], axis=1), _SMALLEST_SPEED)
        gamma = np.arcsin(np.clip(-x[:, 5] / V, -0.999, 0.999))
        X = np.concatenate([x[:, :3], np.stack([V, gamma, np.arctan2(x[:, 4], x[:, 3])], axis=1)], axis=1)
        T = np.linalg.inv(_cartesian_by_polar(X))
        state = TargetFilter(X, T @ P @ T.transpose(0, 2, 1))
        return np.concatenate([_packed(state), memory[:, _STATE:]], axis=1)


class RandomWalkEstimator:
    """A target whose position walks at random: the three states that 6.2.1 calls constant velocity.

    Of the velocity nothing is ever learned: mean and covariance keep those of the prior.

    Args:
        q: Density of the position's noise, m^2/s.

    Raises:
        ValueError: If q is negative or not finite.
    """

    size = _STATE

    def __init__(self, q: float = RANDOM_WALK_NOISE) -> None:
        if not 0.0 <= q < math.inf:
            raise ValueError(f"q of a random walk must be finite and >= 0 m^2/s, got {shown(q)}")
        self.q = float(q)

    def begin(self, prior: Prior) -> Array:
        """See `Estimator`."""
        position, velocity = float(prior.sigma[0]), float(prior.sigma[1])
        return _packed(ekf.initial_filter(prior.position, prior.velocity, (position, velocity)))

    def predict(self, memory: Array, dt: float, displacement: Array) -> Array:
        """See `Estimator`: r stays, its variance grows by q dt."""
        state = ekf.shift(_unpacked(memory), displacement)
        state.P[:, range(3), range(3)] += self.q * dt
        return _packed(state)

    def update(self, memory: Array, measurements: Measurements) -> Array:
        """See `Estimator`."""
        state = _unpacked(memory)
        now = measurements._replace(age=np.zeros_like(measurements.age))
        new, _ = ekf.update(state, now, restart=None)
        new.x[:, 3:] = state.x[:, 3:]
        new.P[:, 3:], new.P[:, :, 3:] = state.P[:, 3:], state.P[:, :, 3:]
        return _packed(new)

    def mean(self, memory: Array) -> Array:
        """See `Estimator`."""
        return memory[:, :N_TARGET].copy()

    def covariance(self, memory: Array) -> Array:
        """See `Estimator`."""
        return _unpacked(memory).P

    def replaced(self, memory: Array, x: Array, P: Array) -> Array:
        """The memory with another belief of the position."""
        state = _unpacked(memory)
        state.x[:, :3], state.P[:, :3, :3] = x[:, :3], P[:, :3, :3]
        return _packed(state)


def _first_points(z: Array, place: Array, valid: Array) -> Array:
    """Where the first valid measurement of each row puts the target, (n, 3)."""
    which = valid.argmax(axis=1)
    rows = np.arange(len(z))
    rho, az, el = z[rows, which].T
    level = rho * np.cos(el)
    ray = np.stack([level * np.cos(az), level * np.sin(az), -rho * np.sin(el)], axis=1)
    return np.asarray(place[rows, which] + ray)


def _cartesian_by_polar(X: Array) -> Array:
    """Derivative of [r, v] by [r, V, gamma, chi], (n, 6, 6); V no smaller than what divides."""
    V = np.maximum(X[:, SPEED], _SMALLEST_SPEED)
    sg, cg, sc, cc = np.sin(X[:, CLIMB]), np.cos(X[:, CLIMB]), np.sin(X[:, COURSE]), np.cos(X[:, COURSE])
    zero = np.zeros_like(V)
    T = np.tile(np.eye(6), (len(X), 1, 1))
    T[:, 3:, 3] = np.stack([cc * cg, sc * cg, -sg], axis=1)
    T[:, 3:, 4] = np.stack([-V * cc * sg, -V * sc * sg, -V * cg], axis=1)
    T[:, 3:, 5] = np.stack([-V * sc * cg, V * cc * cg, zero], axis=1)
    return T
