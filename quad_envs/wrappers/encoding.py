"""How networks see a task and act in it: features of an observation, and outputs about hover.

Wrappers, learners and networks that fly have this one encoding.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arguments.kinds import is_number
from ..arguments.names import shown
from ..observations.features import Features
from ..observations.heading import HeadingAxes
from ..parameters import Array
from ..tasks import BaseTask, Task, TeamTask

Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Encoding:
    """What a network sees of an observation, and which rotor forces its outputs span.

    Raises:
        ValueError: If `command_range` is not above 0 and at most 1.
    """

    features: Features
    command_range: float = 1.0  # of an output, as a share of the hover force: +-1 commands u_T (1 +- it)

    def __post_init__(self) -> None:
        if not (is_number(self.command_range) and 0.0 < self.command_range <= 1.0):
            raise ValueError(
                "command_range is a share of the hover force, above 0 and at most 1, got "
                f"{shown(self.command_range)}"
            )

    def to_plain(self) -> dict[str, Any]:
        """As values of JSON; `from_plain` reads them."""
        seen = self.features
        return {
            "names": list(seen.names),
            "mean": list(seen.mean),
            "scale": list(seen.scale),
            "clip": seen.clip,
            "command_range": self.command_range,
            **({"heading_axes": True} if seen.heading_axes else {}),
        }

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Encoding:
        """What `to_plain` gave.

        Raises:
            KeyError, TypeError, ValueError: If it is something else.
        """
        clip = plain["clip"]
        features = Features(
            tuple(map(str, plain["names"])),
            tuple(map(float, plain["mean"])),
            tuple(map(float, plain["scale"])),
            None if clip is None else float(clip),
            bool(plain.get("heading_axes", False)),
        )
        return cls(features, float(plain["command_range"]))


class Encoder:
    """An encoding in a task: observations to features, outputs to actions.

    Args:
        encoding: Without a clip.
        task: Whose observations have what it sees.

    Raises:
        ValueError: If they have not; the message names what is missing.
    """

    def __init__(self, encoding: Encoding, task: Task | TeamTask) -> None:
        self.encoding, self.task = encoding, task
        self._columns = encoding.features.columns(task.layout)
        self._axes = HeadingAxes(task.layout) if encoding.features.heading_axes else None
        self._mean = np.asarray(encoding.features.mean, dtype=np.float32)
        self._rate = (1.0 / np.asarray(encoding.features.scale)).astype(np.float32)
        self._gains = hover_gains(task, encoding.command_range, np.float32)

    @property
    def size(self) -> int:
        """Numbers that the network sees."""
        return int(self._columns.size)

    def see(self, observations: NDArray[Any]) -> Floats:
        """Features (..., size) of observations (..., layout.size)."""
        turned = observations if self._axes is None else self._axes.turn(observations)
        out: Floats = np.take(turned, self._columns, axis=-1).astype(np.float32, copy=False)
        out -= self._mean
        out *= self._rate
        return out

    def act(self, outputs: NDArray[Any]) -> Floats:
        """Actions of outputs in [-1, 1], of the same shape; see `hover_actions`."""
        return _about_hover(np.asarray(outputs, dtype=np.float32), self._gains)


def hover_gains(task: BaseTask, command_range: float, dtype: Any = np.float64) -> NDArray[Any]:
    """Slopes of `hover_actions` below and above hover, of each rotor, (2, 4)."""
    above = task.hover_force / (task.force_max - task.hover_force)
    return np.asarray(command_range * np.stack([np.ones_like(above), above]), dtype=dtype)


def hover_actions(outputs: Floats, task: BaseTask, command_range: float = 1.0) -> Floats:
    """Actions that command u_T (1 + command_range output) within the rotor box, for the first four outputs.

    The environments' own map reaches from 0 to kappa m g, where exploration tips the vehicle over: learning
    is faster in a smaller range about hover.
    """
    return _about_hover(outputs, hover_gains(task, command_range, outputs.dtype))


def _about_hover(outputs: Floats, gains: NDArray[Any]) -> Floats:
    below, above = gains
    out = outputs.copy()
    rotors = out[..., :4]
    np.copyto(rotors, np.minimum(np.where(rotors < 0.0, below * rotors, above * rotors), 1.0))
    return out


def hover_slopes(outputs: Floats, task: BaseTask, command_range: float = 1.0) -> Array:
    """Derivative of `hover_actions` by each of four outputs; 0 where the rotor box cuts."""
    below, above = hover_gains(task, command_range)
    return np.where(outputs < 0.0, below, np.where(above * outputs < 1.0, above, 0.0))


def hover_outputs(actions: Floats, task: BaseTask, command_range: float = 1.0) -> Floats:
    """The outputs of which `hover_actions` makes these actions, within [-1, 1]."""
    below, above = hover_gains(task, command_range, actions.dtype)
    out = actions.copy()
    rotors = out[..., :4]
    np.copyto(rotors, np.clip(np.where(rotors < 0.0, rotors / below, rotors / above), -1.0, 1.0))
    return out
