"""What the feedback laws let choose, as frozen values; cf. `mpc.options`."""

from __future__ import annotations

import math
from dataclasses import dataclass

from quad_envs.arguments.checks import require_choice
from quad_envs.arguments.names import shown

from ..mpc.options import FactorisationOptions, Frame, VelocityReference


@dataclass(frozen=True, slots=True, kw_only=True)
class StateFeedbackOptions:
    """What every feedback of the error of the state lets choose.

    Raises:
        ValueError: If an option is not allowed.
    """

    frame: Frame = "heading"  # axes of the errors; "hover" is the dissertation's, for yaw near 0
    velocity_reference: VelocityReference  # axes of V_B for v_ref: turned by the heading, or by the attitude

    def __post_init__(self) -> None:
        require_choice("frame", self.frame, Frame)
        require_choice("velocity_reference", self.velocity_reference, VelocityReference)


@dataclass(frozen=True, slots=True, kw_only=True)
class LqrOptions(StateFeedbackOptions):
    """What `Lqr` lets choose."""

    velocity_reference: VelocityReference = (
        "attitude"  # V_B is compared with v_ref turned by the present attitude, or "heading": by the heading
        # alone, which costs up to 3 times more
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class SdreOptions(FactorisationOptions, StateFeedbackOptions):
    """What `Sdre` lets choose."""

    velocity_reference: VelocityReference = (
        "heading"  # V_B is compared with v_ref turned by the present heading, or "attitude": by the attitude
    )

    def __post_init__(self) -> None:
        FactorisationOptions.__post_init__(self)
        StateFeedbackOptions.__post_init__(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class FeedbackLinearizationOptions:
    """What `FeedbackLinearization` lets choose.

    Raises:
        ValueError: If a gain is not positive and finite, or the frame is unknown.
    """

    kp: float = 2.0  # 1/s^2, position gain
    kd: float = 2.5  # 1/s, velocity gain
    ka: float = 36.0  # 1/s^2, attitude gain
    kad: float = 11.0  # 1/s, rate gain
    acceleration_feed_forward: bool = (
        True  # whether to add the acceleration of the reference, by differences of v_ref, where the window
        # has two rows
    )
    frame: Frame = "heading"  # "hover": as in the text, (u_1, u_2) are not turned and the yaw not wrapped

    def __post_init__(self) -> None:
        require_choice("frame", self.frame, Frame)
        for name in ("kp", "kd", "ka", "kad"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be a finite number > 0, got {shown(value)}")
