"""What a sweep tells the person at the terminal: its stages, each row once it is flown, the time left."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter
from typing import TYPE_CHECKING, Any, TextIO

from ..policies.registry import TEAM_POLICIES, TRACKING_POLICIES, PolicyEntry
from .unit_flights import fly_unit
from .units import Unit

if TYPE_CHECKING:
    from ..evaluation.evaluate import Evaluation

_OVERHEAD_MS = 0.1  # of a step beside its decision: the environment, what is recorded and measured
_OTHERS_MS = 0.02  # a decision of a network, or of a policy whose price nobody knows
_FEW_SECONDS = 0.2  # of flight, enough to call every kernel
_LONG = 2.0  # s, from which a compiled policy is worth a line of its own
_FORMAT = "{desc} {n_fmt}/{total_fmt} |{bar:20}| {postfix}"


def _entry(unit: Unit) -> PolicyEntry | None:
    """The row of a unit's policy in the registry; None for networks and for policies from outside."""
    if unit.policy.train is not None or not unit.named:
        return None
    return TEAM_POLICIES.get(unit.policy.name) or TRACKING_POLICIES.get(unit.policy.name)


def price(unit: Unit) -> float:
    """About how long a step of a unit takes, ms: for the order of units and for estimates, for no result."""
    entry = _entry(unit)
    return _OVERHEAD_MS + (_OTHERS_MS if entry is None else entry.decision_ms)


def said_seconds(seconds: float) -> str:
    """A duration as one says it: 7 s, 3 min, 2.5 h."""
    if seconds < 90.0:
        return f"{max(1, round(seconds))} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5400.0 else f"{seconds / 3600.0:.1f} h"


def said_left(spent: float, done: float, all_of_it: float) -> str:
    """How long the rest takes, if it goes on at the pace so far.

    Args:
        spent: Time so far, s.
        done: What is done, in any unit, >= 0.
        all_of_it: The whole, in the same unit.
    """
    if done >= all_of_it:
        return f"took {said_seconds(spent)}"
    return f"about {said_seconds(spent / done * (all_of_it - done))} left" if done > 0.0 else ""


class Progress:
    """A bar with the time left on a terminal; in a pipe nothing but the lines that are written.

    Args:
        what: Name of the stage.
        total: Number of its pieces.
    """

    def __init__(self, what: str, total: int) -> None:
        from tqdm import tqdm

        self._begin = perf_counter()
        self._bar: Any = tqdm(
            total=total, desc=what, bar_format=_FORMAT, file=sys.stderr, disable=None, leave=False
        )

    def describe(self, what: str) -> None:
        """Name what is done now."""
        self._bar.set_description_str(what)

    def move(self, done: float, all_of_it: float) -> str:
        """One more piece is done, and with it `done` of all the work; the words for the time left."""
        left = said_left(perf_counter() - self._begin, done, all_of_it)
        self._bar.set_postfix_str(left, refresh=False)
        self._bar.update()
        return left

    def write(self, text: str, file: TextIO | None = None) -> None:
        """A line above the bar, on stderr if nothing else is said."""
        self._bar.write(text, file=sys.stderr if file is None else file)

    def close(self) -> None:
        """Take the bar away."""
        self._bar.close()


class SweepProgress:
    """Follows a sweep: shows what is trained, compiles before the first unit flies, and shows each row."""

    def __init__(self) -> None:
        self._train: Progress | None = None
        self._fly: Progress | None = None
        self._left = 0  # units
        self._all = self._flown = 0.0  # price of what is to be flown, and of what is

    def trained(self, finished: int, total: int) -> None:
        """So many of the networks are there; each takes about as long as another."""
        if self._train is None:
            self._train = Progress("train", total)
            self._train.write(f"train: {total} networks")
            return
        self._train.write(f"train: {finished} of {total} are there; {self._train.move(finished, total)}")
        if finished == total:
            self._train.close()

    def ready(self, left: Sequence[Unit]) -> None:
        """All is checked, and networks are trained: these units are going to fly."""
        compile_for(left)
        self._all = sum(map(price, left))
        self._left, self._fly = len(left), Progress("fly", len(left))

    def flown(self, unit: Unit, found: Evaluation) -> None:
        """The row of a unit that was flown just now."""
        assert self._fly is not None
        self._flown += price(unit)
        self._left -= 1
        left = self._fly.move(self._flown, self._all)
        summary = found.summary()
        crashes = sum(record.crashed for record in found.records)
        self._fly.write(
            f"{unit.env.title}  {unit.policy.title:22} score {summary['score'].mean:.3f}  "
            f"violating {100.0 * summary['violation_share'].mean:3.0f} %  crashed {crashes:2}  "
            f"decision {found.decision_ms[0]:.3f} ms  {left}"
        )
        if not self._left:
            self.close()

    def close(self) -> None:
        """Take the bar away, also where the sweep was interrupted."""
        for progress in (self._train, self._fly):
            if progress is not None:
                progress.close()


def compile_for(units: Sequence[Unit]) -> None:
    """Call every kernel that these units need, so that nobody waits for one while they fly.

    A kernel that is kept from an earlier run is loaded instead, which takes a moment. Networks and policies
    from outside are left out: the former need no kernel of their own, the latter are none of ours.
    """
    first: dict[str, Unit] = {}
    for unit in units:
        if _entry(unit) is not None:
            kwargs = {key: value for key, value in unit.env.kwargs.items() if key != "max_episode_steps"}
            env = replace(unit.env, kwargs={**kwargs, "time_limit": _FEW_SECONDS})
            first.setdefault(unit.policy.name, unit._replace(env=env, episodes=1, episode_folder=None))
    if not first:
        return
    progress = Progress("compile", len(first))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they are said when the units fly
            for count, unit in enumerate(first.values(), 1):
                begin = perf_counter()
                progress.describe(f"compile {unit.policy.name}")
                fly_unit(unit)
                left = progress.move(count, len(first))
                if perf_counter() - begin > _LONG and count < len(first):
                    progress.write(f"compile: {unit.policy.name} is ready; {left}")
        progress.write(f"compile: {', '.join(first)}; {left}")
    finally:
        progress.close()
