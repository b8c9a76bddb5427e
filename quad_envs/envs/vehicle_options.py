"""What every environment lets choose about its vehicles: parameters, limits, weights, uncertainty, time."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, TypeVar

import numpy as np

from ..disturbances import Disturbance, DisturbanceLike, beyond_authority, disturbance_of
from ..kinds import as_tuple, is_number
from ..names import shown, suggestion
from ..parameters import N_INPUT, N_STATE, Limits, QuadrotorParams, Weights
from ..references import Reference, in_episode, length_of, make_reference, mismatch
from ..registration import DT, TIME_LIMIT
from ..vehicles import vehicle_values

# Arguments that are one number; what it may be is checked where it is used.
_NUMBERS = (
    *("mass", "gravity", "arm", "yaw_moment", "rotor_rate", "drag", "rate_limit", "tilt_limit"),
    *("velocity_limit", "dt", "time_limit"),
)
_MOST_STEPS = 1_000_000  # control periods of an episode; its tables are made at reset
RANDOMIZABLE = ("mass", "inertia", "arm", "kappa", "rotor_rate", "drag")
CRASH_TILT = math.radians(85.0)  # rad; the Euler rates are singular at 90 degrees
Triple = tuple[float, float, float]
Options = TypeVar("Options", bound="VehicleOptions")


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleOptions:
    """The arguments that all environments share. `TrackingEnv` documents each."""

    kind: ClassVar[str] = ""  # of environment, for messages

    env_id: str = ""
    vehicle: str = "dissertation"
    mass: float = 0.8
    gravity: float = 9.8
    inertia: Triple = (0.0224, 0.0224, 0.0436)
    arm: float = 0.165
    yaw_moment: float = 0.002167
    rotor_rate: float = 50.0
    drag: float = 0.0
    frame: str = "plus"
    kappa: float | tuple[float, float, float, float] = 1.0
    rate_limit: float = math.inf
    tilt_limit: float = math.inf
    velocity_limit: float = math.inf
    position_limit: tuple[Triple, Triple] | None = None
    Q: float | tuple[float, ...] = 1.0
    R: float | tuple[float, ...] = 1.0
    disturbance: DisturbanceLike = None
    reveal_disturbance: bool = False
    sensor_noise: float | tuple[float, float, float, float] = 0.0
    randomize: float | Mapping[str, float] = 0.0
    dt: float = DT
    substeps: int = 5
    time_limit: float = TIME_LIMIT
    reward: str = "bounded"

    def __post_init__(self) -> None:
        for name in _NUMBERS:
            if not isinstance(getattr(self, name), int | float | np.integer | np.floating):
                raise ValueError(f"{name} must be a number, got {shown(getattr(self, name))}")
        vehicle_values(self.vehicle)
        for name in ("dt", "time_limit"):
            self.require_positive(name)
        steps = self.time_limit / self.dt
        if not 1.0 <= steps <= _MOST_STEPS or abs(steps - round(steps)) > 1e-6 * steps:
            raise ValueError(
                f"time_limit must be 1 to {_MOST_STEPS} whole control periods of dt = {self.dt} s, "
                f"got {self.time_limit!r} s"
            )
        if not isinstance(self.reveal_disturbance, bool | np.bool_):
            raise ValueError(f"reveal_disturbance must be True or False, got {self.reveal_disturbance!r}")
        rotors = self.kappa if isinstance(self.kappa, tuple) else (self.kappa,) * N_INPUT
        if len(rotors) != N_INPUT or not all(map(is_number, rotors)):
            raise ValueError(
                f"kappa must be a number or {N_INPUT} of them, one per rotor, got {self.kappa!r}"
            )
        if not _is_vector(self.inertia):
            raise ValueError(f"inertia must be three numbers (Jx, Jy, Jz), got {self.inertia!r}")
        if self.position_limit is not None and not (
            isinstance(self.position_limit, tuple)
            and len(self.position_limit) == 2
            and all(map(_is_vector, self.position_limit))
        ):
            raise ValueError(
                "position_limit must be None or ((x, y, z) lower, (x, y, z) upper), "
                f"got {self.position_limit!r}"
            )
        self.require_whole("substeps", 1)
        if self.reward not in ("bounded", "quadratic"):
            raise ValueError(f"reward must be 'bounded' or 'quadratic', got {self.reward!r}")
        # Build what can be built, so that a bad value is refused here and not at the first reset.
        self.make_limits()
        self.randomization()
        self.noise_deviations()
        excess = beyond_authority(self.make_disturbance(), self.make_params(), self.make_limits())
        if excess:
            warnings.warn(excess, stacklevel=2)

    def take_time_limit(self, what: object) -> Reference:
        """The reference, from which a time limit of "reference" follows.

        Raises:
            ValueError: If it is no reference, or has no end.
        """
        made = make_reference(what)
        if isinstance(self.time_limit, str) and self.time_limit == "reference":
            self.require_positive("dt")
            object.__setattr__(self, "time_limit", length_of(made, self.dt))
        for name in ("dt", "time_limit"):
            self.require_positive(name)
        return made

    def within_episode(self, trajectory: Any) -> Any:
        """A reference or target as it is in these episodes; a warning says if it does not fit them."""
        fitted = in_episode(trajectory, self.dt, self.time_limit)
        said = mismatch(fitted, self.dt, self.time_limit)
        if said:
            warnings.warn(said, stacklevel=2)
        return fitted

    def require_positive(self, name: str) -> None:
        """Check that a field is a finite number > 0.

        Raises:
            ValueError: If it is not.
        """
        value = getattr(self, name)
        if not (is_number(value) and value > 0.0):
            raise ValueError(f"{name} must be a finite number > 0, got {value!r}")

    def require_whole(self, name: str, least: int, most: float = math.inf) -> None:
        """Check that a field is a whole number in a range.

        Raises:
            ValueError: If it is not.
        """
        value = getattr(self, name)
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or not least <= value <= most:
            allowed = f">= {least}" if most == math.inf else f"from {least} to {most}"
            raise ValueError(f"{name} must be an integer {allowed}, got {value!r}")

    @classmethod
    def from_kwargs(cls: type[Options], kwargs: Mapping[str, Any]) -> Options:
        """Options from keyword arguments; they override those of a named vehicle.

        Raises:
            TypeError: If a name is unknown; the message suggests the nearest one.
            ValueError: If a value is not allowed, or there is no such vehicle.
        """
        known = [entry.name for entry in fields(cls) if entry.init]
        for name in kwargs:
            if name not in known:
                known.remove("env_id")
                # Python's own words first: TorchRL's GymEnv tries `frameskip` and looks for them.
                hint = suggestion(name, known)
                raise TypeError(f"unexpected keyword argument {name!r} of {cls.kind} environment; {hint}")
        named = vehicle_values(kwargs["vehicle"]) if "vehicle" in kwargs else {}
        values = named | {name: as_tuple(value) for name, value in kwargs.items()}
        return cls(**cls.that_follow(values) | values)

    @classmethod
    def that_follow(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        """Defaults that follow from other values; here none do."""
        return {}

    @property
    def episode_steps(self) -> int:
        """Control periods of an episode."""
        return round(self.time_limit / self.dt)

    def make_limits(self) -> Limits:
        """The limits that are set."""
        lower, upper = self.position_limit or ((-math.inf,) * 3, (math.inf,) * 3)
        return Limits(
            kappa=self.kappa,
            rate=self.rate_limit,
            tilt=self.tilt_limit,
            velocity=self.velocity_limit,
            position_lower=lower,
            position_upper=upper,
        )

    def make_params(self) -> QuadrotorParams:
        """The nominal vehicle."""
        return QuadrotorParams(
            mass=self.mass,
            gravity=self.gravity,
            inertia=self.inertia,
            arm=self.arm,
            yaw_moment=self.yaw_moment,
            rotor_rate=self.rotor_rate,
            drag=self.drag,
            frame=self.frame,
        )

    def make_disturbance(self) -> Disturbance | None:
        """The disturbance; gusts without numbers follow the nominal vehicle."""
        return disturbance_of(self.disturbance, self.make_params(), self.make_limits())

    def task_fields(self) -> dict[str, Any]:
        """What each kind of Task has of these options."""
        return {
            "env_id": self.env_id,
            "params": self.make_params(),
            "limits": self.make_limits(),
            "weights": Weights(Q=spread("Q", self.Q, N_STATE), R=spread("R", self.R, 4)),
            "dt": self.dt,
            "episode_steps": self.episode_steps,
            "sensor_noise": self.noise_deviations(),
            "reward": self.reward,
        }

    def noise_deviations(self) -> tuple[float, float, float, float]:
        """Standard deviations of measured position, velocity, attitude and rates; one number is for all."""
        values = spread("sensor_noise", self.sensor_noise, 4)
        if not all(value >= 0.0 for value in values):
            raise ValueError(f"sensor_noise must be >= 0, got {self.sensor_noise!r}")
        return values[0], values[1], values[2], values[3]

    def randomization(self) -> dict[str, float]:
        """Parameter -> largest relative change of it at reset, only those that vary."""
        if isinstance(self.randomize, Mapping):
            ranges = dict(self.randomize)
        else:
            ranges = {name: self.randomize for name in RANDOMIZABLE if name != "drag" or self.drag > 0.0}
        for name, value in ranges.items():
            if name not in RANDOMIZABLE:
                raise ValueError(f"randomize knows {', '.join(RANDOMIZABLE)}; got {name!r}")
            if not (is_number(value) and 0.0 <= value < 1.0):
                raise ValueError(f"randomize[{name!r}] is a relative spread in [0, 1), got {value!r}")
            if name == "drag" and value > 0.0 and self.drag == 0.0:
                raise ValueError(
                    "randomize['drag'] varies the drag in proportion: give the env a drag > 0 first"
                )
        weakest = min(self.make_limits().kappas) * (1.0 - ranges.get("kappa", 0.0))
        if weakest <= 0.25 * (1.0 + ranges.get("mass", 0.0)):
            raise ValueError(
                f"randomize={self.randomize!r} would draw rotors too weak to hover at kappa = {self.kappa}"
            )
        return {name: float(value) for name, value in ranges.items() if value > 0.0}


def _is_vector(value: object) -> bool:
    """Whether it is three numbers, possibly infinite."""
    return (
        isinstance(value, tuple)
        and len(value) == 3
        and all(isinstance(entry, int | float | np.integer | np.floating) for entry in value)
    )


def spread(name: str, value: float | tuple[float, ...], length: int) -> tuple[float, ...]:
    """A number for all entries, or one per entry.

    Raises:
        ValueError: If it is neither.
    """
    values = value if isinstance(value, tuple) else (value,) * length
    if len(values) != length or not all(map(is_number, values)):
        raise ValueError(f"{name} must be one finite number or {length} of them, got {value!r}")
    return tuple(float(entry) for entry in values)
