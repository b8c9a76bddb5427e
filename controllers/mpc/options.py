"""What the MPCs let choose, as frozen values; the comment of a field is its documentation everywhere."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from quad_envs.arguments.checks import require_choice, require_whole
from quad_envs.arguments.kinds import is_number, require_kinds
from quad_envs.arguments.names import shown, unknown_name
from quad_envs.limits import Limits

from ..controller import MOST_PASSES, require_horizon
from ..qp.solution import MOST_ITERATIONS
from ..qp.structured import ITERATION_LIMIT

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

SolverName = Literal["structured", "osqp"]
Frame = Literal["heading", "hover"]
VelocityReference = Literal["heading", "attitude"]
LevelReference = Literal["level", "heading", "attitude"]
PresentReference = Literal["present", "heading", "attitude"]
VelocityAxes = Literal["level", "present", "heading", "attitude"]
Objective = Literal["cost", "score"]
VelocityError = Literal["inertial", "body"]
TerminalWeight = Literal["hover", "sdre"]
PLAN_TILT = 0.8  # rad, of models linear in the attitude
PLAN_TURN = 0.3  # rad, of roll and pitch from sample to sample
EXACT_TILT = 1.0  # rad, of the exact model
FLOOR = 0.03  # of the weights of the score, and
LIMITED_FLOOR = 0.1  # where the state is limited: a plan that saves its score for later meets a wall there
MOST_THREADS = 1024
SOFT_WEIGHT = 25.0  # per SI unit: keeps the corridor's limits; from 30 on, 3 m outside walls, some flip


def require_alpha(alpha: float) -> None:
    """Check that alpha is a member of the family of factorisations, see `model.sdc_matrix`.

    Raises:
        ValueError: If it is not.
    """
    if not 0.0 <= alpha <= 1.0:
        raise ValueError(
            f"alpha must lie in [0, 1], got {shown(alpha)}; 1/2 is the dissertation's, 1 recommended"
        )


@dataclass(frozen=True, kw_only=True)  # without slots, so that options of several kinds can be combined
class FactorisationOptions:
    """Which of the state-dependent models a controller takes.

    Raises:
        ValueError: If there is no such one.
    """

    alpha: float = 1.0  # member of the family of factorisations, in [0, 1]; 1/2 is the dissertation's

    def __post_init__(self) -> None:
        require_kinds(self)
        require_alpha(self.alpha)


@dataclass(frozen=True, slots=True, kw_only=True)
class ProblemOptions:
    """What the optimal control problem of every MPC lets choose, of one vehicle or of a team.

    Raises:
        ValueError: If an option is not allowed.
    """

    horizon: int = 25  # N, samples
    soft_weight: float = SOFT_WEIGHT  # exact penalty per unit of a state row; inf makes the rows hard
    margin: float = (
        0.02  # what the plan keeps from each state limit, in its SI unit: for the unmodelled rotor lag
    )
    Q: ArrayLike | None = None  # weight of the state: number, diagonal (12,) or matrix; None: the reward's
    R: ArrayLike | None = None  # weight of the forces: number, diagonal (4,) or matrix; None: the reward's
    terminal: ArrayLike = 1.0  # factor of P, the weight of x_N, or a matrix (12, 12) in the problem's axes

    def __post_init__(self) -> None:
        require_kinds(self)
        require_horizon(self.horizon)
        if not self.soft_weight >= 0.0:
            raise ValueError(
                f"soft_weight must be >= 0 (math.inf for hard rows), got {shown(self.soft_weight)}"
            )
        if not 0.0 <= self.margin < math.inf:
            raise ValueError(
                f"margin must be a finite number >= 0, in SI units of each limit, got {shown(self.margin)}"
            )

    @property
    def own_terminal(self) -> bool:
        """Whether the terminal weight is not the one that makes the Riccati recursion stationary."""
        return np.ndim(self.terminal) > 0 or self.terminal != 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleMpcOptions(ProblemOptions):
    """What every MPC that decides for one vehicle lets choose, whether it flies alone or in a team."""

    R_rate: ArrayLike | None = (
        None  # weight of the changes of the forces from sample to sample, the first one against the command
        # applied before: number, diagonal (4,) or matrix; None: changes cost nothing
    )
    reject_disturbance: bool = False  # whether to estimate and cancel disturbances that are not revealed
    estimator_gain: float | Literal["auto"] = (
        "auto"  # share of each new residual in the estimate, in (0, 1];
        # "auto" takes it from `task.sensor_noise`, 0.5 without any
    )
    estimator_gain_scale: float = 1.0  # factor on the gain that "auto" takes; no gain exceeds 1
    disturbance_correlation_time: float = (
        math.inf  # s, in which a plan expects the estimated disturbance to fade to 1/e, 1 s for `Gusts`;
        # inf: it stays, and a steady one leaves no offset (offset-free MPC)
    )
    iteration_limit: int = ITERATION_LIMIT  # active-set steps of a solve at most; 0: one that grows with it

    def __post_init__(self) -> None:
        ProblemOptions.__post_init__(self)
        own = self.estimator_gain != "auto"
        if own and not (is_number(self.estimator_gain) and 0.0 < self.estimator_gain <= 1.0):
            raise ValueError(
                f"estimator_gain must be 'auto' or lie in (0, 1], got {shown(self.estimator_gain)}"
            )
        if not (is_number(self.estimator_gain_scale) and 0.0 < self.estimator_gain_scale < math.inf):
            raise ValueError(
                "estimator_gain_scale must be a finite number > 0, a factor on the gain that "
                f"estimator_gain='auto' takes, got {shown(self.estimator_gain_scale)}"
            )
        if own and self.estimator_gain_scale != 1.0:
            raise ValueError(
                f"estimator_gain_scale={self.estimator_gain_scale} scales what estimator_gain='auto' "
                f"takes, and estimator_gain is {self.estimator_gain}: give the product as estimator_gain, or "
                "leave that at 'auto'"
            )
        if not self.disturbance_correlation_time > 0.0:
            raise ValueError(
                "disturbance_correlation_time must be > 0 s (math.inf: the disturbance stays), got "
                f"{shown(self.disturbance_correlation_time)}"
            )
        require_whole(
            "iteration_limit (0: one that grows with the problem)", self.iteration_limit, 0, MOST_ITERATIONS
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class MpcOptions(VehicleMpcOptions):
    """What every MPC of a vehicle that flies alone lets choose."""

    solver: SolverName = "structured"  # exact in one compiled call, or "osqp"
    frame: Frame = "heading"  # axes of the problem; "hover" is the dissertation's, for yaw near 0
    plan_tilt: float | None = (
        None  # rad, largest roll and pitch of a plan besides the task's limit: where the
        # model holds; inf is no limit. None: 0.8 (exact model 1.0) in frame "heading", inf in "hover"
    )
    plan_rate: float | None = (
        None  # rad/s, largest roll and pitch rate of a plan, half of it in yaw, likewise. None: 0.3 rad
        # a sample in frame "heading", inf in "hover"
    )
    objective: Objective = (
        "cost"  # what a plan minimises: the sum of the stage costs l, or what the score loses by them,
        # l / (1 + l) of each stage, by weights 1 / (1 + l)^2 at the guess
    )
    floor: float | None = (
        None  # least weight of a stage over the largest one with objective="score", in (0, 1]: less score and
        # less cost the higher; 1 is the cost. None: 0.03, and 0.1 where the task limits the state
    )
    threads: int = (
        1  # threads that share the rows of a batch, more than one for many vehicles at once; decisions do not
        # depend on it. Of the solver "structured"
    )

    usual_tilt: ClassVar[float] = PLAN_TILT

    def __post_init__(self) -> None:
        VehicleMpcOptions.__post_init__(self)
        require_whole("threads", self.threads, 1, MOST_THREADS)
        require_choice("solver", self.solver, SolverName)
        require_choice("frame", self.frame, Frame)
        require_choice("objective", self.objective, Objective)
        if self.floor is not None and not 0.0 < self.floor <= 1.0:
            raise ValueError(
                f"floor must lie in (0, 1], got {shown(self.floor)}; 1 weighs all stages alike, which is the "
                "quadratic cost"
            )
        for name, unit in (("plan_tilt", "rad"), ("plan_rate", "rad/s")):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise ValueError(f"{name} must be > 0 {unit}, got {shown(value)}; math.inf is no limit")

    def largest_tilt(self) -> float:
        """The tilt that a plan keeps to, rad: as chosen, else the usual one, in frame "hover" none."""
        if self.plan_tilt is not None:
            return self.plan_tilt
        return self.usual_tilt if self.frame == "heading" else math.inf

    def least_weight(self, limits: Limits) -> float:
        """The floor of the weights of the score: as chosen, else the usual one under these limits."""
        if self.floor is not None:
            return float(self.floor)
        return LIMITED_FLOOR if np.isfinite(limits.state_box()).any() else FLOOR

    def largest_rate(self, dt: float) -> float:
        """The rate that a plan keeps to, rad/s: as chosen, else `PLAN_TURN` a sample; cf. `largest_tilt`."""
        if self.plan_rate is not None:
            return self.plan_rate
        return PLAN_TURN / dt if self.frame == "heading" else math.inf


@dataclass(frozen=True, slots=True, kw_only=True)
class LmpcOptions(MpcOptions):
    """What `LinearMPC` lets choose."""

    velocity_reference: LevelReference = (
        "level"  # what is compared with v_ref in frame "heading". "level": the velocity, turned by the
        # present attitude into the level axes of v_ref, which is the rate of the position, too.
        # "attitude": V_B, with v_ref turned into its axes; "heading": V_B, with v_ref as it is. Both move
        # positions by V_B: the longer the horizon, the more that costs
    )
    floor: float | None = 0.1  # as of `MpcOptions`; far stages are predicted worse here, and need weight

    def __post_init__(self) -> None:
        MpcOptions.__post_init__(self)
        require_choice("velocity_reference", self.velocity_reference, LevelReference)


@dataclass(frozen=True, slots=True, kw_only=True)
class SdcOptions(FactorisationOptions, MpcOptions):
    """What `SdcNmpc` lets choose."""

    relinearisations: int | Literal["auto"] = (
        "auto"  # further passes, each with the pairs along the plan of the pass before. "auto" makes one
        # where the plan turns by more than 0.5 rad, none in frame "hover"; 0 is the dissertation's
    )
    terminal_weight: TerminalWeight = "hover"  # P of the hover model, or "sdre": P of the present pair
    velocity_reference: PresentReference | None = (
        None  # what is compared with v_ref, in frame "heading". "present": the velocity in axes of the
        # present attitude, into which v_ref is turned. "heading", "attitude": V_B, which turns along the
        # plan, with v_ref turned by the present heading, or by the whole present attitude. None: "present",
        # or with another alpha than 1 "heading"
    )

    def __post_init__(self) -> None:
        FactorisationOptions.__post_init__(self)
        if not self.at_need:
            require_whole("relinearisations, if not 'auto',", self.relinearisations, 0, MOST_PASSES)
        require_choice("velocity_reference", self.axes(), PresentReference)
        if self.axes() == "present" and self.alpha != 1.0:
            raise ValueError(
                f"velocity_reference='present' leaves out -Omega x V_B, which alpha = {self.alpha!r} splits: "
                "take alpha=1, or 'heading' or 'attitude'"
            )
        require_choice("terminal_weight", self.terminal_weight, TerminalWeight)
        MpcOptions.__post_init__(self)
        if self.terminal_weight == "sdre" and self.own_terminal:
            raise ValueError(
                "terminal changes P of the hover model; terminal_weight='sdre' has another P at each sample: "
                "leave terminal out, or choose terminal_weight='hover'"
            )

    @property
    def at_need(self) -> bool:
        """Whether a further pass is made only where the plan needs it."""
        return isinstance(self.relinearisations, str) and self.relinearisations == "auto"

    def further_passes(self) -> int:
        """Passes after the first one, at most."""
        if self.at_need:
            return 1 if self.frame == "heading" else 0
        return int(self.relinearisations)

    def axes(self) -> PresentReference:
        """What is compared with v_ref."""
        if self.velocity_reference is not None:
            return self.velocity_reference
        return "present" if self.frame == "heading" and self.alpha == 1.0 else "heading"


@dataclass(frozen=True, slots=True, kw_only=True)
class NmpcOptions(MpcOptions):
    """What `ExactNmpc` lets choose."""

    passes: int = (
        1  # 1: real-time iteration, one QP per sample about the shifted solution; more: SQP until no input
        # changes by 1e-6 N, 30 is ample
    )
    velocity_error: VelocityError = (
        "inertial"  # V_B - R_BI(Theta) v_ref with the predicted attitude, as the reward has it; "body":
        # V_B - v_ref, v_ref turned by the present heading (frame "heading") or not (frame "hover")
    )

    usual_tilt: ClassVar[float] = EXACT_TILT

    def __post_init__(self) -> None:
        require_kinds(self)
        require_whole("passes", self.passes, 1, MOST_PASSES)
        require_choice("velocity_error", self.velocity_error, VelocityError)
        MpcOptions.__post_init__(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class ScoreNmpcOptions(NmpcOptions):
    """What `ScoreNmpc` lets choose."""

    objective: Objective = "score"  # what a plan minimises, as of `MpcOptions`


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetyOptions(NmpcOptions):
    """What `SafetyFilter` lets choose."""

    soft_weight: float = math.inf  # exact penalty per unit of a state row; inf: hard, soft where they must be
    weight: float = (
        50.0  # per N^2, of a change of the wanted command beside the weights of the MPC: the larger, the
        # later and the harder the filter intervenes
    )

    def __post_init__(self) -> None:
        NmpcOptions.__post_init__(self)
        if not 0.0 < self.weight < math.inf:
            raise ValueError(f"weight must be a finite number > 0, per N^2, got {shown(self.weight)}")
        if self.horizon < 2:
            raise ValueError(
                f"horizon of a safety filter must be at least 2 samples, got {self.horizon}: raise it, and "
                "the preview of the environment"
            )
        if self.objective != "cost":
            raise ValueError(
                f"a safety filter plans with objective='cost' alone, got {shown(self.objective)}: for a plan "
                "of the score, filter score-nmpc"
            )
        if self.solver != "structured":
            raise ValueError(f"a safety filter has solver='structured' alone, got {shown(self.solver)}")
        if self.threads != 1:
            raise ValueError(
                f"a safety filter decides in one thread, got threads={self.threads}: leave it out"
            )
        if self.R_rate is not None:
            raise ValueError(
                "R_rate weighs changes of the command, which a safety filter leaves to whom it filters: "
                "leave it out"
            )


_Options = TypeVar("_Options", bound="DataclassInstance")


def chosen(kind: type[_Options], options: _Options | None, changes: Mapping[str, Any]) -> _Options:
    """Options of a controller: those given, or the defaults, with the fields that keywords change.

    Raises:
        TypeError: If the options are of another kind, or it has no such field; names the nearest one.
        ValueError: If a value is not allowed.
    """
    known = [field.name for field in fields(kind)]
    if options is not None and not isinstance(options, kind):
        raise TypeError(
            f"options must be {kind.__name__}, got {shown(options)}; "
            f"single ones are keywords, as {known[0]}=..."
        )
    for name in changes:
        if name not in known:
            raise TypeError(unknown_name(f"field of {kind.__name__}:", name, known))
    return kind(**changes) if options is None else replace(options, **changes)


def shared(kind: type[_Options], options: DataclassInstance, **others: Any) -> _Options:
    """Options of another kind: its fields that these have, too, and others; the rest by default."""
    own, known = {field.name for field in fields(options)}, [field.name for field in fields(kind)]
    return kind(**{name: getattr(options, name) for name in known if name in own} | others)
