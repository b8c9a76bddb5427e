"""Estimation of a target by several vehicles: filters, trilateration, fusion, consistency (chapter 6).

The filters are pure functions on small tuples, batched over vehicles; `ekf` and `polar_ekf` name them alike.
"""

from . import consistency, ekf, polar_ekf
from .ekf import Innovation, TargetFilter
from .fusion import Fused, covariance_intersection, fuse_reference
from .fusion_kernels import CI_WEIGHTS
from .kalman import KalmanUpdate, kalman_update
from .trilateration import Fix, Reason, trilaterate

__all__ = [
    "CI_WEIGHTS",
    "Fix",
    "Fused",
    "Innovation",
    "KalmanUpdate",
    "Reason",
    "TargetFilter",
    "consistency",
    "covariance_intersection",
    "ekf",
    "fuse_reference",
    "kalman_update",
    "polar_ekf",
    "trilaterate",
]
