"""Graphs hear the right way round, trees are found as other algorithms find them, schedules become tables."""

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.sparse.csgraph import breadth_first_order, shortest_path

from quad_envs.formations import FORMATIONS
from quad_envs.graphs import (
    GRAPHS,
    TRIANGLE_SUBGRAPHS,
    Switching,
    Timed,
    adjacency,
    has_spanning_tree,
    hops,
    in_neighbours,
    make_graph,
    make_graph_table,
    toward_leader,
    union_has_tree,
)

STEPS, DT = 200, 0.05
links = st.integers(1, 9).flatmap(lambda n: arrays(np.bool_, (n, n)))


def edges_of(G):
    """(sender, receiver) pairs, vehicles counted from 1 as in the text."""
    return {(int(j) + 1, int(i) + 1) for i, j in np.argwhere(G > 0) if i != j}


def random_graph(mask):
    return np.where(mask | np.eye(len(mask), dtype=bool), 1.0, 0.0)


def test_the_receiver_hears_the_sender():
    G = adjacency(3, [(0, 2)])
    assert G.tolist() == [[1, 0, 0], [0, 1, 0], [1, 0, 1]]


@pytest.mark.parametrize(
    ("name", "formation", "expected"),
    [
        ("weak", "triangle", {(1, 2), (1, 3), (2, 4), (3, 5), (3, 6)}),
        ("weak", "hexagon", {(1, 2), (1, 6), (2, 3), (6, 5), (3, 4)}),
        ("case-1", None, {(1, 2), (2, 4), (4, 6), (6, 5), (5, 3), (3, 1)}),
        ("case-2", None, {(1, 2), (2, 1), (1, 3), (3, 1), (2, 4), (3, 5), (4, 6), (5, 6)}),
        ("chain", None, {(1, 2), (2, 3), (3, 4), (4, 5), (5, 6)}),
        ("star", None, {(1, 2), (1, 3), (1, 4), (1, 5), (1, 6)}),
        ("ring", None, {(1, 2), (2, 3), (3, 4), (4, 5), (5, 6), (6, 1)}),
    ],
)
def test_named_graphs_have_the_edges_of_the_text(name, formation, expected):
    if name in ("ring", "case-1"):
        expected |= {(b, a) for a, b in expected}
    assert edges_of(make_graph(name, formation, 6)) == expected


@pytest.mark.parametrize(("formation", "heard"), [("triangle", {2, 3}), ("hexagon", {2, 6})])
def test_strong_graph_is_complete_among_followers_and_has_two_links_of_the_leader(formation, heard):
    complete = {(a, b) for a in range(2, 7) for b in range(2, 7) if a != b}
    assert edges_of(make_graph("strong", formation, 6)) == complete | {(1, b) for b in heard}


@pytest.mark.parametrize("formation", FORMATIONS)
@pytest.mark.parametrize("name", GRAPHS)
def test_every_named_graph_has_a_tree_rooted_at_the_leader(formation, name):
    assert has_spanning_tree(make_graph(name, formation, 6))


@given(n=st.integers(1, 60))
def test_weak_lattice_is_a_tree_as_deep_as_the_lattice_has_rows(n):
    G = make_graph("weak", "lattice", n)
    assert len(edges_of(G)) == n - 1 and has_spanning_tree(G)
    row = int((np.sqrt(8 * (n - 1) + 1) - 1) // 2)
    assert hops(G).max() == row


@given(mask=links, root=st.integers(0, 8))
def test_hops_are_the_shortest_paths_of_another_algorithm(mask, root):
    G, root = random_graph(mask), root % len(mask)
    lengths = shortest_path(G.T - np.eye(len(G)), unweighted=True, indices=root)
    assert np.array_equal(hops(G, root), np.where(np.isfinite(lengths), lengths, -1))


@given(mask=links)
def test_a_spanning_tree_exists_where_a_power_of_the_graph_has_a_full_column(mask):
    G = random_graph(mask)
    reach = np.linalg.matrix_power(G, len(G))
    assert has_spanning_tree(G) == bool((reach[:, 0] > 0).all())


@given(masks=st.integers(2, 7).flatmap(lambda n: arrays(np.bool_, (3, n, n))))
def test_union_has_a_tree_where_another_search_reaches_everybody(masks):
    Gs = np.stack([random_graph(mask) for mask in masks])
    reached = breadth_first_order(Gs.sum(axis=0).T, 0, return_predecessors=False)
    assert union_has_tree(Gs) == (len(reached) == Gs.shape[1])


def test_subgraphs_of_the_triangle_have_no_tree_and_their_union_is_its_weak_graph():
    Gs = np.array(TRIANGLE_SUBGRAPHS)
    assert not any(has_spanning_tree(G) for G in Gs) and union_has_tree(Gs)
    assert np.array_equal(Gs.max(axis=0), make_graph("weak", "triangle", 6))


def test_without_one_link_the_union_of_the_subgraphs_has_no_tree():
    Gs = np.array(TRIANGLE_SUBGRAPHS)
    Gs[:, 2, 0] = 0.0
    assert not union_has_tree(Gs)


def test_toward_leader_weighs_whoever_is_nearer_to_it():
    G = toward_leader(make_graph("strong", "triangle", 6))
    assert G[1, 0] == G[2, 0] == 10.0
    assert (G[3:, 1:3] == 10.0).all() and G[1, 2] == 1.0
    assert (G[1:3, 3:] == 1.0).all() and (G[3:, 3:] == 1.0).all()


@given(mask=links, weight=st.floats(1.0, 20.0))
def test_toward_leader_neither_adds_nor_removes_links(mask, weight):
    G = random_graph(mask)
    weighted = toward_leader(G, weight)
    assert np.array_equal(weighted > 0, G > 0) and (np.diag(weighted) == 1.0).all()


def test_in_neighbours_are_ascending_over_the_union_of_all_graphs():
    table = make_graph_table("chapter-6", None, 4, STEPS, DT)
    assert in_neighbours(table.graphs).tolist() == [[1, 2, 3], [0, 2, 3], [0, 3, -1], [1, 2, -1]]


@given(mask=links)
def test_in_neighbours_of_one_graph_are_its_rows(mask):
    G = random_graph(mask)
    rows = [[int(j) for j in row if j >= 0] for row in in_neighbours(G)]
    assert rows == [[j for j in range(len(G)) if j != i and G[i, j] > 0] for i in range(len(G))]


def test_chapter_6_gives_each_vehicle_the_measurements_of_the_figures():
    table = make_graph_table("chapter-6", None, 4, STEPS, DT)
    held = [[(np.flatnonzero(row) + 1).tolist() for row in G] for G in table.graphs]
    assert held == [
        [[1, 2, 3, 4], [2, 3], [1, 3, 4], [3, 4]],
        [[1, 2, 3], [2, 3, 4], [3, 4], [3, 4]],
        [[1, 2], [1, 2, 3, 4], [3, 4], [2, 3, 4]],
    ]
    assert table.which[[0, 49, 50, 99, 100, 200]].tolist() == [0, 0, 1, 1, 2, 2]


@pytest.mark.parametrize("dwell", [1, 5, 20])
def test_switching_graphs_hold_in_turn(dwell):
    table = make_graph_table(Switching(dwell_steps=dwell), "triangle", 6, STEPS, DT)
    assert table.which.shape == (STEPS + 1,) and table.which.dtype == np.int64
    assert table.which.tolist() == [(k // dwell) % 3 for k in range(STEPS + 1)]
    assert np.array_equal(table.graphs, np.array(TRIANGLE_SUBGRAPHS))


@pytest.mark.parametrize("dt", [0.05, 0.1, 0.02, 1 / 30])
def test_a_timed_graph_begins_at_the_step_of_its_time(dt):
    for k in range(1, 60):
        table = make_graph_table(Timed(("chain", "star"), (0.0, k * dt)), None, 4, 60, dt)
        assert int(np.argmax(table.which)) == k


def test_a_function_of_the_step_is_a_schedule_whose_equal_graphs_are_one():
    table = make_graph_table(lambda k: "star" if k % 3 else np.eye(4), None, 4, 7, DT)
    assert table.which.tolist() == [0, 1, 1, 0, 1, 1, 0, 1]
    assert np.array_equal(table.graphs, [np.eye(4), make_graph("star", None, 4)])


def test_graphs_after_the_end_of_the_episode_are_not_in_its_table():
    table = make_graph_table(Timed(("chain", "star"), (0.0, 30.0)), None, 4, STEPS, DT)
    assert len(table.graphs) == 1 and not table.which.any()


def test_one_graph_is_a_table_of_one():
    table = make_graph_table("weak", "hexagon", 6, 3, DT)
    assert table.graphs.shape == (1, 6, 6) and table.which.tolist() == [0, 0, 0, 0]


def test_a_schedule_is_a_value():
    first = Timed([np.eye(2), [[1, 0], [1, 1]]], [0, 1])
    assert first == Timed((np.eye(2), np.array([[1, 0], [1, 1]])), (0.0, 1.0))
    assert hash(first) == hash(pickle.loads(pickle.dumps(first)))


def test_a_matrix_gives_weights_and_its_diagonal_is_not_read():
    given_weights = np.array([[0.0, 0.0], [3.0, 7.0]])
    assert make_graph(given_weights, None, 2).tolist() == [[1, 0], [3, 1]]
    assert given_weights[1, 1] == 7.0


@pytest.mark.parametrize(
    ("what", "formation", "n", "message"),
    [
        ("weak", None, 6, r"belongs to the formations triangle, hexagon, lattice; .* take chain, ring, star"),
        ("strong", "mine", 6, "belongs to the formations"),
        ("weak", "hexagon", 7, "of a hexagon has 6 vehicles, got 7"),
        ("chian", None, 6, "did you mean 'chain'"),
        ("case-1", None, 5, "has 6 vehicles, got 5"),
        ("chapter-6", None, 6, "has 4 vehicles, got 6"),
        (np.eye(3), None, 4, r"\(4, 4\) matrix, got shape \(3, 3\)"),
        ([[1, -1], [0, 1]], None, 2, r"got -1.0 at \[0, 1\]"),
        ([[1, np.nan], [0, 1]], None, 2, "finite"),
        ([[1, 0], [0]], None, 2, "matrix of weights"),
        (lambda k: "nonsense", None, 3, "unknown graph 'nonsense'"),
        (Switching(("weak",)), None, 3, "belongs to the formations"),
    ],
)
def test_a_graph_that_does_not_fit_is_refused(what, formation, n, message):
    with pytest.raises(ValueError, match=message):
        make_graph_table(what, formation, n, STEPS, DT)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: adjacency(3, [(0, 3)]), r"two different vehicles of 0 \.\. 2"),
        (lambda: adjacency(3, [(1, 1)]), "two different vehicles"),
        (lambda: Switching(()), "at least one graph"),
        (lambda: Switching("weak"), "single name 'weak'"),
        (lambda: Switching(dwell_steps=0), "integer >= 1"),
        (lambda: Timed(("star",), (1.0,)), "start at 0 s and increase"),
        (lambda: Timed(("star", "chain"), (0.0, 0.0)), "start at 0 s and increase"),
        (lambda: Timed(("star", "chain"), (0.0,)), "one time per graph"),
    ],
)
def test_a_broken_schedule_is_refused_at_construction(make, message):
    with pytest.raises(ValueError, match=message):
        make()
