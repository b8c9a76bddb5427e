"""Who watches a training: a person at a terminal, a log file behind a pipe, TensorBoard."""

from __future__ import annotations

import sys
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

from ..evaluation.table import format_number
from .held_out import Point


class Watcher(Protocol):
    """Hears of a training."""

    def updated(self, share: float, progress: Any) -> None:
        """After each update, with the share of the budget that is used up."""

    def judged(self, point: Point, best: bool) -> None:
        """After each evaluation, with whether it is the best so far."""

    def noted(self, text: str) -> None:
        """What a person should know."""

    def close(self) -> None:
        """Training ended."""


def describe(point: Point) -> str:
    """A point of the curve in words."""
    return (
        f"{point.cpu_seconds:.1f} CPU-s, {point.steps} steps: score {point.score:.3f}, "
        f"quadratic cost {format_number(point.quadratic_cost)}, "
        f"violations {100.0 * point.violation_share:.1f} %, crashes {point.crashes}/{point.flights}"
    )


class Display:
    """On a terminal a bar with score, violations and the time left; in a pipe a line per evaluation."""

    def __init__(self, title: str, stream: Any = None) -> None:
        from tqdm import tqdm

        self._stream = sys.stderr if stream is None else stream
        self._bar = tqdm(
            total=100.0,
            desc=title,
            file=self._stream,
            disable=not self._stream.isatty(),
            leave=False,
            bar_format="{desc} {percentage:3.0f} %|{bar}| {remaining} left{postfix}",
        )

    def updated(self, share: float, progress: Any) -> None:
        """Move the bar."""
        self._bar.update(min(100.0, 100.0 * share) - self._bar.n)

    def judged(self, point: Point, best: bool) -> None:
        """Show the score."""
        if self._bar.disable:
            self._say(describe(point) + (", best so far" if best else ""))
            return
        self._bar.set_postfix_str(
            f"score {point.score:.3f}, violations {100.0 * point.violation_share:.1f} %, "
            f"crashes {point.crashes}/{point.flights}"
        )

    def noted(self, text: str) -> None:
        """A line beside the bar."""
        self._bar.clear()
        self._say(text)

    def close(self) -> None:
        """Take the bar away."""
        self._bar.close()

    def _say(self, text: str) -> None:
        print(text, file=self._stream, flush=True)


class TensorBoardLog:
    """Scalars for TensorBoard, over environment steps."""

    def __init__(self, folder: Path) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from torch.utils.tensorboard import SummaryWriter

            self._writer: Any = SummaryWriter(str(folder))

    def updated(self, share: float, progress: Any) -> None:
        """Nothing: an update may take a millisecond."""

    def judged(self, point: Point, best: bool) -> None:
        """Write what was measured."""
        for name, value in point._asdict().items():
            if name not in ("steps", "flights") and value == value:
                self._writer.add_scalar(f"held_out/{name}", value, point.steps)

    def noted(self, text: str) -> None:
        """Nothing."""

    def close(self) -> None:
        """Flush."""
        self._writer.close()


def tensorboard_log(folder: Path) -> list[Watcher]:
    """A TensorBoard log, if it is installed and the folder takes it."""
    if find_spec("tensorboard") is None or find_spec("torch") is None:
        return []
    try:
        return [TensorBoardLog(folder)]
    except (ImportError, OSError):  # an optional view, not worth the end of a training
        return []
