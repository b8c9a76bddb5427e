"""Plain Python objects and mappings where a reference, target, disturbance or graph is asked for."""

import json
import math

import gymnasium as gym
import numpy as np
import pytest

from quad_envs import formation_v0, target_tracking_v0
from quad_envs.arguments.kinds import make_kind, mapping_of
from quad_envs.disturbances import DISTURBANCES, Steady, TorquePulse, make_disturbance
from quad_envs.graphs import KINDS, Switching, Timed, make_graph, make_graph_table
from quad_envs.references import REFERENCES, ArrayTable, Heading, Helix, Line, SetPoint, make_reference
from quad_envs.targets import TARGETS, PathTarget, StaticTarget, TurningTarget, make_target

HELIX = "quad/HelixTracking-v0"
T = 0.05 * np.arange(201)
P = np.stack([2 * np.sin(0.6 * T), 2 - 2 * np.cos(0.6 * T), -0.1 * T], axis=1)
V = np.stack([1.2 * np.cos(0.6 * T), 1.2 * np.sin(0.6 * T), 0 * T - 0.1], axis=1)
PSI = 0.3 * np.sin(T)
TURN = np.column_stack([np.sin(PSI), np.cos(PSI)])


def reference_of(what, **kwargs):
    return gym.make(HELIX, reference=what, **kwargs).unwrapped.reference[:201]


@pytest.mark.parametrize(
    "columns", [[P], [P, PSI], [P, TURN], [P, V], [P, V, PSI], [P, V, TURN]], ids=lambda c: f"{len(c)} parts"
)
@pytest.mark.parametrize("form", [np.asarray, np.ndarray.tolist])
def test_an_array_is_a_row_per_control_period(columns, form):
    found = reference_of(form(np.column_stack(columns)))
    np.testing.assert_allclose(found[:, :3], P, atol=1e-12)
    # Without velocities they are central differences, of first order at the two ends.
    given = any(part is V for part in columns)
    inner = slice(0, None) if given else slice(1, -1)
    np.testing.assert_allclose(found[inner, 3:6], V[inner], atol=1e-12 if given else 2e-4)
    turns = TURN if len(columns[-1].shape) == 1 or columns[-1] is TURN else np.tile([0.0, 1.0], (201, 1))
    np.testing.assert_allclose(found[:, 6:8], turns, atol=1e-12)


def test_an_array_of_another_rate_says_so():
    found = reference_of(ArrayTable(P[::4], dt=0.2))
    # The slope at both ends is one-sided, wrong by h / 2 of 0.72 m/s^2; a cubic makes 4 h / 27 of it: 2.2 mm.
    np.testing.assert_allclose(found[:, :3], P, atol=2.2e-3)


def test_an_array_shorter_than_the_episode_warns_and_can_set_its_length():
    with pytest.warns(UserWarning, match="given from 0 to 5 s, the episode is from 0 to 10 s"):
        gym.make(HELIX, reference=P[:101])
    assert gym.make(HELIX, reference=P[:101], time_limit="reference").unwrapped.task.episode_steps == 100


def test_times_in_the_first_column_are_suspected():
    with pytest.warns(UserWarning, match="first column increases as times do.*x, y, z, psi"):
        gym.make(HELIX, reference=np.column_stack([T, P]))


def test_columns_and_data_frames_are_tables():
    class Frame:
        """What is asked of a data frame, of whatever library."""

        columns = ("time", "x", "y", "z")

        def __getitem__(self, name):
            return dict(zip(self.columns, (T, *P.T), strict=True))[name]

        def to_numpy(self):
            return np.column_stack([T, P])

    for what in ({"t": T, "x": P[:, 0], "y": P[:, 1], "z": P[:, 2]}, Frame()):
        np.testing.assert_allclose(reference_of(what)[:, :3], P, atol=1e-12)


def test_functions_set_points_and_mappings_are_references():
    def circle(t):
        return (2 * np.sin(0.6 * t), 2 - 2 * np.cos(0.6 * t), -0.1 * t)

    np.testing.assert_allclose(reference_of(circle)[:, :3], P, atol=1e-12)
    assert make_reference((1, 2, 3)) == SetPoint((1.0, 2.0, 3.0))
    assert make_reference([1, 2, 3, 0.5]) == Heading(SetPoint((1.0, 2.0, 3.0)), yaw=0.5)
    assert make_reference({"kind": "helix", "radius": 2}) == Helix(radius=2)
    assert make_reference({"kind": "slow-helix", "rate": 0.5}) == Helix(2.0, 0.5, -0.1)
    nested = {"kind": "heading", "rate": 0.3, "reference": {"kind": "line", "velocity": [1, 0, 0]}}
    assert make_reference(nested) == Heading(Line((1, 0, 0)), rate=0.3)


def test_a_file_takes_its_options_in_a_mapping(tmp_path):
    path = tmp_path / "up.csv"
    path.write_text("t,x,y,z\n" + "\n".join(f"{t},0,0,{0.1 * t}" for t in range(11)) + "\n")
    found = reference_of({"kind": "csv", "path": str(path), "axes": "enu"})
    np.testing.assert_allclose(found[-1, :3], [0, 0, -1], atol=1e-12)
    target = make_target({"kind": "csv", "path": str(path), "axes": "enu"})
    np.testing.assert_allclose(target.rows(np.array([10.0]), None)[0, :3], [0, 0, -1], atol=1e-12)


def test_plain_objects_are_targets():
    assert make_target((1, 2, 3)) == StaticTarget((1.0, 2.0, 3.0))
    assert make_target({"kind": "turn", "rate": 0.1}) == TurningTarget(rate=0.1)
    assert make_target({"kind": "helix", "radius": 1}) == PathTarget(Helix(radius=1))
    assert make_target({"kind": "path", "path": "helix"}) == PathTarget(PathTarget(Helix()))
    for what in (lambda t: (3 + 0.5 * t, 0, 0), np.column_stack([3 + 0.5 * T, 0 * T, 0 * T])):
        target = target_tracking_v0.parallel_env(target=what, time_limit=10.0)
        target.reset(seed=0)
        np.testing.assert_allclose(
            target.target[::100, :4], [[3, 0, 0, 0.5], [5.5, 0, 0, 0.5], [8, 0, 0, 0.5]]
        )


def test_plain_objects_are_disturbances():
    assert make_disturbance((0.1, 0, 0)) == Steady(force=(0.1, 0, 0))
    assert make_disturbance([0.1, 0, 0, 0, 0.01, 0]) == Steady(force=(0.1, 0, 0), torque=(0, 0.01, 0))
    assert make_disturbance(np.array([0.1, 0, 0])) == Steady(force=(0.1, 0.0, 0.0))
    assert make_disturbance({"kind": "torque-pulse", "stop": 6}) == TorquePulse(stop=6)
    env = gym.make(HELIX, disturbance=lambda t: (0.2 if t >= 1.0 else 0.0, 0, 0), reveal_disturbance=True)
    layout = env.unwrapped.task.layout.slices
    observations = [env.reset(seed=0)[0], *(env.step(np.zeros(4, np.float32))[0] for _ in range(21))]
    force = np.array([observation[layout["disturbance"]][3] for observation in observations])
    # A period is before the step or after it, and never between.
    np.testing.assert_array_equal(force, np.float32([0.0] * 20 + [0.2] * 2))


def test_edges_and_graphs_of_networkx_are_graphs():
    networkx = pytest.importorskip("networkx")
    chain = make_graph("chain", None, 4)
    edges = [(0, 1), (1, 2), (2, 3)]
    assert np.array_equal(make_graph(edges, None, 4), chain)
    assert np.array_equal(make_graph(tuple(edges), None, 4), chain)
    assert np.array_equal(make_graph(np.array(edges), None, 4), chain)
    assert np.array_equal(make_graph(set(edges), None, 4), chain)
    assert np.array_equal(make_graph(networkx.DiGraph(edges), None, 4), chain)
    both = np.maximum(chain, chain.T)
    assert np.array_equal(make_graph(networkx.Graph(edges), None, 4), both)
    assert np.array_equal(make_graph([], None, 4), np.eye(4))
    weighted = networkx.DiGraph()
    weighted.add_edge(0, 1, weight=2.5)
    weighted.add_edge(1, 2)
    expected = np.eye(3)
    expected[1, 0], expected[2, 1] = 2.5, 1.0
    assert np.array_equal(make_graph(weighted, None, 3), expected)
    assert np.array_equal(make_graph([(0, 1, 2.5), (1, 2)], None, 3), expected)


def test_teams_fly_on_edges_and_on_schedules_of_them():
    networkx = pytest.importorskip("networkx")
    edges = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)]
    for graph in (edges, networkx.DiGraph(edges), np.array(edges)):
        env = formation_v0.parallel_env(graph=graph)
        assert np.array_equal(env.graphs.graphs[0] > 0, make_graph("chain", None, 6) > 0)
    plan = {"kind": "switching", "graphs": [edges, "star"], "dwell_steps": 3}
    table = make_graph_table(plan, None, 6, 10, 0.05)
    assert table.which.tolist() == [0, 0, 0, 1, 1, 1, 0, 0, 0, 1, 1]
    other = make_graph_table(Switching((networkx.DiGraph(edges), "star"), 3), None, 6, 10, 0.05)
    assert np.array_equal(table.graphs, other.graphs)
    timed = {"kind": "timed", "graphs": ["chain", edges], "times": [0, 1]}
    assert make_graph_table(timed, None, 6, 10, 0.05).which.max() == 0


VALUES = [
    (REFERENCES, Helix(radius=2.0)),
    (REFERENCES, Helix()),
    (REFERENCES, Heading(Line((1.0, 0.0, 0.0)), rate=0.3)),
    (REFERENCES, SetPoint((1.0, 2.0, 3.0))),
    (DISTURBANCES, Steady(force=(0.1, 0.0, 0.0))),
    (TARGETS, TurningTarget(rate=0.1)),
    (TARGETS, PathTarget(Helix(radius=1.0))),
    (KINDS, Switching(("chain", "star"), 3)),
    (KINDS, Timed(("chain", "star"), (0.0, 1.0))),
]


@pytest.mark.parametrize(("kinds", "value"), VALUES, ids=lambda value: type(value).__name__)
def test_a_value_survives_as_a_mapping_in_json(kinds, value):
    def plain(part):
        mapping = mapping_of(part, {**REFERENCES, **TARGETS}, plain)
        return part if mapping is None else mapping

    mapping = json.loads(json.dumps(mapping_of(value, kinds, plain)))
    parts = {"reference": make_reference, "path": make_reference}
    assert make_kind("value", mapping, kinds, parts) == value


def test_every_kind_with_defaults_is_made_by_its_name():
    for kinds, make in (
        (REFERENCES, make_reference),
        (DISTURBANCES, make_disturbance),
        (TARGETS, make_target),
    ):
        for name, entry in kinds.items():
            if not isinstance(entry, type):
                assert make(name) == make({"kind": name}) == entry


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: make_reference({"kind": "hleix"}),
            "unknown kind of reference 'hleix'; did you mean 'helix'",
        ),
        (lambda: make_reference({"kind": "helix", "radios": 2}), "'radios'; did you mean 'radius'"),
        (
            lambda: make_reference({"kind": "helix", "radius": "2"}),
            "radius of .* a finite number, as 6.0, got '2'",
        ),
        (lambda: make_reference({"kind": "helix", "radius": True}), "must be a finite number"),
        (lambda: make_reference({"kind": "helix", "radius": math.inf}), "must be a finite number"),
        (
            lambda: make_reference({"kind": "line", "velocity": [1, 0]}),
            "velocity of .* must be 3 finite numbers",
        ),
        (lambda: make_reference({"kind": "random", "harmonics": 2.5}), "must be a whole number, got 2.5"),
        (
            lambda: make_reference({"kind": "heading", "reference": "line", "tangent": 1}),
            "must be true or false",
        ),
        (lambda: make_reference({"kind": "csv"}), "the reference 'csv' needs path, as"),
        (lambda: make_reference({"kind": "csv", "path": 3}), "path must be that of a table, got 3"),
        (lambda: make_reference("~nobody-of-this-name/a.csv"), "home directory"),
        (lambda: make_reference({"kind": "columns", "columns": 3}), "columns must be a mapping from names"),
        (lambda: make_reference([10**400] * 3), "2 or more rows of 3 to 8 columns"),
        (lambda: make_disturbance([10**400] * 3), "a force of 3 finite numbers"),
        (lambda: make_graph([[10**400] * 4] * 4, None, 4), "a graph is a name"),
        (lambda: make_kind("graph", {"kind": "timed", "graphs": ["star"], "times": 3}, KINDS), "got 3"),
        (lambda: make_reference("heading"), "the reference 'heading' needs reference"),
        (lambda: make_reference({"kind": 3}), "unknown kind of reference 3"),
        (lambda: make_reference({"radius": 3}), "the header must name t, x, y, z"),
        (lambda: make_reference(Helix), r"got the class Helix: write Helix\(...\)"),
        (lambda: make_reference(3), "reference must be a name, .* or a Reference, got 3"),
        (lambda: make_reference(None), "got None"),
        (lambda: make_reference(P.T), r"2 or more rows of 3 to 8 columns .*, got shape \(3, 201\)"),
        (lambda: make_reference([[0, 0, 0], [0, 0]]), r"rows of 3 to 8 columns .*, got \[\[0, 0, 0\]"),
        (lambda: make_reference(np.full((5, 3), math.nan)), "row 0 of the reference must be finite"),
        (lambda: make_target(Helix), "target must be a value"),
        (lambda: make_target({"kind": "trun"}), "unknown kind of target 'trun'; did you mean 'turn'"),
        (lambda: make_disturbance((1, 2)), r"a force of 3 finite numbers, N .*, got \(1, 2\)"),
        (lambda: make_disturbance((1, 2, math.nan)), "a force of 3 finite numbers"),
        (lambda: make_disturbance({"kind": "gust"}), "did you mean 'gusts'"),
        (lambda: make_disturbance({"kind": "gusts", "force": -1}), "standard deviation >= 0"),
        (lambda: make_disturbance(Steady), "disturbance must be a value"),
        (lambda: gym.make(HELIX, disturbance=lambda t: (1, 2)), "must return 3 .force. or 6 .force, torque."),
        (lambda: gym.make(HELIX, disturbance=lambda t: (math.nan, 0, 0)), "not finite at t = 0 s"),
        (lambda: make_graph([(0, 4)], None, 4), r"two different vehicles of 0 \.\. 3, got \(0, 4\)"),
        (lambda: make_graph([(0, "b")], None, 4), "two different vehicles"),
        (lambda: make_graph([(0, 1, -1)], None, 4), r"must be a finite number > 0, got -1 of \(0, 1\)"),
        (lambda: make_graph_table({"kind": "swiching"}, None, 4, 5, 0.05), "did you mean 'switching'"),
        (lambda: make_graph_table(Switching, None, 4, 5, 0.05), "graph must be a value"),
    ],
)
def test_what_is_no_such_object_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_nodes_that_are_no_numbers_of_vehicles_are_refused():
    networkx = pytest.importorskip("networkx")
    with pytest.raises(ValueError, match=r"must be 0 \.\. 1, .*convert_node_labels_to_integers"):
        make_graph(networkx.DiGraph([("a", "b")]), None, 2)
