"""How far a policy lies above the frontier: the most score that a family of policies has for its cost.

A policy that draws one of two of the family before each flight has the mean of their scores at the mean of
their costs. So the frontier is the upper concave hull of the family's points, flat beyond the best of them,
which needs no more cost. It does not reach below the cheapest. Limits are not looked at, and whose flights
crash, which leaves no cost, makes no point. The corners are chosen by the flights that are compared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from quad_envs.parameters import Array

from .statistics import Interval, difference


class Flights(NamedTuple):
    """Scores and costs of a policy, (training seeds, starts) each."""

    scores: Array
    costs: Array

    @property
    def cost(self) -> float:
        """Mean; nan where a crash left no number."""
        return float(self.costs.mean())

    @property
    def score(self) -> float:
        """Mean."""
        return float(self.scores.mean())

    def along(self, slope: float) -> Array:
        """Scores minus slope times costs, (training seeds, starts)."""
        return self.scores - slope * self.costs


def frontier(family: Sequence[Flights]) -> list[Flights]:
    """The corners of the frontier of a family, the cheapest first; those that crashed are left out."""
    known = [one for one in family if math.isfinite(one.cost)]
    hull: list[Flights] = []
    for one in sorted(known, key=lambda one: (one.cost, -one.score)):
        if hull and one.score <= hull[-1].score:
            continue
        while len(hull) > 1 and _slope(hull[-2], one) >= _slope(hull[-2], hull[-1]):
            hull.pop()
        hull.append(one)
    return hull


def above_frontier(ours: Flights, family: Sequence[Flights]) -> Interval | None:
    """The mean score minus that of the frontier at the same mean cost, paired by starts.

    The interval includes the spread of the costs, to first order: from each score the slope between the two
    neighbouring corners times the cost of its flight is taken.

    Args:
        ours: Of the policy.
        family: Of the policies that make the frontier, of one seed each, from the same starts.

    Returns:
        None where a crash left no cost, there is no family, or the policy is cheaper than all of it.

    Raises:
        ValueError: If the starts do not match.
    """
    if len({one.scores.shape[1] for one in (ours, *family)}) > 1:
        raise ValueError("above_frontier needs flights of all from the same starts")
    hull, cost = frontier(family), ours.cost
    if not hull or not cost >= hull[0].cost:  # nor where it is nan
        return None
    for low, high in pairwise(hull):
        if cost < high.cost:
            slope, share = _slope(low, high), (cost - low.cost) / (high.cost - low.cost)
            mixed = (1.0 - share) * low.along(slope) + share * high.along(slope)
            return difference([ours.along(slope)], [mixed])
    return difference([ours.scores], [hull[-1].scores])


def _slope(low: Flights, high: Flights) -> float:
    """Score for cost between two."""
    return (high.score - low.score) / (high.cost - low.cost)
