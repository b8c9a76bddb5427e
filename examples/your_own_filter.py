"""An unscented Kalman filter of one's own, flown by the cooperative MPC and shared through the wrapper.

    python -m examples.your_own_filter

Five members make an estimator (`controllers.estimation.Estimator`): `begin`, `predict`, `update`, `mean` and
`covariance`, pure functions of a memory (n, size), one row per vehicle. `replaced` is for sharing estimates.
"""

import numpy as np

from baselines import EstimateWrapper, evaluate, make_policy
from quad_envs import target_tracking_v0
from quad_envs.sensors import range_azimuth_elevation


class UnscentedFilter:
    """Constant velocity; range, azimuth and elevation through 13 sigma points instead of derivatives."""

    size = 42  # x and P

    def __init__(self, q: float = 0.05) -> None:
        self.q = q  # m^2/s^3, density of the target's acceleration

    def begin(self, prior):
        """The prior, (n, 42)."""
        n = len(prior.position)
        x = np.concatenate([prior.position, np.tile(prior.velocity, (n, 1))], axis=1)
        P = np.diag(np.repeat(np.square(prior.sigma), 3))
        return np.concatenate([x, np.tile(P.ravel(), (n, 1))], axis=1)

    def predict(self, memory, dt, displacement):
        """The motion is linear: no sigma points needed. The vehicle moves, so the target comes nearer."""
        F = np.kron([[1.0, dt], [0.0, 1.0]], np.eye(3))
        Q = self.q * np.kron([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]], np.eye(3))
        x, P = self.mean(memory) @ F.T, F @ self.covariance(memory) @ F.T + Q
        x[:, :3] -= displacement
        return self.replaced(memory, x, P)

    def update(self, memory, measurements):
        """One vehicle after the other, one measurement after the other: short rather than fast."""
        z, position, age, valid, sigma, rows = measurements
        x, P = self.mean(memory), self.covariance(memory)
        for i, j in zip(*np.nonzero(valid), strict=True):
            root = np.linalg.cholesky(6.0 * P[i]).T
            points = x[i] + np.concatenate([np.zeros((1, 6)), root, -root])
            weights = np.array([0.0] + [1.0 / 12.0] * 12)
            h = range_azimuth_elevation(points[:, :3] - age[i, j] * points[:, 3:] - position[i, j])
            h[:, 1] = h[0, 1] + wrapped(h[:, 1] - h[0, 1])
            expected = weights @ h[:, :rows]
            e, d = h[:, :rows] - expected, points - x[i]
            S = (weights * e.T) @ e + np.diag(sigma[:rows] ** 2)
            K = np.linalg.solve(S, (weights * e.T) @ d).T
            nu = z[i, j, :rows] - expected
            if rows == 3:
                nu[1] = wrapped(nu[1])
            x[i] += K @ nu
            P[i] -= K @ S @ K.T
        return self.replaced(memory, x, P)

    def mean(self, memory):
        """Position relative to the vehicle, and velocity, (n, 6)."""
        return memory[:, :6].copy()

    def covariance(self, memory):
        """Its covariance, (n, 6, 6)."""
        return memory[:, 6:].reshape(-1, 6, 6).copy()

    def replaced(self, memory, x, P):
        """Another belief; what neighbours sent arrives here."""
        return np.concatenate([x, 0.5 * (P + P.transpose(0, 2, 1)).reshape(len(x), 36)], axis=1)


def wrapped(angle):
    """The angle in [-pi, pi)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def main() -> None:
    """Fly beside the target with it, alone and shared."""
    env = target_tracking_v0.parallel_env(time_limit=8.0, prior_sigma=(1.0, 1.0))
    for name in ("ekf", UnscentedFilter()):
        print(evaluate(make_policy("cooperative-mpc", env, estimator=name), env, episodes=1, seed=0))
    shared = EstimateWrapper(
        target_tracking_v0.parallel_env(time_limit=8.0, measuring=(0, 1), graph="case-2"),
        estimator=UnscentedFilter(),
    )
    print(evaluate(make_policy("cooperative-mpc", shared), shared, episodes=1, seed=0))


if __name__ == "__main__":
    main()
