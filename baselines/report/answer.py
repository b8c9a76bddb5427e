"""The answer in a sentence: who wins, by how much, at which violations and decision time; who is as good."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from quad_envs.parameters import Array

from ..evaluation.amounts import INTERVAL_LEAST
from ..evaluation.statistics import Interval, difference
from ..evaluation.table import format_number
from ..evaluation.team_metrics import flight_values
from ..sweeps.contenders import Contender
from .model import Answer

_RESAMPLES = 500  # of intervals in sentences
_NO_MORE = 1e-4  # half width over the mean, below which the interval is not worth its digits
_LEAST_SHARE = 1e-4
_MOST_NAMED = 4  # policies in a list


class _Side(NamedTuple):
    """A contender in one environment, or in each of several."""

    name: str
    parts: tuple[Contender, ...]

    @property
    def rank(self) -> tuple[float, ...]:
        """Less is better."""
        return tuple(float(x) for x in np.mean([one.rank() for one in self.parts], axis=0))

    @property
    def score(self) -> float:
        """Mean over environments."""
        return float(np.mean([one.values("score").mean() for one in self.parts]))

    def more_than(self, other: _Side) -> Interval:
        """By how much it scores more, from the starts that both have flown."""
        pairs = [_paired(one, rival) for one, rival in zip(self.parts, other.parts, strict=True)]
        if not all(x.shape[1] for x, _ in pairs):
            return Interval(self.score - other.score, math.nan, math.nan)
        return difference([x for x, _ in pairs], [y for _, y in pairs], _RESAMPLES)

    def ties(self, other: _Side) -> bool:
        """Whether the score does not tell them apart, and neither do crashes or violations."""
        found = self.more_than(other)
        return self.rank[:-1] == other.rank[:-1] and not found.low > 0.0

    @property
    def flights(self) -> int:
        """Flown, over all seeds."""
        return sum(one.flights for part in self.parts for one in part.evaluations)

    @property
    def decision_ms(self) -> float:
        """Median of the medians."""
        return float(np.median([one.decision_ms[0] for part in self.parts for one in part.evaluations]))

    def story(self) -> str:
        """What it did about limits and crashes."""
        records = [record for part in self.parts for one in part.evaluations for record in one.records]
        crashed = sum(bool(record.crashed) for record in records)
        limited = any(record.worst_violation for record in records)
        share = float(np.mean([record.violation_share for record in records]))
        if not crashed and share == 0.0:
            return "without a violation or a crash" if limited else "without a crash"
        said = [f"violating a limit in {percent(share)} of its steps"] if share > 0.0 else []
        flights = f"{self.flights} flight{'s' * (self.flights != 1)}"
        said += [f"crashing in {crashed} of {flights}"] if crashed else ["without a crash"]
        return " and ".join(said)


def _paired(one: Contender, other: Contender) -> tuple[Array, Array]:
    """Scores of both, (seeds, starts) each, from the starts that all of their seeds have flown."""
    sides = [[flight_values(each.records, "score") for each in side.evaluations] for side in (one, other)]
    starts = [start for start in sides[0][0] if all(start in flown for side in sides for flown in side)]
    ours, theirs = (np.array([[flown[start] for start in starts] for flown in side]) for side in sides)
    return ours, theirs


def percent(share: float) -> str:
    """A share with two digits; one that is next to nothing in words."""
    if 0.0 < share < _LEAST_SHARE:
        return f"less than {100.0 * _LEAST_SHARE:g} %"
    return f"{format_number(100.0 * share, 2)} %"


def rounded(mean: float, half: float) -> str:
    """A mean to the digits of its interval: one of the half width, two where it begins with 1.

    Without an interval, or one that is no more than rounding, three digits.
    """
    if not (math.isfinite(half) and half > _NO_MORE * abs(mean)):
        return format_number(mean, 3)
    power = math.floor(math.log10(half))
    places = -power + (half / 10.0**power < 2.0)
    if places <= 0:
        step = 10.0**-places
        return f"{step * round(mean / step):.0f} ± {step * round(half / step):.0f}"
    return f"{mean:.{places}f} ± {half:.{places}f}"


def _said(interval: Interval) -> str:
    return rounded(abs(interval.value), 0.5 * (interval.high - interval.low))


def _listed(names: Sequence[str]) -> str:
    """Names in a row, the first few."""
    if len(names) > _MOST_NAMED:
        return f"{', '.join(names[:_MOST_NAMED])} and {len(names) - _MOST_NAMED} more"
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def answer(environments: Sequence[Sequence[Contender]]) -> Answer:
    """The answer of one environment, or of several; empty if nobody flew in all of them.

    Args:
        environments: Contenders of each, with distinct names.
    """
    names = [one.name for one in environments[0]] if environments else []
    sides = []
    for name in names:
        parts = [one for group in environments for one in group if one.name == name]
        if len(parts) == len(environments):
            sides.append(_Side(name, tuple(parts)))
    if not sides:
        return Answer()
    sides.sort(key=lambda side: side.rank)
    where = f"Over {len(environments)} environments, " if len(environments) > 1 else ""
    best, others = sides[0], sides[1:]
    time = f", deciding in {format_number(best.decision_ms, 2)} ms" if best.decision_ms > 0.0 else ""
    facts = f"{best.story()}{time}"
    starts = min(one.values("score").shape[1] for one in best.parts)
    if not others:
        flights = f"{best.flights} flight{'s' * (best.flights != 1)}"
        return Answer(f"{where}{best.name} scores {best.score:.3f} in {flights}, {facts}.", (best.name,))
    if starts < INTERVAL_LEAST:
        return Answer(
            f"{where}{best.name} leads with a score of {best.score:.3f}, {facts}; {starts} "
            f"start{'s' * (starts != 1)} tell nobody apart from it.",
            (best.name, others[0].name),
        )
    told = _compared(best, others, facts, starts)
    return told._replace(sentence=where + told.sentence)


def _compared(best: _Side, others: Sequence[_Side], facts: str, starts: int) -> Answer:
    """The sentence where there is something to compare."""
    tied = [side for side in others if best.ties(side)]
    behind = [side for side in others if side not in tied]
    unruly = [side for side in behind if side.score > best.score]
    below = [side for side in behind if side not in unruly]
    head = f"{best.name} {'leads' if tied else 'wins'} with a score of {best.score:.3f}"
    if below:
        head += f", {_said(best.more_than(below[0]))} more than {below[0].name} from the same {starts} starts"
    parts = [f"{head}, {facts}"]
    if tied:
        parts.append(f"{_listed([side.name for side in tied])} cannot be told apart from it")
    parts += [
        f"{side.name} scores {_said(side.more_than(best))} more, {side.story()}"
        for side in unruly[:_MOST_NAMED]
    ]
    rival = (*below, *behind, *tied)[0]
    return Answer("; ".join(parts) + ".", (best.name, rival.name))
