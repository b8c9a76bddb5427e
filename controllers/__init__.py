"""Control of a vehicle and of teams: linear, state-dependent and exact MPC, feedback laws, and solvers."""

from quad_envs.lazy import public_names

from .collision import AvoidanceOptions
from .consensus import ConsensusOptions, TargetEstimate, consensus_reference
from .controller import Controller, Decision
from .cooperative_mpc import CooperativeDecision, CooperativeMpc
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
    "AvoidanceOptions",
    "ConsensusOptions",
    "Controller",
    "CooperativeDecision",
    "CooperativeMpc",
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
    "TargetEstimate",
    "consensus_reference",
    "dare",
    "hover_pair",
    "lqr_gain",
    "sdc_pair",
]


def __dir__() -> list[str]:
    return public_names(globals(), "estimation", "solvers")
