"""What training has cost: CPU-seconds and steps, and the share of a budget that is."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from time import process_time
from typing import Any

from numba.core import event

from quad_envs.arguments.kinds import is_number
from quad_envs.arguments.names import shown

_COMPILING = "numba:compile"


@dataclass(frozen=True, slots=True)
class Budget:
    """How long to train, in CPU-seconds or in environment steps.

    Raises:
        ValueError: If both or none is given, or the number is not > 0.
    """

    seconds: float | None = None
    steps: int | None = None

    def __post_init__(self) -> None:
        if (self.seconds is None) == (self.steps is None):
            raise ValueError("a training budget is either seconds (CPU-seconds) or steps, not both")
        for name, value in (("seconds", self.seconds), ("steps", self.steps)):
            if value is None:
                continue
            if not is_number(value) or value <= 0 or (name == "steps" and int(value) != value):
                kind = "a whole number" if name == "steps" else "a number"
                raise ValueError(f"{name} of training must be {kind} > 0, got {shown(value)}")

    def share(self, seconds: float, steps: int) -> float:
        """Share that is used up, >= 0."""
        return steps / self.steps if self.steps is not None else seconds / (self.seconds or math.inf)

    @property
    def flag(self) -> str:
        """As on the command line."""
        return f"--steps {self.steps}" if self.steps is not None else f"--seconds {self.seconds:g}"

    def __str__(self) -> str:
        return f"{self.steps} steps" if self.steps is not None else f"{self.seconds:g} CPU-seconds"


class TrainingClock(event.Listener):
    """CPU-seconds of this process while it trains, on all its threads.

    Evaluation and saving happen while it stands. So does compilation, which happens once per installation.
    """

    def __init__(self, before: float = 0.0) -> None:
        self._sum = before
        self._since: float | None = None
        self._compiling = 0

    @property
    def seconds(self) -> float:
        """Up to now."""
        return self._sum + (0.0 if self._since is None else process_time() - self._since)

    @contextmanager
    def running(self) -> Iterator[None]:
        """Let it run."""
        event.register(_COMPILING, self)
        self._since = process_time()
        try:
            yield
        finally:
            self._stop()
            self._compiling = 0
            event.unregister(_COMPILING, self)

    def _stop(self) -> None:
        self._sum, self._since = self.seconds, None

    def on_start(self, event: Any) -> None:
        """A kernel begins to compile."""
        self._compiling += 1
        self._stop()

    def on_end(self, event: Any) -> None:
        """A kernel is compiled; the one whose compilation asked for it may still be at it."""
        self._compiling -= 1
        if self._compiling == 0:
            self._since = process_time()
