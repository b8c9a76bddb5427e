"""Estimation of a target by several vehicles: filters, trilateration, fusion, consistency (chapter 6).

The filters are pure functions on small tuples, batched over vehicles; `ekf` and `polar_ekf` name them alike.
"""

from . import consistency, ekf, polar_ekf
from .ekf import Innovation, Restart, TargetFilter
from .fusion import Fused, covariance_intersection, fuse_reference
from .fusion_kernels import CI_WEIGHTS
from .kalman import KalmanUpdate, kalman_update
from .protocol import Estimator, Measurements, Prior
from .target_models import PolarEstimator, RandomWalkEstimator
from .trilateration import Fix, Reason, trilaterate

__all__ = [
    "CI_WEIGHTS",
    "Estimator",
    "Fix",
    "Fused",
    "Innovation",
    "KalmanUpdate",
    "Measurements",
    "PolarEstimator",
    "Prior",
    "RandomWalkEstimator",
    "Reason",
    "Restart",
    "TargetFilter",
    "consistency",
    "covariance_intersection",
    "ekf",
    "fuse_reference",
    "kalman_update",
    "polar_ekf",
    "trilaterate",
]
