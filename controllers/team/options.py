"""What the MPCs of teams let choose, as frozen values: those of one vehicle, of consensus, of separation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from quad_envs.arguments.checks import require_choice, require_whole
from quad_envs.arguments.names import shown

from ..mpc.options import FactorisationOptions, ProblemOptions, VehicleMpcOptions
from ..qp.solution import MOST_ITERATIONS
from .collision import AvoidanceOptions, SeparationOptions
from .consensus import ConsensusOptions, NeighbourOptions

CooperativeTerminalWeight = Literal["hover", "stage"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FormationMpcOptions(FactorisationOptions, NeighbourOptions, AvoidanceOptions, VehicleMpcOptions):
    """What the MPC of each vehicle of a formation lets choose.

    Raises:
        ValueError: If an option is not allowed.
    """

    horizon: int = 5
    soft_weight: float = 1e3
    terminal_weight: CooperativeTerminalWeight = (
        "hover"  # P solves the Riccati equation of hover; "stage": it is Q, with which a formation never
        # closes
    )
    plan_tilt: float = (
        0.5  # rad, largest roll and pitch of a plan besides the task's limit; inf for none. Rows that push a
        # vehicle upside down push it to where its model holds no longer. With alpha = 1/2 vehicles that meet
        # at 2 m/s each need 0.7
    )
    turning: bool = (
        True  # whether predicted positions follow the velocity as the predicted attitude turns it; the
        # dissertation's keep the present R_BI
    )

    def __post_init__(self) -> None:
        VehicleMpcOptions.__post_init__(self)
        FactorisationOptions.__post_init__(self)
        NeighbourOptions.__post_init__(self)
        AvoidanceOptions.__post_init__(self)
        require_choice("terminal_weight", self.terminal_weight, CooperativeTerminalWeight)
        if not self.plan_tilt > 0.0:
            raise ValueError(f"plan_tilt must be > 0 rad, got {shown(self.plan_tilt)}; math.inf is no limit")
        if self.terminal_weight == "stage" and self.own_terminal:
            raise ValueError(
                "terminal changes P of the hover model; terminal_weight='stage' has Q in its place: "
                "leave terminal out, or choose terminal_weight='hover'"
            )

    @property
    def fastest(self) -> float:
        """The governor's speed, m/s."""
        return self.speed


@dataclass(frozen=True, slots=True, kw_only=True)
class CooperativeOptions(FormationMpcOptions, ConsensusOptions):
    """What `CooperativeMpc` lets choose: a formation that may have a target."""

    def __post_init__(self) -> None:
        FormationMpcOptions.__post_init__(self)
        ConsensusOptions.__post_init__(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class CentralOptions(FactorisationOptions, SeparationOptions, ProblemOptions):
    """What `CentralMpc` lets choose.

    Raises:
        ValueError: If an option is not allowed.
    """

    horizon: int = 5
    soft_weight: float = 1e3
    braking_time: float | None = 0.25
    separation_weight: float = 1e4
    eps: float = 1e-6  # OSQP's absolute and relative tolerance
    max_iter: int = 20000  # OSQP's iteration limit

    def __post_init__(self) -> None:
        ProblemOptions.__post_init__(self)
        FactorisationOptions.__post_init__(self)
        SeparationOptions.__post_init__(self)
        require_whole("max_iter", self.max_iter, 1, MOST_ITERATIONS)
        if not (self.eps > 0.0 and math.isfinite(self.soft_weight) and math.isfinite(self.separation_weight)):
            raise ValueError(
                f"eps must be > 0 and the weights finite, got {self.eps!r}, {self.soft_weight!r}, "
                f"{self.separation_weight!r}"
            )
