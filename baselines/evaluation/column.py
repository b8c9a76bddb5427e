"""What is to be said of a column, so that every table that has it can be computed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Flag, auto

import numpy as np


class Mark(Flag):
    """What a column is. Without a mark: a mean over vehicles, then over flights, in the tables of all."""

    MORE = auto()  # is better
    LESS = auto()  # is better
    SINGLE = auto()  # shown of single vehicles alone
    TEAM = auto()  # only vehicles of a team have it
    LEAST = auto()  # vehicle counts for the team
    LARGEST = auto()  # vehicle counts for the team; there is no number if one has none
    WORST = auto()  # vehicle is told beside the mean, as `<name>_worst`
    CUT_SHORT = auto()  # by a crash, so that it would look cheap: then there is no number, and no mean
    COMPARED = auto()  # beside it stands the difference to the base, from the same starts
    PERCENT = auto()  # a share, shown as %
    COUNTED = auto()  # summed over flights, not averaged
    FALLBACK = auto()  # counted, and shown as one sum: decisions without the solver's own answer
    TIMED = auto()  # a quantile over all decisions, not averaged
    MOST = auto()  # the largest over flights, not averaged
    UNSEEN = auto()  # in files, not on the page
    REPORTED = auto()  # only of policies that report it; in no table where none does
    TAILED = auto()  # where there are many flights its 99.9 % quantile is told, as `<name>_tail`
    TAIL = auto()  # says how bad rare flights are, with both ends of an interval; only where there are many
    PLAIN = 0  # none of these


_MARKS = [mark for mark in Mark if mark.value]  # Python 3.10 counts PLAIN, too
MORE, LESS, SINGLE, TEAM, LEAST, LARGEST, WORST, CUT_SHORT, COMPARED, PERCENT = _MARKS[:10]
COUNTED, FALLBACK, TIMED, MOST, UNSEEN, REPORTED, TAILED, TAIL = _MARKS[10:]
_NOT_AVERAGED = COUNTED | FALLBACK | TIMED | MOST


@dataclass(frozen=True, slots=True)
class Column:
    """A column of the tables."""

    title: str  # on the page
    unit: str  # "" if it has none
    about: str  # what it says
    marks: Mark = Mark.PLAIN
    printed: str = ""  # heading in printed tables, before the unit; "" if it is not in them
    name: str = ""  # in files: the field of the Record, where it is one
    source: str = ""  # field of the Record from which it is computed; "" if from none

    def has(self, mark: Mark) -> bool:
        """Whether it has one of these marks."""
        return bool(self.marks & mark)

    @property
    def averaged(self) -> bool:
        """Whether it is a mean over flights, with an interval."""
        return bool(self.source) and not self.has(_NOT_AVERAGED)

    @property
    def better(self) -> int:
        """1: more is better, -1: less is better, 0: neither."""
        return int(self.has(MORE)) - int(self.has(LESS))

    @property
    def factor(self) -> float:
        """By which the number is multiplied where it is shown."""
        return 100.0 if self.has(PERCENT) else 1.0

    @property
    def heading(self) -> str:
        """Of a printed table."""
        return " ".join(filter(None, (self.printed, "%" if self.has(PERCENT) else self.unit)))

    @property
    def notes(self) -> list[str]:
        """What it says, and where it has numbers."""
        return [
            self.about,
            *["empty after a crash"] * self.has(CUT_SHORT),
            *["teams only"] * self.has(TEAM),
            *["behind a safety filter only"] * self.has(REPORTED),
            *["not in tables of teams"] * self.has(SINGLE),
            *[f"`{self.name}_worst` is that of the worst vehicle"] * self.has(WORST),
        ]

    def of_team(self, values: Sequence[float]) -> float:
        """The number of a flight from those of its vehicles, nan where they have none."""
        if len(values) == 1 and not self.has(LEAST | LARGEST):
            (value,) = values
            return float(value) if math.isfinite(value) else float("nan")
        x = np.array(values, dtype=np.float64)
        if self.has(LEAST):
            return float(x.min())
        if self.has(LARGEST):
            return float(x.max())
        finite = x[np.isfinite(x)]
        return float(finite.mean()) if finite.size else float("nan")

    def worst(self) -> Column:
        """The same of the worst vehicle of a team."""
        return replace(
            self,
            title=f"{self.title}, worst",
            about=f"{self.about}, of the worst vehicle",
            marks=self.marks & ~(WORST | COMPARED | TAILED) | LARGEST,
            printed=self.printed and f"{self.printed} worst",
            name=f"{self.name}_worst",
        )

    def tail(self) -> Column:
        """The quantile over flights that all but one in a thousand stay below."""
        return replace(
            self,
            title=f"{self.title}, 99.9 %",
            about=f"{self.title} that 99.9 % of the flights stay below; a crash counts as larger than any",
            marks=self.marks & (SINGLE | TEAM | LESS) | TAIL,
            printed=self.printed and f"{self.printed} 99.9 %",
            name=f"{self.name}_tail",
            source="",
        )

    def difference(self) -> Column:
        """The difference to the base; "{base}" stands for its title."""
        return replace(
            self,
            title=f"Δ {self.title[0].lower()}{self.title[1:]}",
            about=f"{self.title} minus that of {{base}}, same starts",
            marks=self.marks & ~COMPARED,
            printed="- {base}",
            name=f"{self.name}_minus_base",
            source="",
        )
