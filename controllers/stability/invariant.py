"""Sets that a linear law never leaves: ellipsoids inside the limits, as large as they can be.

{x: x'P x <= c} is invariant under x+ = (A - B K) x where (A - B K)'P (A - B K) <= P, and keeps the limits
|h_j x| <= b_j where c <= b_j^2 / (h_j P^-1 h_j'). Inside it no limit is active, so the MPC with the terminal
weight of K is the law u = -K x itself: what `certificates.py` asks of the limits then holds for ever.
"""

from __future__ import annotations

import math
import warnings
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quad_envs.arguments.extras import install_command
from quad_envs.parameters import ATTITUDE, N_INPUT, N_STATE, Array
from quad_envs.tasks import BaseTask

from ..mpc.mpc import limit_rows

_STATES = ("x", "y", "z", "u", "v", "w", "roll", "pitch", "yaw", "p", "q", "r")
_LARGEST_TILT = math.pi / 2.0 - 0.01  # rad
_INVARIANCE_TOLERANCE = 1e-6  # of the solution in its own coordinates, where P is near the identity


class Halfspaces(NamedTuple):
    """Limits |h_j x| <= b_j about the set-point, of two-sided ones the nearer side."""

    normals: Array  # (J, n)
    bounds: Array  # (J,), > 0
    names: tuple[str, ...]  # (J,)


class Ellipsoid(NamedTuple):
    """{x: x'P x <= level}."""

    P: Array  # (n, n), positive definite
    level: float
    binding: str  # the limit that it touches

    def value(self, x: Array) -> Array:
        """The number x'P x / level, (...,): at most 1 inside."""
        return np.asarray(np.einsum("...a,ab,...b->...", x, self.P, x) / self.level)

    def projection(self, first: Array, second: Array) -> Array:
        """Shape W of the shadow {y: y'W^-1 y <= 1} under y = (first x, second x), (2, 2)."""
        pair = np.stack([first, second])
        return np.asarray(self.level * pair @ np.linalg.solve(self.P, pair.T))

    @property
    def size(self) -> float:
        """Radius of the ball of the same volume, in the units of the state."""
        return float(math.sqrt(self.level) * math.exp(-0.5 * np.linalg.slogdet(self.P)[1] / len(self.P)))


def law_halfspaces(task: BaseTask, K: ArrayLike, A_K: ArrayLike, margin: float = 0.0) -> Halfspaces:
    """All limits of a task as limits on the state under u = -K x, about hover at the origin and heading 0.

    The rate rows compare two inputs of the law, -K (A_K - I) x; the command before the first one has to fit.
    Where the task has no limit on tilt, roll and pitch end where the attitude angles do, below pi/2 (2.37).

    Args:
        task: Rotor box, rate and state limits are taken from it.
        K: Gain, (4, 12).
        A_K: A - B K, (12, 12).
        margin: Kept from the state limits, in the SI unit of each.

    Raises:
        ValueError: If hover at the origin does not lie inside all limits.
    """
    K, A_K = np.asarray(K, dtype=np.float64), np.asarray(A_K, dtype=np.float64)
    u_T = task.hover_force
    normals, names = [K], [f"rotor {i + 1}" for i in range(N_INPUT)]
    bounds = [np.minimum(u_T, task.force_max - u_T)]
    if math.isfinite(task.limits.rate):
        normals.append(K @ (A_K - np.eye(len(A_K))))
        bounds.append(np.full(N_INPUT, task.limits.rate * task.dt))
        names += [f"rate of rotor {i + 1}" for i in range(N_INPUT)]
    rows, _ = limit_rows(task.limits, margin, math.inf, 1)
    normals.append(rows.normals)
    bounds.append(np.minimum(-rows.lower, rows.upper))
    names += [_STATES[int(np.argmax(np.abs(normal)))] for normal in rows.normals]
    if not math.isfinite(task.limits.tilt):
        normals.append(np.eye(N_STATE)[ATTITUDE][:2])
        bounds.append(np.full(2, _LARGEST_TILT))
        names += ["roll, of its range", "pitch, of its range"]
    return _halfspaces(np.concatenate(normals), np.concatenate(bounds), tuple(names))


def _halfspaces(normals: Array, bounds: Array, names: tuple[str, ...]) -> Halfspaces:
    for name, bound in zip(names, bounds.tolist(), strict=True):
        if not bound > 0.0:
            raise ValueError(
                f"the set-point must lie inside all limits; it is {-bound:.3g} (SI) beyond that of {name}: "
                "widen it, or choose a smaller margin"
            )
    return Halfspaces(normals, bounds, names)


def inscribed_ellipsoid(P: ArrayLike, limits: Halfspaces) -> Ellipsoid:
    """The largest {x: x'P x <= c} inside the limits, in closed form: c = min_j b_j^2 / (h_j P^-1 h_j').

    Args:
        P: Shape, (n, n), symmetric and positive definite.
        limits: At least one.

    Raises:
        ValueError: If P is not symmetric and positive definite, or a shape is wrong.
    """
    P = np.asarray(P, dtype=np.float64)
    n = limits.normals.shape[1]
    if P.shape != (n, n):
        raise ValueError(f"P must have shape {(n, n)} as the limits do, got {P.shape}")
    if not np.allclose(P, P.T, rtol=1e-9, atol=1e-9 * float(np.abs(P).max())):
        raise ValueError("P must be symmetric; use (P + P.T) / 2")
    smallest = float(np.linalg.eigvalsh(P)[0])
    if not smallest > 0.0:
        raise ValueError(f"P must be positive definite, its smallest eigenvalue is {smallest}")
    reach = np.einsum("ja,aj->j", limits.normals, np.linalg.solve(P, limits.normals.T))
    levels = limits.bounds**2 / reach
    j = int(np.argmin(levels))
    return Ellipsoid(P, float(levels[j]), limits.names[j])


def largest_ellipsoid(A_K: ArrayLike, limits: Halfspaces) -> Ellipsoid:
    """The invariant ellipsoid of largest volume inside the limits: max log det Y, Y = P^-1, an LMI.

    [[Y, (A_K Y)'], [A_K Y, Y]] >= 0 and h_j Y h_j' <= b_j^2, by Clarabel through cvxpy (extra `lmi`); solved
    in coordinates in which the ellipsoid of a Lyapunov function is the unit ball.

    Args:
        A_K: Closed loop A - B K, (n, n), with all eigenvalues inside the unit circle.
        limits: Their normals have to see every mode of A_K, else the volume has no bound.

    Raises:
        ModuleNotFoundError: If cvxpy or Clarabel is not installed.
        ValueError: If A_K is not stable, or the solver finds no solution.
    """
    A_K = np.asarray(A_K, dtype=np.float64)
    radius = float(np.abs(np.linalg.eigvals(A_K)).max())
    if not radius < 1.0:
        raise ValueError(f"A - B K must be stable, its spectral radius is {radius}")
    from scipy.linalg import solve_discrete_lyapunov

    scaled = limits.normals / limits.bounds[:, None]
    start = inscribed_ellipsoid(solve_discrete_lyapunov(A_K.T, scaled.T @ scaled + np.eye(len(A_K))), limits)
    T = np.linalg.inv(np.linalg.cholesky(start.P / start.level)).T  # start is the unit ball of T^-1 x
    Y = _maximise_volume(np.linalg.solve(T, A_K @ T), scaled @ T)
    P = np.linalg.inv(T @ Y @ T.T)
    return inscribed_ellipsoid(0.5 * (P + P.T), limits)


def _maximise_volume(A_K: Array, normals: Array) -> Array:
    """Largest log det Y with Y >= A_K Y A_K' and h_j Y h_j' <= 1; (n, n)."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of other solvers that cvxpy looks for
            import_module("clarabel")
            cvxpy: Any = import_module("cvxpy")
    except ImportError as error:
        raise ModuleNotFoundError(
            f"the largest invariant ellipsoid needs cvxpy and Clarabel ({error}): "
            f"{install_command('lmi')}; the ellipsoid of the Riccati weight needs neither"
        ) from error
    n = len(A_K)
    Y = cvxpy.Variable((n, n), symmetric=True)
    invariance = cvxpy.bmat([[Y, Y @ A_K.T], [A_K @ Y, Y]])
    rows = [h @ Y @ h <= 1.0 for h in normals]
    problem = cvxpy.Problem(cvxpy.Maximize(cvxpy.log_det(Y)), [0.5 * (invariance + invariance.T) >> 0, *rows])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # "may be inaccurate": the result is judged below
        problem.solve(solver=cvxpy.CLARABEL)
    if Y.value is None:
        raise ValueError(f"Clarabel found no invariant ellipsoid: {problem.status}; check the limits")
    found = np.asarray(0.5 * (Y.value + Y.value.T))
    slack = float(np.linalg.eigvalsh(found - A_K @ found @ A_K.T)[0])
    if slack < -_INVARIANCE_TOLERANCE * float(np.abs(found).max()):
        raise ValueError(f"the ellipsoid that Clarabel found is not invariant, by {-slack:.2g}")
    return found


def sample_ellipsoid(
    ellipsoid: Ellipsoid, count: int, rng: np.random.Generator, *, boundary: bool = False
) -> Array:
    """Random points of an ellipsoid, uniform in its volume, or on its boundary; (count, n)."""
    n = len(ellipsoid.P)
    directions = rng.normal(size=(count, n))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    if not boundary:
        directions *= rng.random((count, 1)) ** (1.0 / n)
    L = np.linalg.cholesky(ellipsoid.P / ellipsoid.level)
    return np.asarray(np.linalg.solve(L.T, directions.T).T)
