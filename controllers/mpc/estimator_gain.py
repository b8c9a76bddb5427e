"""Gain of the disturbance estimator from the noise of the sensors: the best steady one for its structure.

The estimator of `disturbance` corrects each of its six numbers by a share L of what a one-step prediction did
not explain. Per channel, a disturbance that wanders with variance q per sample leaves an error of variance
q / (L (2 - L)). Noise of the measured velocity enters as a difference of two samples, which makes
2 rho L^2 / (2 - L) of a residual variance 2 rho; noise of the measured attitude tilts the predicted thrust
and enters white, L w / (2 - L). The gain minimises the sum, in which noise counts JITTER times: an estimate
that lags leaves an error for the feedback, one that jitters goes straight to the rotors.
"""

from __future__ import annotations

import numpy as np

from quad_envs.disturbances import Gusts
from quad_envs.parameters import Array
from quad_envs.tasks import BaseTask

from ..disturbance import ESTIMATOR_GAIN, N_DISTURBANCE

JITTER = (
    30.0  # scores on the helix with noise, gusts, other parameters are flat from 10 to 100, lower outside
)
_GAINS = np.geomspace(1e-3, ESTIMATOR_GAIN, 400)  # above it, what the model leaves out passes on


def error_variance(gain: Array, wander: float, differenced: float, white: float) -> Array:
    """Steady variance of an estimate.

    Args:
        gain: L, share of each residual, in (0, 1], any shape.
        wander: q, variance that the disturbance gains in a sample.
        differenced: rho, variance that the noise of one velocity sample has in the residual.
        white: w, variance that the noise of the attitude has in the residual.

    Returns:
        Of the shape of `gain`.
    """
    return (wander / gain + 2.0 * differenced * gain * gain + white * gain) / (2.0 - gain)


def estimator_gains(task: BaseTask) -> Array:
    """Gain of each channel, torque about body axes and force along inertial axes, (6,).

    The disturbance is taken to wander as the gusts of `disturbance="gusts"` do. Without noise the gain is
    ESTIMATOR_GAIN, which the dissertation's torque pulse needs.
    """
    _, velocity, attitude, rates = task.sensor_noise
    if velocity == attitude == rates == 0.0:
        return np.full(N_DISTURBANCE, ESTIMATOR_GAIN)
    params, gusts = task.params, Gusts().for_vehicle(task.params, task.limits)
    wander = 2.0 * task.dt / gusts.correlation_time * gusts.size() ** 2
    inertia = np.array([*params.inertia, *(params.mass,) * 3])
    noise = np.array([rates] * 3 + [velocity] * 3)
    differenced = (noise * inertia / task.dt) ** 2
    white = np.array([0.0, 0.0, 0.0, params.weight * attitude, params.weight * attitude, 0.0]) ** 2
    channels = zip(wander, JITTER * differenced, JITTER * white, strict=True)
    return np.asarray(_GAINS[np.argmin([error_variance(_GAINS, *channel) for channel in channels], axis=1)])
