"""The MPC of a team: single decisions against independent solutions, invariances, and failures by name."""

from __future__ import annotations

import pickle

import daqp
import numpy as np
import pytest
from formation_flights import (
    LINE_START,
    TRIANGLE,
    WEAK_TRIANGLE,
    at_rest,
    decide,
    line,
    messages,
    sensed_rows,
    team_task,
    velocities,
)

from controllers import CooperativeOptions, TeamSituation
from controllers.fallback import Fallback
from controllers.qp import StructuredSolver, residuals
from controllers.qp.ocp import condense
from controllers.team.central import level_frame_weight
from controllers.team.cooperative import CooperativeMpc
from controllers.team.cooperative_kernels import level_weight
from quad_envs.dynamics import simulate
from quad_envs.rotations import rotation_body_from_inertial

N = 5
ALL = np.ones((6, 6))


@pytest.fixture(scope="module")
def mpc():
    return CooperativeMpc(team_task())


def crowd(seed, n=6, spread=0.6):
    """Vehicles on top of each other, tilted and fast: many rows are active."""
    rng = np.random.default_rng(seed)
    plants = at_rest(spread * rng.normal(size=(n, 3)), team_task())
    plants[:, 3:12] = rng.normal(size=(n, 9)) * np.repeat([1.0, 0.2, 0.3], 3)
    plants[:, 8] = rng.uniform(-3, 3, n)
    return plants


def situation_of(task, plants):
    n = len(plants)
    comm, sensed = messages(plants, np.ones((n, n)), TRIANGLE, task), sensed_rows(plants, task)
    return TeamSituation(plants, np.full((n, 4), task.hover_force), comm, sensed, np.arange(n) == 0)


def some_rows(situation, which):
    """The situation of some vehicles, in another order."""
    return TeamSituation._make(None if part is None else np.asarray(part)[which] for part in situation)


def solve_dense(qp):
    """The problem in inputs and slacks by DAQP; a slack's own weight of 1e-2 moves its penalty by 1e-6."""
    part, rows = condense(qp), qp.rows
    nv, K = len(part.g), len(rows.normal)
    normals = rows.normals[rows.normal]
    value = np.einsum("ka,ka->k", normals, part.f[rows.stage])
    matrix = np.einsum("ka,kau->ku", normals, part.S[rows.stage])
    A = np.block([[matrix, np.eye(K)], [matrix, -np.eye(K)]])
    H, g = 1e-2 * np.eye(nv + K), np.r_[part.g, rows.weight]
    H[:nv, :nv] = part.H
    none = np.full(K, 1e30)
    lower = np.r_[np.tile(qp.lower, N), np.zeros(K), rows.lower - value, -none]
    upper = np.r_[np.tile(qp.upper, N), none, none, rows.upper - value]
    lower, upper = np.clip(lower, -1e30, 1e30), np.clip(upper, -1e30, 1e30)
    z, _, flag, _ = daqp.solve(H, g, A, upper, lower, np.zeros(len(lower), dtype=np.int32))
    assert flag == 1
    return z[:nv].reshape(N, 4)


def test_a_decision_solves_its_problem_as_other_solvers_do(mpc):
    exact, active = StructuredSolver(), 0
    for seed in range(4):
        team, memory = situation_of(mpc.task, crowd(seed)), np.zeros((6, mpc.memory_size))
        decision = mpc.decide(team, memory)
        for i, qp in enumerate(mpc.problems(team, memory)):
            plan = decision.memory[i, 1 : 1 + 4 * N].reshape(N, 4) - mpc.task.hover_force
            solution = exact.solve(qp)
            assert max(residuals(qp, solution)) < 1e-9  # as in the tests of the solver
            np.testing.assert_allclose(plan, solution.u, atol=1e-9)
            np.testing.assert_allclose(
                plan, solve_dense(qp), atol=1e-4
            )  # N, DAQP's tolerance of 1e-6 in rows
            active += int((solution.multipliers.row_lower[2 * N :] > 0.0).any())
        assert (decision.fallback == Fallback.NONE).all()
    assert active > 12


def test_only_the_rows_of_sensed_vehicles_go_to_the_solver(mpc):
    alone = at_rest(10.0 * LINE_START, mpc.task)
    near = alone.copy()
    near[1, :3] = near[0, :3] + [1.0, 0.0, 0.0]
    memory = np.zeros((6, mpc.memory_size))
    counts = [len(qp.rows.normal) for qp in mpc.problems(situation_of(mpc.task, alone), memory)]
    assert counts == [2 * N] * 6
    counts = [len(qp.rows.normal) for qp in mpc.problems(situation_of(mpc.task, near), memory)]
    assert counts == [3 * N + 1] * 2 + [2 * N] * 4


def test_permuted_vehicles_decide_as_before(mpc):
    plants, order = crowd(5), np.array([3, 0, 5, 1, 4, 2])
    team, memory = situation_of(mpc.task, plants), np.zeros((6, mpc.memory_size))
    before = mpc.decide(team, memory)
    permuted = mpc.decide(some_rows(team, order), memory)
    for field in ("command", "memory", "plan", "iterations"):
        np.testing.assert_array_equal(getattr(permuted, field), getattr(before, field)[order])


def test_permuted_slots_leave_the_decision_as_it_is(mpc):
    team, memory = situation_of(mpc.task, crowd(6)), np.zeros((6, mpc.memory_size))
    before = mpc.decide(team, memory)
    order = np.array([2, 4, 0, 3, 1])
    after = mpc.decide(team._replace(comm=team.comm[:, order], sensed=team.sensed[:, order]), memory)
    # The active set is found in another order: round-off of its steps.
    np.testing.assert_allclose(after.command, before.command, atol=1e-8)


def test_gaps_among_the_sensed_slots_are_skipped():
    wide, narrow = CooperativeMpc(team_task(sensed=8)), CooperativeMpc(team_task(sensed=5))
    packed, memory = situation_of(narrow.task, crowd(7)), np.zeros((6, narrow.memory_size))
    sensed = np.zeros((6, 8, 7))
    sensed[:, [0, 2, 3, 5, 7]] = packed.sensed
    sparse = packed._replace(sensed=sensed)
    np.testing.assert_array_equal(wide.decide(sparse, memory).command, narrow.decide(packed, memory).command)


def test_one_call_for_a_team_is_one_call_for_each(mpc):
    team, memory = situation_of(mpc.task, crowd(8)), np.zeros((6, mpc.memory_size))
    together = mpc.decide(team, memory)
    for i in range(6):
        alone = mpc.decide(some_rows(team, [i]), memory[:1])
        np.testing.assert_array_equal(alone.command[0], together.command[i])


def test_neither_position_nor_heading_matter(mpc):
    """Of the leader, whose preview says which heading to hold."""
    plants, shift, turn = crowd(9), np.array([7.0, -40.0, 3.0]), 1.3
    R = rotation_body_from_inertial([0.0, 0.0, -turn])
    moved = plants.copy()
    moved[:, :3], moved[:, 8] = plants[:, :3] @ R.T + shift, plants[:, 8] + turn
    preview = np.zeros((2, 6, 6, 8))
    p, v = line(0.05 * np.arange(6))
    preview[0, 0, :, :3], preview[0, 0, :, 3:6] = p, v
    preview[1, 0, :, :3], preview[1, 0, :, 3:6] = p @ R.T, v @ R.T
    preview[:, 0, :, 6:] = np.array([[0.0, 1.0], [np.sin(turn), np.cos(turn)]])[:, None]
    before = decide(mpc, plants, ALL, TRIANGLE, preview=preview[0])
    after = decide(mpc, moved, ALL, TRIANGLE, preview=preview[1])
    np.testing.assert_allclose(after.command[0], before.command[0], atol=1e-8)  # round-off of the solver
    np.testing.assert_allclose(after.plan[0, :, :3], before.plan[0, :, :3] @ R.T, atol=1e-8)


def test_the_plan_is_what_is_flown_next(mpc):
    """Positions relative to the present one and velocities in inertial axes, at the next sample."""
    plants = at_rest(LINE_START, mpc.task)
    plants[:, 6:9] = [0.1, -0.2, 0.9]
    plants[:, 3:6] = [0.5, -0.3, 0.2]
    decision = decide(mpc, plants, WEAK_TRIANGLE, TRIANGLE)
    after = simulate(plants, decision.command, mpc.task.params)
    # 5 mm and 6 cm/s: the model has no rotor lag, and turns velocities with the present attitude.
    np.testing.assert_allclose(decision.plan[:, 0, :3], after[:, :3] - plants[:, :3], atol=5e-3)
    np.testing.assert_allclose(decision.plan[:, 0, 3:], velocities(after), atol=6e-2)


@pytest.mark.parametrize("angles", [(0.0, 0.0), (0.4, -0.7), (-1.1, 0.2)])
def test_terminal_weight_compares_velocities_in_the_level_frame(mpc, angles):
    x, P, found = np.zeros(12), mpc._data.P, np.empty((12, 12))
    x[6:8] = angles
    level_weight(x, P, found)
    np.testing.assert_allclose(found, level_frame_weight(P, x[6:9]), atol=1e-12 * np.abs(P).max())
    e = np.random.default_rng(0).normal(size=12)
    level = e.copy()
    level[3:6] = rotation_body_from_inertial(x[6:9]).T @ e[3:6]
    np.testing.assert_allclose(e @ found @ e, level @ P @ level, rtol=1e-12)


def test_a_team_without_any_slot_flies_its_references():
    lonely = CooperativeMpc(team_task(neighbours=0, sensed=0))
    plants = at_rest(LINE_START, lonely.task)
    decision = decide(lonely, plants, np.eye(6), TRIANGLE)
    np.testing.assert_allclose(decision.command, lonely.task.hover_force, atol=1e-9)


def test_vehicles_at_one_place_fly_on(mpc):
    plants = at_rest(LINE_START, mpc.task)
    plants[1, :3] = plants[0, :3]
    decision = decide(mpc, plants, WEAK_TRIANGLE, TRIANGLE)
    assert np.isfinite(decision.command).all()


def test_without_an_answer_the_previous_plan_is_flown_on(mpc):
    plants = crowd(10)
    good = decide(mpc, plants, ALL, TRIANGLE)
    stopped = CooperativeMpc(mpc.task, iteration_limit=1)
    first = decide(stopped, plants, ALL, TRIANGLE)
    again = decide(stopped, plants, ALL, TRIANGLE, memory=good.memory)
    failed = again.fallback == Fallback.PREVIOUS_PLAN
    assert failed.sum() > 2
    assert set(first.fallback) == {Fallback.NONE, Fallback.CLIPPED_SDRE}
    np.testing.assert_allclose(again.command[failed], good.memory[failed, 5:9], atol=1e-12)
    np.testing.assert_allclose(again.plan[failed, :4, 3:], good.plan[failed, 1:, 3:], atol=1e-12)
    moved = good.plan[failed, 1:, :3] - good.plan[failed, :1, :3]
    np.testing.assert_allclose(again.plan[failed, :4, :3], moved, atol=1e-12)


def test_numbers_from_which_nothing_follows_give_hover(mpc):
    plants = at_rest(LINE_START, mpc.task)
    plants[2, 3:6] = plants[2, 9:12] = 1e308
    decision = decide(mpc, plants, np.eye(6), TRIANGLE)
    assert decision.fallback[2] == Fallback.HOVER
    np.testing.assert_array_equal(decision.command[2], mpc.task.hover_force)
    assert np.isfinite(decision.memory).all()
    assert (np.delete(decision.fallback, 2) == Fallback.NONE).all()


@pytest.mark.parametrize(
    "name", ["plant", "last_command", "preview", "comm", "sensed", "disturbance", "memory"]
)
def test_a_number_that_is_not_finite_is_named(mpc, name):
    plants = at_rest(LINE_START, mpc.task)
    shapes = {"plant": (6, 16), "last_command": (6, 4), "preview": (6, 6, 8), "comm": (6, 5, 15),
              "sensed": (6, 5, 7), "disturbance": (6, 6), "memory": (6, mpc.memory_size)}  # fmt: skip
    bad = np.zeros(shapes[name])
    bad[3].flat[-1] = np.nan
    with pytest.raises(ValueError, match=f"{name} of vehicle 3 is not finite; "):
        decide(mpc, plants, WEAK_TRIANGLE, TRIANGLE, **{name: bad})


def test_what_a_vehicle_may_lack_counts_as_nothing(mpc):
    team, memory = situation_of(mpc.task, crowd(12)), np.zeros((6, mpc.memory_size))
    zeros = team._replace(preview=np.zeros((6, 6, 8)), disturbance=np.zeros((6, 6)))
    np.testing.assert_array_equal(mpc.decide(team, memory).command, mpc.decide(zeros, memory).command)


def test_the_parts_of_a_situation_one_by_one_are_refused_with_the_form_of_today(mpc):
    team, memory = situation_of(mpc.task, crowd(12)), np.zeros((6, mpc.memory_size))
    with pytest.raises(TypeError, match=r"decide\(TeamSituation\(plant=..., last_command=.*, memory\)"):
        mpc.decide(*team, memory)


def test_options_are_a_value_or_keywords(mpc):
    options = CooperativeOptions(horizon=4, reach=2.0)
    assert CooperativeMpc(mpc.task, options).options == CooperativeMpc(mpc.task, horizon=4, reach=2.0).options
    assert CooperativeMpc(mpc.task, options, horizon=3).horizon == 3
    with pytest.raises(TypeError, match=r"unknown field of CooperativeOptions: 'horizn'.*'horizon'"):
        CooperativeMpc(mpc.task, horizn=4)
    with pytest.raises(
        TypeError, match="options must be CooperativeOptions, got 4; single ones are keywords"
    ):
        CooperativeMpc(mpc.task, 4)


@pytest.mark.parametrize(
    "options",
    [{"Q": 2.0}, {"R": 0.5}, {"terminal": 3.0}, {"R_rate": 1.0}],
    ids=lambda options: next(iter(options)),
)
def test_the_weights_of_a_team_may_be_chosen_and_are_those_of_its_problem(mpc, options):
    weighted, exact = CooperativeMpc(mpc.task, **options), StructuredSolver()
    team, memory = situation_of(mpc.task, crowd(13)), np.zeros((6, mpc.memory_size))
    decision = weighted.decide(team, memory)
    assert np.abs(decision.command - mpc.decide(team, memory).command).max() > 1e-3
    for i, qp in enumerate(weighted.problems(team, memory)):
        plan = decision.memory[i, 1 : 1 + 4 * N].reshape(N, 4) - mpc.task.hover_force
        np.testing.assert_allclose(plan, exact.solve(qp).u, atol=1e-9)


def test_wrong_shapes_are_named(mpc):
    plants = at_rest(LINE_START, mpc.task)
    with pytest.raises(ValueError, match=r"comm must have shape \(6, 5, 15\) .*, got \(6, 4, 15\)"):
        decide(mpc, plants, WEAK_TRIANGLE, TRIANGLE, comm=np.zeros((6, 4, 15)))
    with pytest.raises(ValueError, match=r"estimate_v must have shape \(6, 3\)"):
        decide(mpc, plants, WEAK_TRIANGLE, TRIANGLE, target=(np.zeros((6, 3)), None, None, None))
    short = CooperativeMpc(team_task(preview=3))
    with pytest.raises(ValueError, match="make the environment with preview=5"):
        decide(short, plants, WEAK_TRIANGLE, TRIANGLE)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"horizon": 0}, "horizon must be a whole number"),
        ({"alpha": 1.5}, "alpha must lie in"),
        ({"terminal_weight": "dare"}, "terminal_weight must be one of 'hover', 'stage', got 'dare'"),
        ({"neighbour": "plan"}, "needs plans in the messages"),
        ({"attitude": True}, "attitude needs the neighbours' accelerations"),
        ({"avoidance": "hard"}, "avoidance must be one of"),
        ({"avoidance": "plan"}, "avoidance='plan' needs plans in the messages"),
        ({"margin": 2.0}, "margin 2.0 leaves nothing"),
        ({"terminal": 2.0, "terminal_weight": "stage"}, "leave terminal out"),
    ],
)
def test_an_option_that_is_not_allowed_is_named(options, message):
    with pytest.raises(ValueError, match=message):
        CooperativeMpc(team_task(), **options)


def test_a_controller_pickles(mpc):
    plants = crowd(11)
    copied = pickle.loads(pickle.dumps(mpc))
    np.testing.assert_array_equal(
        decide(copied, plants, ALL, TRIANGLE).command, decide(mpc, plants, ALL, TRIANGLE).command
    )
