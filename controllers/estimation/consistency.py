"""Whether a filter is as sure of itself as it may be, and how good any filter could be."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from quad_envs.parameters import Array
from quad_envs.sensors import N_MEASUREMENT, first_row, jacobian, row_count


def nees(error: ArrayLike, P: ArrayLike) -> Array:
    """Normalised error squared e' P^-1 e: chi^2 with d degrees of freedom for a consistent filter.

    Args:
        error: Estimate minus truth, (..., d).
        P: Its covariance according to the filter, (..., d, d).

    Returns:
        (...).
    """
    e = np.asarray(error, dtype=np.float64)
    solved = np.linalg.solve(np.asarray(P, dtype=np.float64), e[..., None])[..., 0]
    return np.asarray((e * solved).sum(axis=-1))


def anees(error: ArrayLike, P: ArrayLike) -> float:
    """Mean of `nees` over all samples, divided by d: 1 for a consistent filter, more where it is too sure."""
    return float(nees(error, P).mean() / np.shape(error)[-1])


def chi2_quantile(probability: float, degrees: int) -> float:
    """The value that chi^2 with so many degrees of freedom stays below with this probability."""
    return float(chdtri(degrees, 1.0 - probability))


def chi2_bounds(probability: float, degrees: int, samples: int) -> tuple[float, float]:
    """Where the mean of independent chi^2 samples, divided by the degrees, lies with this probability.

    Args:
        probability: Of the two-sided interval, such as 0.95.
        degrees: Degrees of freedom of each sample.
        samples: Independent samples; the steps of one run are not.

    Returns:
        Lower and upper bound, around 1.
    """
    tail, total = (1.0 - probability) / 2.0, degrees * samples
    return chi2_quantile(tail, total) / total, chi2_quantile(1.0 - tail, total) / total


def information(d: ArrayLike, sigma: ArrayLike, rows: int, held: ArrayLike | None = None) -> Array:
    """H' R^-1 H of a step's measurements at the true target, padded to the state [r_t; v_t].

    Args:
        d: True r_t - p_j of each measurement, (..., m, 3), m.
        sigma: Standard deviations of range, azimuth, elevation, (3,).
        rows: Which entries count, see `quad_envs.sensors.sensor_rows`.
        held: Which measurements count, (..., m), bool; None: all.

    Returns:
        (..., 6, 6).
    """
    read = slice(first_row(rows), first_row(rows) + row_count(rows))
    H = jacobian(d)[..., read, :] / np.asarray(sigma, dtype=np.float64)[read, None]
    if held is not None:
        H = np.where(np.asarray(held, dtype=np.bool_)[..., None, None], H, 0.0)
    out = np.zeros((*H.shape[:-3], 6, 6))
    out[..., :N_MEASUREMENT, :N_MEASUREMENT] = np.einsum("...mri,...mrj->...ij", H, H)
    return out


def covariance_bound(F: Array, Q: Array, P_0: Array, gained: ArrayLike) -> Array:
    """Smallest covariances J_k^-1 for linear motion: J_k = (Q + F J_{k-1}^-1 F')^-1 + I_k, J_0 = P_0^-1.

    With I_k averaged over trajectories this is the posterior Cramer-Rao bound, which is loose where the
    direction that cannot be observed differs between runs. With I_k of every trajectory, and the results
    averaged, it is the mean of the covariance recursion run at the truth: a better yardstick there.

    Args:
        F: Transition, (d, d).
        Q: Noise of the motion, (d, d).
        P_0: Covariance before the first step, (d, d).
        gained: I_k = H' R^-1 H of each step, (steps, ..., d, d).

    Returns:
        (steps, ..., d, d). The root of the trace of a position block bounds the position RMSE.
    """
    steps = np.asarray(gained, dtype=np.float64)
    out = np.empty_like(steps)
    P = np.broadcast_to(P_0, steps.shape[1:])
    identity = np.eye(steps.shape[-1])
    for k, gain in enumerate(steps):
        prior = F @ P @ F.T + Q
        P = np.linalg.solve(identity + prior @ gain, prior)  # (prior^-1 + I_k)^-1
        P = 0.5 * (P + np.swapaxes(P, -1, -2))
        out[k] = P
    return out
