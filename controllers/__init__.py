"""Control of one vehicle: linear, state-dependent and exact MPC, feedback laws, and their solvers."""

from .controller import Controller, Decision
from .fallback import Fallback
from .feedback_linearization import FeedbackLinearization
from .lmpc import LinearMPC
from .model import hover_pair, sdc_pair
from .nmpc import ExactNmpc
from .ocp import OcpQp, StateRows
from .riccati import dare, lqr_gain
from .sdc_nmpc import SdcNmpc
from .sdre import Lqr, Sdre

__all__ = [
    "Controller",
    "Decision",
    "ExactNmpc",
    "Fallback",
    "FeedbackLinearization",
    "LinearMPC",
    "Lqr",
    "OcpQp",
    "SdcNmpc",
    "Sdre",
    "StateRows",
    "dare",
    "hover_pair",
    "lqr_gain",
    "sdc_pair",
]
