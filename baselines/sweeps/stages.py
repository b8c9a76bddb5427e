"""What a sweep tells the person at the terminal: its stages, each row once it is flown, the time left."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from .compiling import compile_for, registered
from .progress import Progress
from .units import Unit

if TYPE_CHECKING:
    from ..evaluation.evaluate import Evaluation

_OVERHEAD_MS = 0.1  # of a step beside its decision: the environment, what is recorded and measured
_OTHERS_MS = 0.02  # a decision of a network, or of a policy whose price nobody knows


def price(unit: Unit) -> float:
    """About how long a step of a unit takes, ms: for the order of units and for estimates, for no result."""
    entry = registered(unit)
    return _OVERHEAD_MS + (_OTHERS_MS if entry is None else entry.decision_ms)


class SweepProgress:
    """Follows a sweep: shows what is trained, compiles before the first unit flies, and shows each row."""

    def __init__(self) -> None:
        self._train: Progress | None = None
        self._fly: Progress | None = None
        self._left = 0  # blocks
        self._all = self._flown = 0.0  # price of what is to be flown, and of what is
        self._said = ""  # the time left

    def trained(self, finished: int, total: int) -> None:
        """So many of the networks are there; each takes about as long as another."""
        if self._train is None:
            self._train = Progress("train", total)
            self._train.write(f"train: {total} policies")
            return
        left = self._train.move(finished, total)
        self._train.write(f"train: {finished} of {total} are there{'; ' * bool(left)}{left}")
        if finished == total:
            self._train.close()

    def ready(self, left: Sequence[Unit]) -> None:
        """All is checked, and networks are trained: these blocks are going to fly."""
        compile_for(left)
        self._all = sum(price(block) * block.episodes for block in left)
        self._left, self._fly = len(left), Progress("fly", len(left))

    def moved(self, block: Unit) -> None:
        """A block was flown just now."""
        assert self._fly is not None
        self._flown += price(block) * block.episodes
        self._left -= 1
        self._said = self._fly.move(self._flown, self._all)
        if not self._left:
            self.close()

    def flown(self, unit: Unit, found: Evaluation) -> None:
        """The row of a unit that is complete."""
        assert self._fly is not None
        summary = found.summary()
        crashes = sum(record.crashed for record in found.records)
        self._fly.write(
            f"{unit.env.title}  {unit.policy.title:22} score {summary['score'].mean:.3f}  "
            f"violating {100.0 * summary['violation_share'].mean:3.0f} %  crashed {crashes:2}  "
            f"decision {found.decision_ms[0]:.3f} ms  {self._said}"
        )

    def close(self) -> None:
        """Take the bar away, also where the sweep was interrupted."""
        for progress in (self._train, self._fly):
            if progress is not None:
                progress.close()
