"""Keyword arguments of the tracking environments, as one validated value."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ..disturbances import Disturbance, make_disturbance
from ..names import unknown_name
from ..observations import TrackingLayout
from ..parameters import N_STATE, Array, Limits, QuadrotorParams, Weights
from ..references import Reference, make_reference
from ..tasks import Task

# Arguments that are one number; what it may be is checked where it is used.
_NUMBERS = (
    *("mass", "gravity", "arm", "yaw_moment", "rotor_rate", "drag", "kappa", "rate_limit", "tilt_limit"),
    *("velocity_limit", "dt", "time_limit", "lost_distance"),
)
_MOST_STEPS = 1_000_000  # control periods of an episode; its tables are made at reset
RANDOMIZABLE = ("mass", "inertia", "arm", "kappa", "rotor_rate", "drag")
_Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingOptions:
    """What can be chosen about a tracking task. `TrackingEnv` documents each field."""

    env_id: str = "quad/Tracking-v0"
    mass: float = 0.8
    gravity: float = 9.8
    inertia: _Triple = (0.0224, 0.0224, 0.0436)
    arm: float = 0.165
    yaw_moment: float = 0.002167
    rotor_rate: float = 50.0
    drag: float = 0.0
    kappa: float = 1.0
    rate_limit: float = math.inf
    tilt_limit: float = math.inf
    velocity_limit: float = math.inf
    position_limit: tuple[_Triple, _Triple] | None = None
    Q: float | tuple[float, ...] = 1.0
    R: float | tuple[float, ...] = 1.0
    reference: str | Reference = "setpoint"
    start: tuple[float, ...] = (0.0, 0.0, 0.0)
    start_box: float | tuple[float, ...] = 1.0
    disturbance: str | Disturbance | None = None
    reveal_disturbance: bool = False
    sensor_noise: float | tuple[float, float, float, float] = 0.0
    randomize: float | Mapping[str, float] = 0.0
    preview: int = 25
    dt: float = 0.05
    substeps: int = 5
    time_limit: float = 10.0
    lost_distance: float = 50.0
    reward: str = "bounded"

    def __post_init__(self) -> None:
        for name in _NUMBERS:
            if not isinstance(getattr(self, name), int | float | np.integer | np.floating):
                raise ValueError(f"{name} must be a number, got {getattr(self, name)!r}")
        for name in ("dt", "time_limit", "lost_distance"):
            value = getattr(self, name)
            if not (_is_number(value) and value > 0.0):
                raise ValueError(f"{name} must be a finite number > 0, got {value!r}")
        steps = self.time_limit / self.dt
        if not 1.0 <= steps <= _MOST_STEPS or abs(steps - round(steps)) > 1e-6 * steps:
            raise ValueError(
                f"time_limit must be 1 to {_MOST_STEPS} whole control periods of dt = {self.dt} s, "
                f"got {self.time_limit!r} s"
            )
        if not isinstance(self.reveal_disturbance, bool | np.bool_):
            raise ValueError(f"reveal_disturbance must be True or False, got {self.reveal_disturbance!r}")
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
        for name in ("substeps", "preview"):
            value = getattr(self, name)
            least = 1 if name == "substeps" else 0
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
                raise ValueError(f"{name} must be an integer >= {least}, got {value!r}")
        if self.reward not in ("bounded", "quadratic"):
            raise ValueError(f"reward must be 'bounded' or 'quadratic', got {self.reward!r}")
        # Build everything once, so that a bad value is refused here and not at the first reset.
        self.make_task()
        self.start_state()
        self.start_half_widths()
        self.randomization()
        make_reference(self.reference)
        make_disturbance(self.disturbance)

    @classmethod
    def from_kwargs(cls, kwargs: Mapping[str, Any]) -> TrackingOptions:
        """Options from keyword arguments.

        Raises:
            TypeError: If a name is unknown; the message suggests the nearest one.
        """
        known = [field.name for field in fields(cls)]
        for name in kwargs:
            if name not in known:
                raise TypeError(unknown_name("keyword argument of a tracking environment", name, known[1:]))
        return cls(**{name: _as_tuple(value) for name, value in kwargs.items()})

    def make_task(self) -> Task:
        """The value from which policies are built."""
        lower, upper = self.position_limit or ((-math.inf,) * 3, (math.inf,) * 3)
        limits = Limits(
            kappa=self.kappa,
            rate=self.rate_limit,
            tilt=self.tilt_limit,
            velocity=self.velocity_limit,
            position_lower=lower,
            position_upper=upper,
        )
        params = QuadrotorParams(
            mass=self.mass,
            gravity=self.gravity,
            inertia=self.inertia,
            arm=self.arm,
            yaw_moment=self.yaw_moment,
            rotor_rate=self.rotor_rate,
            drag=self.drag,
        )
        layout = TrackingLayout(
            preview=int(self.preview),
            position=limits.has_position,
            disturbance=self.reveal_disturbance,
        )
        return Task(
            env_id=self.env_id,
            params=params,
            limits=limits,
            weights=Weights(Q=_spread("Q", self.Q, N_STATE), R=_spread("R", self.R, 4)),
            dt=self.dt,
            episode_steps=round(self.time_limit / self.dt),
            layout=layout,
            sensor_noise=self.noise_deviations(),
            reward=self.reward,
        )

    def start_state(self) -> Array:
        """Middle of the start box, (12,)."""
        if (
            not isinstance(self.start, tuple)
            or len(self.start) not in (3, N_STATE)
            or not all(map(_is_number, self.start))
        ):
            raise ValueError(f"start must be 3 (position) or 12 (state) finite numbers, got {self.start!r}")
        state = np.zeros(N_STATE)
        state[: len(self.start)] = self.start
        tilt, width = np.abs(state[6:8]), self.start_half_widths()[6:8]
        if (tilt + width >= CRASH_TILT).any():
            raise ValueError(
                f"start roll and pitch with their box must stay below {CRASH_TILT:.4f} rad, "
                f"got {tilt.tolist()} +- {width.tolist()}"
            )
        return state

    def start_half_widths(self) -> Array:
        """Half widths of the start box, (12,); a single number is for the position."""
        widths = self.start_box if isinstance(self.start_box, tuple) else (self.start_box,) * 3
        if len(widths) not in (3, N_STATE) or not all(_is_number(w) and w >= 0.0 for w in widths):
            raise ValueError(f"start_box must be 1, 3 or 12 finite half widths >= 0, got {self.start_box!r}")
        out = np.zeros(N_STATE)
        out[: len(widths)] = widths
        return out

    def noise_deviations(self) -> tuple[float, float, float, float]:
        """Standard deviations of measured position, velocity, attitude and rates; one number is for all."""
        values = _spread("sensor_noise", self.sensor_noise, 4)
        if not all(value >= 0.0 for value in values):
            raise ValueError(f"sensor_noise must be >= 0, got {self.sensor_noise!r}")
        return values[0], values[1], values[2], values[3]

    def randomization(self) -> dict[str, float]:
        """Parameter -> largest relative change of it at reset, only those that vary."""
        if isinstance(self.randomize, Mapping):
            spread = dict(self.randomize)
        else:
            spread = {name: self.randomize for name in RANDOMIZABLE if name != "drag" or self.drag > 0.0}
        for name, value in spread.items():
            if name not in RANDOMIZABLE:
                raise ValueError(f"randomize knows {', '.join(RANDOMIZABLE)}; got {name!r}")
            if not (_is_number(value) and 0.0 <= value < 1.0):
                raise ValueError(f"randomize[{name!r}] is a relative spread in [0, 1), got {value!r}")
            if name == "drag" and value > 0.0 and self.drag == 0.0:
                raise ValueError(
                    "randomize['drag'] varies the drag in proportion: give the env a drag > 0 first"
                )
        if self.kappa * (1.0 - spread.get("kappa", 0.0)) <= 0.25 * (1.0 + spread.get("mass", 0.0)):
            raise ValueError(
                f"randomize={self.randomize!r} would draw rotors too weak to hover at kappa = {self.kappa}"
            )
        return {name: float(value) for name, value in spread.items() if value > 0.0}


CRASH_TILT = math.radians(85.0)  # rad; the Euler rates are singular at 90 degrees


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and math.isfinite(value)


def _is_vector(value: object) -> bool:
    """Whether it is three numbers, possibly infinite."""
    return (
        isinstance(value, tuple)
        and len(value) == 3
        and all(isinstance(entry, int | float | np.integer | np.floating) for entry in value)
    )


def _as_tuple(value: Any) -> Any:
    """Lists and arrays from configuration files and the command line become tuples."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    return tuple(_as_tuple(entry) for entry in value) if isinstance(value, list | tuple) else value


def _spread(name: str, value: float | tuple[float, ...], length: int) -> tuple[float, ...]:
    """A number for all entries, or one per entry."""
    values = value if isinstance(value, tuple) else (value,) * length
    if len(values) != length or not all(map(_is_number, values)):
        raise ValueError(f"{name} must be one finite number or {length} of them, got {value!r}")
    return tuple(float(entry) for entry in values)
