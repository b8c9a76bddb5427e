"""Formations have the slots of the text, starts keep vehicles apart, misfits are refused with a remedy."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

from quad_envs.formations import make_formation, start_positions

RNG = np.random.default_rng(0)


def test_triangle_has_the_slots_of_the_text():
    expected = [(0, 0), (-0.866, -0.5), (-0.866, 0.5), (-1.732, -1), (-1.732, 0), (-1.732, 1)]
    slots = make_formation("triangle", 6)
    np.testing.assert_allclose(slots[:, :2], expected, atol=1e-3)  # printed to three digits
    assert np.array_equal(slots, make_formation("lattice", 6)) and not slots[:, 2].any()


def test_hexagon_has_the_slots_of_the_text():
    expected = [(0, 0), (-0.5, 0.866), (-1.5, 0.866), (-2, 0), (-1.5, -0.866), (-0.5, -0.866)]
    np.testing.assert_allclose(make_formation("hexagon", 6)[:, :2], expected, atol=1e-3)


@given(n=st.integers(2, 60), spacing=st.floats(0.5, 20.0))
def test_nearest_slots_of_a_lattice_are_its_spacing_apart(n, spacing):
    slots = make_formation("lattice", n, spacing)
    assert slots.shape == (n, 3) and not slots[0].any()
    np.testing.assert_allclose(pdist(slots).min(), spacing, rtol=1e-12)


@pytest.mark.parametrize("n", [3, 6, 10, 15, 21])
def test_rows_of_a_triangle_are_full(n):
    slots = make_formation("triangle", n)
    last_row = slots[slots[:, 0] < slots[:, 0].min() + 1e-9, 1]
    assert last_row[0] == -last_row[-1] and len(last_row) * (len(last_row) + 1) == 2 * n


def test_given_slots_stay_as_they_are():
    slots = ((-1, 0, -0.8), (-1, 1.2, 0.4), (-1, -1.2, 0.4))
    assert np.array_equal(make_formation(slots, 3, spacing=7.0), np.array(slots))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("triangle", 7), "3, 6, 10, 15, ... vehicles, got 7: take 6 or 10, or the formation 'lattice'"),
        (("triangle", 1), "got 1: take 3, or"),
        (("hexagon", 5), "needs 6 vehicles, got 5"),
        (("triangel", 6), "did you mean 'triangle'"),
        (("lattice", 0), "whole number >= 1"),
        (("lattice", 6.0), "whole number >= 1"),
        (("lattice", 6, 0.3), "0.3 m apart, which must exceed the separation 0.4 m: choose a larger spacing"),
        (("lattice", 6, np.nan), "spacing"),
        ((((0, 0, 0), (0, 0.1, 0)), 2), "slots 0 and 1 .* 0.1 m apart.*move them apart"),
        ((((0, 0, 0), (1, 0, 0)), 3), r"\(3, 3\) array, one row per vehicle, got shape \(2, 3\)"),
        ((((0, 0, 0), (1, np.inf, 0)), 2), "finite and within 1e.06 m, got .* for vehicle 1"),
        ((((0, 0, 0), (1, 0)), 2), "2 rows of three numbers"),
    ],
)
def test_a_formation_that_does_not_fit_is_refused_with_a_remedy(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_formation(*arguments)


def test_line_start_is_in_the_order_of_the_vehicles():
    start = start_positions("line", make_formation("triangle", 6), RNG)
    assert start[:, 1].tolist() == [0, 1, 2, 3, 4, 5] and not start[:, [0, 2]].any()


def test_sorted_start_of_the_triangle_is_the_one_of_the_text():
    start = start_positions("sorted", make_formation("triangle", 6), RNG)
    assert start[:, 1].tolist() == [0, -1, 2, -2, 1, 3] and not start[:, [0, 2]].any()


def crossing(a0, a1, b0, b1):
    """Whether segments a and b of the plane cross in their interiors."""

    def side(p, q, r):
        return (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])

    return side(a0, a1, b0) * side(a0, a1, b1) < -1e-9 and side(b0, b1, a0) * side(b0, b1, a1) < -1e-9


@pytest.mark.parametrize(
    ("formation", "n", "across_columns"),
    [("triangle", 6, True), ("hexagon", 6, True), ("lattice", 36, False)],
)
def test_neighbours_in_a_sorted_line_do_not_cross(formation, n, across_columns):
    slots = make_formation(formation, n)
    start = start_positions("sorted", slots, RNG)
    assert len(set(start[:, 1])) == n and start[0, 1] == 0
    for i, j in itertools.pairwise(np.argsort(start[:, 1])):
        # In a long line the rear of a column crosses the front of the next one, whatever the order in each.
        if across_columns or abs(slots[i, 1] - slots[j, 1]) < 1e-9:
            assert not crossing(start[i], slots[i], start[j], slots[j])


@given(n=st.integers(1, 40), seed=st.integers(0, 1000))
def test_random_start_is_a_permutation_of_a_grid(n, seed):
    slots = make_formation("lattice", n)
    start, other = (start_positions("random", slots, np.random.default_rng(seed)) for _ in range(2))
    assert np.array_equal(start, other)
    assert len(np.unique(start[:, :2], axis=0)) == n and np.abs(start[:, 2]).max() < 0.2
    assert n == 1 or pdist(start[:, :2]).min() == 1.0


@settings(deadline=None)
@given(n=st.integers(2, 60), seed=st.integers(0, 1000))
def test_box_start_keeps_the_distance_and_grows_with_the_team(n, seed):
    start = start_positions("box", make_formation("lattice", n), np.random.default_rng(seed), separation=0.5)
    assert pdist(start).min() > 0.5
    assert np.abs(start).max() <= 0.5 * n ** (1 / 3)


def test_a_box_without_room_says_so():
    with pytest.raises(
        ValueError, match=r"no room for 6 vehicles more than 3 m apart .* lower the separation"
    ):
        start_positions("box", make_formation("hexagon", 6), RNG, separation=3.0)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("sortd", "did you mean 'sorted'"),
        (((0, 0, 0), (1, 0, 0), (0, 0, 0)), r"vehicles 0 and 2 start at the same place \[0.0, 0.0, 0.0\]"),
        (((0, 0, 0), (1, 0, 0)), "got shape"),
        (((0, 0, 0), (1, 0, 0), (np.nan, 0, 0)), "finite"),
    ],
)
def test_an_impossible_start_is_refused(kind, message):
    with pytest.raises(ValueError, match=message):
        start_positions(kind, make_formation("lattice", 3), RNG)


def test_given_positions_are_the_start():
    given_start = [[0, 0, 0], [4, 0, -1], [0, 4, 1]]
    assert np.array_equal(start_positions(given_start, make_formation("lattice", 3), RNG), given_start)
