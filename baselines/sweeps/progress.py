"""A bar on a terminal and plain lines in a pipe, with the time left in words."""

from __future__ import annotations

import sys
from time import perf_counter
from typing import Any, TextIO

_TELLING = 0.05  # of the work, before which compilation says more of the pace than the work does
_FORMAT = "{desc} {n_fmt}/{total_fmt} |{bar:20}| {postfix}"


def said_seconds(seconds: float) -> str:
    """A duration as one says it: 7 s, 3 min, 2.5 h."""
    if seconds < 90.0:
        return f"{max(1, round(seconds))} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5400.0 else f"{seconds / 3600.0:.1f} h"


def said_left(spent: float, done: float, all_of_it: float) -> str:
    """How long the rest takes, if it goes on at the pace so far; nothing before that tells much.

    Args:
        spent: Time so far, s.
        done: What is done, in any unit, >= 0.
        all_of_it: The whole, in the same unit.
    """
    if done >= all_of_it:
        return f"took {said_seconds(spent)}"
    if done < _TELLING * all_of_it:
        return ""
    return f"about {said_seconds(spent / done * (all_of_it - done))} left"


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
