"""What every environment lets choose about its vehicles: parameters, limits, weights, uncertainty, time."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, TypeVar

import numpy as np

from ...arguments.checks import Bound, array_bytes, require_number, require_whole
from ...arguments.kinds import as_tuple, is_number
from ...arguments.names import shown, suggestion
from ...disturbances import Disturbance, DisturbanceLike, beyond_authority, disturbance_of
from ...limits import LimitOptions
from ...parameters import N_STATE, Array, QuadrotorParams, Weights
from ...references import Reference, in_episode, length_of, make_reference, mismatch
from ...registration import DT, TIME_LIMIT
from ...vehicles import vehicle_values

MOST_STEPS = 1_000_000  # control periods of an episode; its tables are made at reset
_MOST_SUBSTEPS = 1000
MOST_PREVIEW = 10_000  # stages
_PERIOD = Bound(1e-5, 1.0, "s", "slower, no controller holds a quadrotor; faster, times are rounding")
POSITIVE = Bound(open=True)
NOISE = Bound(0.0, 1e3, "m, m/s, rad or rad/s", "beyond, a measurement says nothing of the vehicle")
_RK4_REAL = 2.5  # |h lambda| up to which RK4 follows a decay; its limit is 2.785
RANDOMIZABLE = ("mass", "inertia", "arm", "kappa", "rotor_rate", "drag")
CRASH_TILT = math.radians(85.0)  # rad; the Euler rates are singular at 90 degrees
Triple = tuple[float, float, float]
Options = TypeVar("Options", bound="VehicleOptions")


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleOptions(LimitOptions):
    """The arguments that all environments share. `TrackingEnv` documents each."""

    kind: ClassVar[str] = ""  # of environment, for messages

    env_id: str = ""
    vehicle: str = "dissertation"  # a name of `quad-envs list`; arguments go before its values
    mass: float = 0.8  # kg
    gravity: float = 9.8  # m/s^2
    inertia: Triple = (0.0224, 0.0224, 0.0436)  # kg m^2, principal moments
    arm: float = 0.165  # m
    yaw_moment: float = 0.002167  # m, yaw torque of a rotor per N of its force
    rotor_rate: float = 50.0  # 1/s, inverse of the time constant of the rotors
    drag: float = 0.0  # kg/s
    frame: str = "plus"  # "plus" or "x"
    Q: float | tuple[float, ...] = 1.0  # weights of the state in the reward: a number or 12
    R: float | tuple[float, ...] = 1.0  # weights of the forces in the reward: a number or 4
    disturbance: DisturbanceLike = None  # a name, as "gusts", a force (x, y, z) in N, or a function of time
    reveal_disturbance: bool = False  # whether its mean over the coming period is observed
    sensor_noise: float | tuple[float, float, float, float] = 0.0  # sigma: m, m/s, rad, rad/s; or one
    randomize: float | Mapping[str, float] = 0.0  # relative spread at each reset, of each or of all
    dt: float = DT  # s, control period
    substeps: int = 5  # of the integrator in a control period
    time_limit: float = TIME_LIMIT  # s, or "reference": as long as that is given
    reward: str = "bounded"  # "bounded", from 0 to 1 a step, or "quadratic"

    def __post_init__(self) -> None:
        vehicle_values(self.vehicle)
        self.require_times()
        steps = self.time_limit / self.dt
        if not 1.0 <= steps <= MOST_STEPS or abs(steps - round(steps)) > 1e-6 * steps:
            raise ValueError(
                f"time_limit must be 1 to {MOST_STEPS} whole control periods of dt = {self.dt} s, "
                f"got {shown(self.time_limit)} s"
            )
        if not isinstance(self.reveal_disturbance, bool | np.bool_):
            raise ValueError(
                f"reveal_disturbance must be True or False, got {shown(self.reveal_disturbance)}"
            )
        self.require_limits()
        steps = self.episode_steps
        self.require_whole("substeps", 1, _MOST_SUBSTEPS, lambda n: array_bytes((steps, 2 * n + 1, 7)))
        if self.reward not in ("bounded", "quadratic"):
            raise ValueError(f"reward must be 'bounded' or 'quadratic', got {shown(self.reward)}")
        # Build what can be built, so that a bad value is refused here and not at the first reset.
        self.make_limits()
        self.make_params()
        self._require_followed_drag(self.randomization())
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
            require_number("dt", self.dt, _PERIOD)
            object.__setattr__(self, "time_limit", length_of(made, self.dt))
        self.require_times()
        return made

    def require_times(self) -> None:
        """Check the control period and the time limit.

        Raises:
            ValueError: If one is not allowed.
        """
        require_number("dt", self.dt, _PERIOD)
        self.require_positive("time_limit")

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
        require_number(name, getattr(self, name), POSITIVE)

    def require_whole(
        self, name: str, least: int, most: int, memory: Callable[[int], float] | None = None
    ) -> None:
        """Check that a field is a whole number in a range, see `checks.require_whole`.

        Raises:
            ValueError: If it is not.
        """
        require_whole(name, getattr(self, name), least, most, memory)

    def _require_followed_drag(self, ranges: Mapping[str, float]) -> None:
        """Refuse a drag that brakes the lightest vehicle faster than the integrator can follow."""
        h = self.dt / self.substeps
        most = _RK4_REAL / h * self.mass * (1.0 - ranges.get("mass", 0.0)) / (1.0 + ranges.get("drag", 0.0))
        if self.drag > most:
            raise ValueError(
                f"drag must be at most {most:.3g} kg/s, got {shown(self.drag)}: it brakes {self.mass:g} kg "
                f"within {self.mass / self.drag:.1e} s, which steps of {h:g} s cannot follow; lower it, or "
                "raise substeps"
            )

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
        for value in values:
            require_number("sensor_noise", value, NOISE)
        return values[0], values[1], values[2], values[3]

    def randomization(self) -> dict[str, float]:
        """Parameter -> largest relative change of it at reset, only those that vary."""
        if isinstance(self.randomize, Mapping):
            ranges = dict(self.randomize)
        else:
            ranges = {name: self.randomize for name in RANDOMIZABLE if name != "drag" or self.drag > 0.0}
        for name, value in ranges.items():
            if name not in RANDOMIZABLE:
                raise ValueError(f"randomize knows {', '.join(RANDOMIZABLE)}; got {shown(name)}")
            if not (is_number(value) and 0.0 <= value < 1.0):
                raise ValueError(f"randomize[{name!r}] is a relative spread in [0, 1), got {shown(value)}")
            if name == "drag" and value > 0.0 and self.drag == 0.0:
                raise ValueError(
                    "randomize['drag'] varies the drag in proportion: give the env a drag > 0 first"
                )
        weakest = min(self.make_limits().kappas) * (1.0 - ranges.get("kappa", 0.0))
        if weakest <= 0.25 * (1.0 + ranges.get("mass", 0.0)):
            raise ValueError(
                f"randomize={shown(self.randomize)} would draw rotors too weak to hover at kappa = "
                f"{self.kappa}"
            )
        ranges = {name: float(value) for name, value in ranges.items() if value > 0.0}
        for sign in (-1.0, 1.0):  # what is drawn is made then; here it is refused if it could not be
            extreme = varied(self.make_params(), {name: 1.0 + sign * value for name, value in ranges.items()})
            replace(self.make_params(), **{name: as_tuple(value) for name, value in extreme.items()})
        return ranges


def varied(params: QuadrotorParams, factors: Mapping[str, float | Array]) -> dict[str, Any]:
    """Parameters that are multiplied, of one vehicle or many; kappa is none of them.

    Where the largest principal moment would exceed the sum of the others, as that of no body does, it is
    that sum.

    Args:
        params: The nominal vehicle.
        factors: Parameter -> factor, (...); of the inertia (..., 3), or one.
    """
    values: dict[str, Any] = {}
    for name, factor in factors.items():
        if name == "inertia":
            J = np.asarray(params.inertia) * factor
            values[name] = np.minimum(J, J.sum(axis=-1, keepdims=True) - J)
        elif name != "kappa":
            values[name] = getattr(params, name) * factor
    return values


def spread(name: str, value: float | tuple[float, ...], length: int) -> tuple[float, ...]:
    """A number for all entries, or one per entry.

    Raises:
        ValueError: If it is neither.
    """
    values = value if isinstance(value, tuple) else (value,) * length
    if len(values) != length or not all(map(is_number, values)):
        raise ValueError(f"{name} must be one finite number or {length} of them, got {shown(value)}")
    return tuple(float(entry) for entry in values)
