"""How far above the frontier a policy lies, beside another library's hull and a bootstrap by hand."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from baselines.evaluation.frontier import Flights, above_frontier, frontier
from baselines.evaluation.statistics import difference

STARTS = 40


def flights(score, cost, seed=0, spread=0.0, seeds=1):
    """Flights of these means."""
    rng = np.random.default_rng(seed)
    noise = spread * rng.standard_normal((2, seeds, STARTS))
    noise -= noise.mean(axis=(1, 2), keepdims=True)
    return Flights(score + 0.02 * noise[0], cost * (1.0 + 0.1 * noise[1]))


def drawn(data, count, spread=1.0):
    numbers = data.draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(numbers)
    places = zip(rng.uniform(0.3, 0.9, count), rng.uniform(100.0, 900.0, count), strict=True)
    return [flights(*place, seed=k, spread=spread) for k, place in enumerate(places)]


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_the_frontier_is_the_upper_hull_up_to_the_best_score(data):
    family = drawn(data, data.draw(st.integers(3, 12)))
    points = np.array([(one.cost, one.score) for one in family])
    corners = {tuple(points[k]) for k in ConvexHull(points * [1e-3, 1.0]).vertices}
    hull = [(one.cost, one.score) for one in frontier(family)]
    assert set(hull) <= corners
    assert hull[0][0] == points[:, 0].min() and hull[-1][1] == points[:, 1].max()
    slopes = [(high[1] - low[1]) / (high[0] - low[0]) for low, high in pairwise(hull)]
    assert all(slope > 0.0 for slope in slopes) and slopes == sorted(slopes, reverse=True)
    x, y = zip(*hull, strict=True)
    assert all(score <= np.interp(cost, x, y) + 1e-12 for cost, score in points)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_the_difference_is_that_of_the_means_and_the_frontier_between_them(data):
    family = drawn(data, 5)
    score, cost = data.draw(st.floats(0.2, 1.0)), data.draw(st.floats(50.0, 1200.0))
    ours = flights(score, cost, seed=99, spread=1.0, seeds=data.draw(st.integers(1, 5)))
    x, y = zip(*((one.cost, one.score) for one in frontier(family)), strict=True)
    found = above_frontier(ours, family)
    if ours.cost < x[0]:
        assert found is None
    else:
        assert found is not None
        assert found.value == pytest.approx(ours.score - np.interp(ours.cost, x, y), abs=1e-12)
        assert found.low < found.value < found.high


def test_who_draws_between_two_of_the_family_lies_on_the_frontier():
    family = [flights(0.80, 200.0, 1, 1.0), flights(0.86, 400.0, 2, 1.0)]
    turn = np.random.default_rng(0).permutation(STARTS) % 4
    seeds = [turn == k for k in range(4)]  # each start once with the one, thrice with the other
    mixed = Flights(*(np.array([np.where(k, b, a)[0] for k in seeds]) for a, b in zip(*family, strict=True)))
    assert mixed.cost == pytest.approx(0.75 * family[0].cost + 0.25 * family[1].cost)
    found = above_frontier(mixed, family)
    assert found is not None and found.value == pytest.approx(0.0, abs=1e-12)
    assert found.low < 0.0 < found.high


def test_the_interval_is_that_of_a_bootstrap_that_places_every_resample_by_its_own_cost():
    rng = np.random.default_rng(5)
    hard = rng.standard_normal(STARTS)  # a start that is hard for one is dear for all, by different amounts
    easy = rng.standard_normal((5, 1))
    hard -= hard.mean()

    def flown(score, cost, much):
        return Flights(np.full((1, STARTS), score), cost * (1.0 + much * hard[None]))

    family = [flown(0.80, 200.0, 0.1), flown(0.84, 260.0, 0.1), flown(0.86, 400.0, 0.1)]
    ours = Flights(np.full((5, STARTS), 0.85), 310.0 * (1.0 + 0.3 * hard + 0.05 * (easy - easy.mean())))
    found = []
    for _ in range(4000):
        starts, seeds = rng.integers(STARTS, size=STARTS), rng.integers(5, size=5)
        line = sorted((one.costs[0, starts].mean(), one.scores[0, starts].mean()) for one in family)
        x, y = zip(*line, strict=True)
        cost, score = (values[seeds][:, starts].mean() for values in (ours.costs, ours.scores))
        found.append(score - np.interp(cost, x, y))
    low, high = np.percentile(found, (2.5, 97.5))
    told = above_frontier(ours, family)
    assert told is not None and told.high - told.low == pytest.approx(high - low, rel=0.15)
    assert told.low == pytest.approx(low, abs=0.1 * (high - low))
    plain = difference([ours.scores], [family[1].scores])
    assert plain.high - plain.low < 0.01 * (high - low)  # without the costs there would be nothing


def test_ties_duplicates_and_a_cost_on_a_corner_make_no_difference():
    family = [flights(0.80, 200.0), flights(0.84, 300.0), flights(0.86, 400.0)]
    more = [*family, *family, flights(0.79, 200.0), flights(0.86, 450.0), flights(0.82, 250.0)]
    places = [(one.cost, one.score) for one in frontier(more)]
    assert places == [(one.cost, one.score) for one in frontier(family)]
    for one in family:
        found = above_frontier(Flights(one.scores + 0.01, one.costs), more)
        assert found is not None and found.value == pytest.approx(0.01)


def test_other_starts_are_refused():
    short = Flights(np.full((1, 3), 0.8), np.full((1, 3), 200.0))
    with pytest.raises(ValueError, match="same starts"):
        above_frontier(flights(0.8, 300.0), [short])
    with pytest.raises(ValueError, match="same starts"):
        above_frontier(flights(0.8, 300.0), [short, flights(0.9, 400.0)])


def test_without_a_cost_or_a_family_there_is_no_number():
    one = flights(0.8, 200.0)
    crashed = Flights(one.scores, np.where(np.arange(STARTS) == 3, math.nan, one.costs))
    assert above_frontier(one, []) is None
    assert above_frontier(crashed, [one]) is None
    assert above_frontier(one, [crashed]) is None
    assert above_frontier(flights(0.9, 199.0), [one]) is None
    alone = above_frontier(flights(0.9, 201.0), [one, crashed])
    assert alone is not None and alone.value == pytest.approx(0.1)
