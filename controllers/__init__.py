"""Control of a vehicle and of teams: linear, state-dependent and exact MPC, feedback laws, and solvers."""

import sys

from quad_envs.lazy import public_names

from . import qp
from .controller import Controller, Decision
from .fallback import Fallback
from .feedback.feedback_linearization import FeedbackLinearization
from .feedback.sdre import Lqr, Sdre
from .model import hover_pair, sdc_pair
from .mpc.exact import ExactNmpc
from .mpc.lmpc import LinearMPC
from .mpc.options import LmpcOptions, NmpcOptions, SdcOptions
from .mpc.sdc import SdcNmpc
from .qp import ocp, riccati
from .qp.ocp import OcpQp, StateRows
from .qp.riccati import dare, lqr_gain
from .team.collision import AvoidanceOptions
from .team.consensus import ConsensusOptions, TargetEstimate, consensus_reference
from .team.cooperative import CooperativeDecision, CooperativeMpc

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
    "LmpcOptions",
    "Lqr",
    "NmpcOptions",
    "OcpQp",
    "SdcNmpc",
    "SdcOptions",
    "Sdre",
    "StateRows",
    "TargetEstimate",
    "consensus_reference",
    "dare",
    "hover_pair",
    "lqr_gain",
    "sdc_pair",
]


# Modules that others import by their paths of before: the solvers, the data and the equations of the OCP-QP.
solvers = qp
for _path, _module in {"solvers": solvers, "ocp": ocp, "riccati": riccati}.items():
    sys.modules[f"{__name__}.{_path}"] = _module


def __dir__() -> list[str]:
    return public_names(globals(), "estimation", "qp")
