"""How far a policy lies above the frontier: the most score that a family of policies has for its cost.

Between two policies of the family lies one more: who draws for each flight which of the two flies has the
mean of their scores for the mean of their costs. So the frontier is the upper concave hull of the family's
points, flat beyond the best of them, which needs no more cost, and it does not reach below the cheapest.
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
        """What is left of each score where each unit of cost brings this much of it."""
        return self.scores - slope * self.costs


def frontier(family: Sequence[Flights]) -> list[Flights]:
    """Those of a family between which the frontier runs, the cheapest first; without those that crashed."""
    hull: list[Flights] = []
    for one in sorted(
        (one for one in family if math.isfinite(one.cost)), key=lambda one: (one.cost, -one.score)
    ):
        if hull and one.score <= hull[-1].score:
            continue
        while len(hull) > 1 and _slope(hull[-2], one) >= _slope(hull[-2], hull[-1]):
            hull.pop()
        hull.append(one)
    return hull


def above_frontier(ours: Flights, family: Sequence[Flights]) -> Interval | None:
    """The mean score minus that of the frontier at the same mean cost, paired by starts.

    The interval holds what costs vary, too: along the line between the two neighbours every score is taken
    less the slope times the cost of its flight, which to first order is what the resampled difference does.

    Args:
        ours: Of the policy.
        family: Of the policies that make the frontier, from the same starts.

    Returns:
        None where a crash left no cost, there is no family, or the policy is cheaper than all of it.
    """
    hull, cost = frontier(family), ours.cost
    if not hull or not cost >= hull[0].cost:
        return None
    for low, high in pairwise(hull):
        if cost < high.cost:
            slope, share = _slope(low, high), (cost - low.cost) / (high.cost - low.cost)
            mixed = (1.0 - share) * _one(low.along(slope)) + share * _one(high.along(slope))
            return difference([ours.along(slope)], [mixed])
    return difference([ours.scores], [_one(hull[-1].scores)])


def _slope(low: Flights, high: Flights) -> float:
    """Score for cost between two."""
    return (high.score - low.score) / (high.cost - low.cost)


def _one(values: Array) -> Array:
    """The mean over training seeds, (1, starts)."""
    mean: Array = values.mean(axis=0, keepdims=True)
    return mean
