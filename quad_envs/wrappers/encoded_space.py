"""What wrapped observations are, and which of them are left and how they are scaled, in one space.

The space says how it came about, in values of JSON, so that whatever stores the space stores that, too:
Stable-Baselines3 writes it into every model.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from gymnasium import spaces

from ..arguments.names import shown
from ..observations.features import default_features
from ..observations.tracking import TrackingLayout
from ..parameters import Limits
from ..tasks import Task
from .encoding import Encoder, Encoding

STAGES = (0, 2, 5, 10, 15, 25)  # few, as neighbours say nearly the same
COMMAND_RANGE = 0.5  # in which the noise of exploration tips nobody over


class EncodedBox(spaces.Box):
    """A Box of features that knows the encoding that made them, and for which observations.

    Args:
        encoder: It.
    """

    encoding: dict[str, Any]

    def __init__(self, encoder: Encoder) -> None:
        super().__init__(-np.inf, np.inf, (encoder.size,), np.float32)
        self.encoding = {
            **encoder.encoding.to_plain(),
            "layout": asdict(encoder.task.layout),
            "kappa": encoder.task.limits.kappa,
        }


def encoder_of(plain: dict[str, Any]) -> Encoder:
    """The encoder that an `EncodedBox` wrote down, for a task of which only what it needs is known.

    Raises:
        KeyError, TypeError, ValueError: If it is something else.
    """
    kappa = plain["kappa"]
    limits = Limits(kappa=tuple(kappa) if isinstance(kappa, list) else kappa)
    return Encoder(Encoding.from_plain(plain), Task(limits=limits, layout=TrackingLayout(**plain["layout"])))


def stages_of(preview: int) -> tuple[int, ...]:
    """Those of `STAGES` that a preview has."""
    return tuple(stage for stage in STAGES if stage <= preview)


def _task_of(env: Any) -> Any:
    """The task of an environment, or of the outermost wrapper that has one: it adds to observations."""
    while env is not None:
        task = getattr(env, "task", None)
        if task is not None:
            return task
        env = getattr(env, "env", None)
    return None


def make_encoder(env: Any, stages: tuple[int, ...] | None, command_range: float) -> Encoder:
    """The encoder of a wrapper.

    Args:
        env: What is wrapped.
        stages: Preview stages to keep; None for those of `STAGES` that there are.
        command_range: See `Encoding`.

    Raises:
        ValueError: If its task is none of one vehicle, or an argument is not allowed.
    """
    task = _task_of(env)
    if not isinstance(task, Task):
        raise ValueError(
            "FilterAndRescale wraps a tracking environment of this suite, single or vector, got one with "
            f"the task {shown(task)}; PettingZoo teams have wrappers of their own"
        )
    there = range(task.layout.preview + 1)
    if stages is None:
        stages = stages_of(task.layout.preview)
    elif not stages or not set(stages) <= set(there):
        raise ValueError(
            f"stages must be some of 0 to {task.layout.preview}, the preview, got {shown(stages)}"
        )
    return Encoder(Encoding(default_features(task.layout, tuple(stages)), command_range), task)
