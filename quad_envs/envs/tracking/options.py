"""Keyword arguments of the tracking environments, as one validated value."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from ...arguments.checks import array_bytes
from ...arguments.kinds import is_number
from ...arguments.names import shown
from ...observations.tracking import N_REFERENCE, TrackingLayout
from ...parameters import N_STATE, POSITION, Array
from ...references import ReferenceLike
from ...references.table_row import N_TABLE
from ...registration import TIME_LIMIT, TRACKING
from ...tasks import Task
from ..shared.given import MOST_STATE
from ..shared.vehicle_options import CRASH_TILT, MOST_PREVIEW, MOST_STEPS, VehicleOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingOptions(VehicleOptions):
    """What can be chosen about a tracking task. `TrackingEnv` documents each field."""

    kind: ClassVar[str] = "a tracking"

    env_id: str = "quad/Tracking-v0"
    reference: ReferenceLike = "setpoint"  # a name, a path, a mapping, ...; afterwards what is flown
    start: str | tuple[float, ...] = (0.0, 0.0, 0.0)  # 3 numbers, m, or 12 (state), or "reference"
    start_box: float | tuple[float, ...] = 1.0  # half widths about it: 1 or 3, m, or 12 (state)
    preview: int = 25  # control periods of the coming reference in the observation
    lost_distance: float = 50.0  # m from the reference, beyond which it is a crash
    max_episode_steps: int | None = None  # in place of time_limit, as in gymnasium.make
    task: Task = field(init=False, repr=False, compare=False)  # made from the rest

    def __post_init__(self) -> None:
        reference = self.take_time_limit(self.reference)
        self.take_steps()
        object.__setattr__(self, "reference", self.within_episode(reference))
        VehicleOptions.__post_init__(self)
        self.require_positive("lost_distance")
        self.require_whole("preview", 0, MOST_PREVIEW, lambda n: array_bytes((n + 1, N_TABLE + N_REFERENCE)))
        object.__setattr__(self, "task", self._make_task())
        self.start_state()

    def take_steps(self) -> None:
        """The time limit of `max_episode_steps`, in place of the id's own; of two given, the shorter."""
        if self.max_episode_steps is None:
            return
        self.require_whole("max_episode_steps", 1, MOST_STEPS)
        asked = self.max_episode_steps * self.dt
        own = TRACKING.get(self.env_id, {}).get("time_limit", TIME_LIMIT)
        if self.time_limit != own and abs(self.time_limit - asked) > 1e-6 * asked:
            warnings.warn(
                f"max_episode_steps={self.max_episode_steps} of dt = {self.dt:g} s are {asked:g} s, and "
                f"time_limit={self.time_limit:g} s: the shorter holds; give one of them",
                stacklevel=2,
            )
            asked = min(asked, self.time_limit)
        object.__setattr__(self, "time_limit", asked)

    @classmethod
    def that_follow(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        """A start on the reference is exactly there."""
        return {"start_box": 0.0} if _is_reference(values.get("start")) else {}

    @property
    def starts_on_reference(self) -> bool:
        """Whether the start box is around the reference's first row."""
        return _is_reference(self.start)

    def _make_task(self) -> Task:
        """The task that follows from the options."""
        known = self.task_fields()
        layout = TrackingLayout(
            preview=int(self.preview),
            position=known["limits"].has_position,
            disturbance=self.reveal_disturbance,
        )
        return Task(layout=layout, **known)

    def start_state(self) -> Array:
        """Middle of the start box, (12,), or zero where it is on the reference.

        Raises:
            ValueError: If a start that can be drawn is no plant, or a crash.
        """
        if not self.starts_on_reference and (
            not isinstance(self.start, tuple)
            or len(self.start) not in (3, N_STATE)
            or not all(map(is_number, self.start))
        ):
            raise ValueError(
                "start must be 3 (position) or 12 (state) finite numbers or 'reference', "
                f"got {shown(self.start)}"
            )
        state = np.zeros(N_STATE)
        if isinstance(self.start, tuple):
            state[: len(self.start)] = self.start
        widths = self.start_half_widths()
        tilt, width = np.abs(state[6:8]), widths[6:8]
        if (tilt + width >= CRASH_TILT).any():
            raise ValueError(
                f"start roll and pitch with their box must stay below {CRASH_TILT:.4f} rad, "
                f"got {tilt.tolist()} +- {width.tolist()}"
            )
        if (np.abs(state) + widths > MOST_STATE).any():
            raise ValueError(
                f"start with its box must stay within {MOST_STATE:g} (SI), got {shown(self.start)} +- "
                f"{shown(self.start_box)}"
            )
        return state

    def require_near(self, first: Array) -> None:
        """Refuse a start box of which a corner is lost before the flight.

        Args:
            first: Where the reference begins, (3,), m.

        Raises:
            ValueError: If a corner is farther from there than `lost_distance`.
        """
        middle = np.zeros(3) if self.starts_on_reference else self.start_state()[POSITION] - first
        worst = float(np.linalg.norm(np.abs(middle) + self.start_half_widths()[POSITION]))
        if worst > self.lost_distance:
            raise ValueError(
                f"starts are up to {worst:.3g} m from the reference (start {shown(self.start)}, start_box "
                f"{shown(self.start_box)}: its farthest corner), beyond lost_distance = "
                f"{self.lost_distance:g} m; move the start or the reference, shrink the box, or raise "
                "lost_distance"
            )

    def start_half_widths(self) -> Array:
        """Half widths of the start box, (12,); a single number is for the position."""
        widths = self.start_box if isinstance(self.start_box, tuple) else (self.start_box,) * 3
        if len(widths) not in (3, N_STATE) or not all(is_number(w) and w >= 0.0 for w in widths):
            raise ValueError(
                f"start_box must be 1, 3 or 12 finite half widths >= 0, got {shown(self.start_box)}"
            )
        out = np.zeros(N_STATE)
        out[: len(widths)] = widths
        return out


def _is_reference(start: object) -> bool:
    return isinstance(start, str) and start == "reference"
