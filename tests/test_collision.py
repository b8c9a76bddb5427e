"""Separation rows: each rule against its equations, and the promises of a pair."""

from __future__ import annotations

import math

import numpy as np
import pytest
from formation_flights import at_rest, messages, sensed_rows, team_task, velocities

from controllers.team.collision import COLLISION_SCRATCH, AvoidanceOptions, separation_rows
from quad_envs.rotations import rotation_body_from_inertial

N, DT, D_S, R_S = 5, 0.05, 0.4, 2.0
NOBODY, NO_PLAN, NO_TURN = np.zeros((0, 15)), np.zeros(0), np.zeros((3, 3))


def some_team(rng, n=4, spread=0.5):
    task = team_task(n, neighbours=n - 1, sensed=n - 1, plan=N)
    plants = at_rest(spread * rng.normal(size=(n, 3)), task)
    plants[:, 3:12] = rng.normal(size=(n, 9)) * np.repeat([1.0, 0.4, 0.5], 3)
    plants[:, 8] = rng.uniform(-3, 3, n)
    return task, plants


class Rows:
    """The rows of one vehicle, evaluated on inertial predictions."""

    def __init__(self, options, plant, v, comm=NOBODY, sensed=NOBODY[:, :7], own=NO_PLAN, D=NO_TURN):
        slots = len(comm) if options.avoidance_set == "edges" else len(sensed)
        layout = options.separation_layout(slots, N)
        self.normals, self.lower = np.zeros_like(layout.normals), layout.lower.copy()
        arguments = np.ascontiguousarray(comm), np.ascontiguousarray(sensed), own, N
        data = options.avoidance_data(D_S, R_S, DT)
        self.used = separation_rows(
            plant, v, *arguments, data, D, self.normals, self.lower, np.zeros(6),
            np.zeros(COLLISION_SCRATCH),
        )  # fmt: skip
        self.normal, self.stage = layout.normal, layout.stage
        self.R_BI = rotation_body_from_inertial(plant[6:9])
        self.turn = rotation_body_from_inertial([0.0, 0.0, plant[8]])

    def slack(self, p, v):
        """Value less bound of every row, for positions relative to the vehicle and velocities, (N+1, 3)."""
        x = np.zeros((N + 1, 12))
        x[:, :3], x[:, 3:6] = p @ self.turn.T, v @ self.R_BI.T
        return np.einsum("kn,kn->k", self.normals[self.normal], x[self.stage]) - self.lower


def predictions(rng):
    return rng.normal(size=(N + 1, 3)), rng.normal(size=(N + 1, 3))


@pytest.mark.parametrize("moving", [True, False])
@pytest.mark.parametrize("braking", [0.0, 0.25])
def test_rows_are_those_of_the_equations(moving, braking):
    rng = np.random.default_rng(0)
    options = AvoidanceOptions(moving_centre=moving, braking_time=braking)
    task, plants = some_team(rng)
    v, sensed = velocities(plants), sensed_rows(plants, task)
    rows, (p, w) = Rows(options, plants[0], v[0], sensed=sensed[0]), predictions(rng)
    expected, swirl, kept = [], math.radians(5), (D_S + options.separation_margin) / 2
    turn = np.array([[np.cos(swirl), -np.sin(swirl), 0], [np.sin(swirl), np.cos(swirl), 0], [0, 0, 1]])
    for row in sensed[0][: rows.used]:
        p_j, v_j = row[1:4], row[4:7] + v[0]
        a = turn @ -p_j / np.linalg.norm(p_j)
        for n in range(1, N + 1):
            centre = p_j / 2 + n * DT * (v[0] + v_j) / 2 * moving
            expected.append(a @ p[n] - a @ centre - kept)
        if braking:
            centre = p_j / 2 + (N * DT + braking) * (v[0] + v_j) / 2 * moving
            expected.append(a @ (p[N] + braking * w[N]) - a @ centre - kept)
    assert rows.used == 3
    np.testing.assert_allclose(rows.slack(p, w), expected, atol=1e-12)


def test_the_rows_of_a_pair_add_up_to_the_separation():
    rng, options = np.random.default_rng(1), AvoidanceOptions()
    for _ in range(20):
        task, plants = some_team(rng, 2, 0.4)
        v, sensed = velocities(plants), sensed_rows(plants, task)
        plans = [predictions(rng), predictions(rng)]
        slack = sum(
            Rows(options, plants[i], v[i], sensed=sensed[i]).slack(*plan) for i, plan in enumerate(plans)
        )
        d = plants[0, :3] - plants[1, :3]
        a = rotation_body_from_inertial([0, 0, -options.swirl]) @ d / np.linalg.norm(d)
        apart = (plans[0][0] + plants[0, :3]) - (plans[1][0] + plants[1, :3])
        closing = plans[0][1][N] - plans[1][1][N]
        expected = (
            np.append(apart[1:] @ a, a @ (apart[N] + options.braking * closing))
            - D_S
            - options.separation_margin
        )
        np.testing.assert_allclose(slack, expected, atol=1e-12)


def test_the_text_keeps_the_whole_separation_from_a_neighbour_that_stands_still():
    rng, options = np.random.default_rng(2), AvoidanceOptions("frozen")
    task, plants = some_team(rng, 2)
    v, sensed = velocities(plants), sensed_rows(plants, task)
    rows, (p, w) = Rows(options, plants[0], v[0], sensed=sensed[0]), predictions(rng)
    p_j = sensed[0, 0, 1:4]
    a = -p_j / np.linalg.norm(p_j)
    assert len(rows.lower) == N
    np.testing.assert_allclose(rows.slack(p, w), (p[1:] - p_j) @ a - D_S, atol=1e-12)


@pytest.mark.parametrize("known", [True, False])
def test_the_plan_rule_separates_the_two_last_plans(known):
    """Without the neighbour's plan it keeps its velocity; the own plan starts at the present position."""
    rng, options = np.random.default_rng(3), AvoidanceOptions("plan")
    task, plants = some_team(rng, 2)
    v, sensed, plans = velocities(plants), sensed_rows(plants, task), rng.normal(size=(2, N, 6))
    comm = messages(plants, np.ones((2, 2)), np.zeros((2, 3)), task, plans if known else None)[0]
    own = rng.normal(size=(N, 6))
    rows = Rows(options, plants[0], v[0], comm if known else comm[:0], sensed[0], own.ravel())
    (p, w), expected = predictions(rng), []
    for n in range(1, N + 1):
        mine = own[n, :3] if n < N else own[N - 1, :3] + DT * own[N - 1, 3:]
        p_j = plants[1, :3] + n * DT * v[1]
        if known:
            p_j = plans[1, n, :3] if n < N else plans[1, N - 1, :3] + DT * plans[1, N - 1, 3:]
        theirs = p_j - plants[0, :3]
        a = mine - own[0, :3] - theirs
        expected.append((p[n] - theirs) @ a / np.linalg.norm(a) - D_S)
    np.testing.assert_allclose(rows.slack(p, w), expected, atol=1e-12)


def test_edges_give_rows_for_those_it_hears_within_the_radius():
    rng = np.random.default_rng(4)
    task, plants = some_team(rng)
    plants[3, :3] = plants[0, :3] + 3.0
    v, sensed = velocities(plants), sensed_rows(plants, task)
    comm = messages(plants, np.ones((4, 4)), np.zeros((4, 3)), task)[0]
    heard = Rows(AvoidanceOptions(avoidance_set="edges"), plants[0], v[0], comm=comm, sensed=sensed[0])
    assert heard.used == 2
    same = Rows(AvoidanceOptions(), plants[0], v[0], sensed=sensed[0])
    np.testing.assert_allclose(np.sort(heard.lower[:12]), np.sort(same.lower[:12]), atol=1e-12)
    old = comm.copy()  # sent 0.3 s ago by vehicles of constant velocity
    old[:, 1], old[:, 2:5] = 0.3, comm[:, 2:5] - 0.3 * (comm[:, 5:8] + v[0])
    late = Rows(AvoidanceOptions(avoidance_set="edges"), plants[0], v[0], comm=old)
    np.testing.assert_allclose(late.lower[:12], heard.lower[:12], atol=1e-12)


def test_vehicles_at_one_place_are_skipped():
    task, plants = some_team(np.random.default_rng(5), 3)
    plants[1, :3] = plants[0, :3] + 1e-10
    v, sensed = velocities(plants), sensed_rows(plants, task)
    for rule in ("reciprocal", "frozen", "plan"):
        rows = Rows(AvoidanceOptions(rule), plants[0], v[0], sensed=sensed[0])
        assert rows.used == 1
        assert np.isfinite(rows.normals).all()


def test_nobody_and_no_rule_make_no_rows():
    _, plants = some_team(np.random.default_rng(6), 2)
    assert Rows(AvoidanceOptions(), plants[0], np.zeros(3)).used == 0
    empty = Rows(AvoidanceOptions(), plants[0], np.zeros(3), sensed=np.zeros((4, 7)))
    assert empty.used == 0
    assert len(AvoidanceOptions("none").separation_layout(4, N).normal) == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"avoidance": "hard"},
            "avoidance must be one of 'reciprocal', 'frozen', 'plan', 'none', got 'hard'",
        ),
        ({"avoidance_set": "all"}, "avoidance_set must be one of 'sensed', 'edges'"),
        ({"braking_time": -0.1}, "braking_time must be finite and >= 0 s"),
        ({"swirl": 2.0}, "swirl must lie in"),
        ({"separation_weight": 0.0}, "separation_weight must be > 0"),
    ],
)
def test_an_option_that_is_not_allowed_is_named(options, message):
    with pytest.raises(ValueError, match=message):
        AvoidanceOptions(**options)


def test_an_option_by_its_name_of_before_is_refused_with_that_of_today():
    with pytest.raises(TypeError, match="AvoidanceOptions calls weight now separation_weight"):
        AvoidanceOptions(weight=1.0)
