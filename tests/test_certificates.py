"""Certificates of chapter 9: identities, independent computations, a 2-D example by hand, and bad input."""

import importlib

import numpy as np
import pytest
import scipy.linalg
from flights import TASK, WEAK, at_rest, decide_once, plan_of, rest, window
from ocp_problems import HOVER_P, hover_qp, velocity_rows

from controllers import LinearMPC, Lqr, SdcNmpc, Sdre, hover_pair, sdc_pair
from controllers.qp import StructuredSolver
from controllers.stability.certificates import (
    best_gain,
    linear_matrix_inequality,
    plan_cost,
    predicted_state,
    solve_problem,
    stage_cost,
    terminal_decrease,
    terminal_rows,
)
from controllers.stability.invariant import (
    Halfspaces,
    inscribed_ellipsoid,
    largest_ellipsoid,
    law_halfspaces,
    sample_ellipsoid,
)
from quad_envs.parameters import Limits
from quad_envs.tasks import Task

Q, R = np.eye(12), np.eye(4)
A, B = hover_pair(TASK.params, TASK.dt)
P = scipy.linalg.solve_discrete_are(A, B, Q, R)
K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
A_K = A - B @ K
TUMBLING = np.array([3, 3, 3, 1, 0.5, -0.5, 0.2, -0.3, 0.1, 0.5, 0.4, 0.1])
# A double integrator that halves its state each sample, inside |x| <= 2 and |y| <= 1: by hand below.
HALF = 0.5 * np.eye(2)
BOX = Halfspaces(np.eye(2), np.array([2.0, 1.0]), ("x", "y"))


def test_the_riccati_weight_satisfies_the_terminal_inequality_with_equality():
    found = terminal_decrease(A, B, K, P, Q, R)
    # |P| is 925: an independent solver leaves 1e-9 of it
    assert found.holds and abs(found.margin) < 1e-6 and np.abs(found.eigenvalues).max() < 1e-6


def test_a_larger_weight_has_a_margin_and_a_smaller_one_fails():
    assert terminal_decrease(A, B, K, 2.0 * P, Q, R).margin == pytest.approx(
        np.linalg.eigvalsh(Q + K.T @ R @ K)[0], rel=1e-6  # D = -(Q + K'R K), as D(P) = 0
    )  # fmt: skip
    assert not terminal_decrease(A, B, K, 0.5 * P, Q, R).holds


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_the_linear_matrix_inequality_says_the_same_as_the_eigenvalues(factor):
    weight = factor * P
    smallest = np.linalg.eigvalsh(linear_matrix_inequality(A, B, K, weight, Q, R))[0]
    assert (smallest >= -1e-12) == terminal_decrease(A, B, K, weight, Q, R).holds


def test_no_gain_decreases_more_than_the_best_one():
    A_x, B_x = sdc_pair(TUMBLING, TASK.params, TASK.dt)
    best = terminal_decrease(A_x, B_x, best_gain(A_x, B_x, P, R), P, Q, R)
    rng = np.random.default_rng(0)
    others = [best_gain(A_x, B_x, P, R) + 0.1 * rng.normal(size=(4, 12)) for _ in range(20)]
    for other in others:
        assert (terminal_decrease(A_x, B_x, other, P, Q, R).eigenvalues >= best.eigenvalues - 1e-9).all()


def test_the_hover_weight_fails_away_from_hover_where_that_of_the_present_pair_holds():
    A_x, B_x = sdc_pair(TUMBLING, TASK.params, TASK.dt)
    P_x = scipy.linalg.solve_discrete_are(A_x, B_x, Q, R)
    assert not terminal_decrease(A_x, B_x, best_gain(A_x, B_x, P, R), P, Q, R).holds
    assert terminal_decrease(A_x, B_x, best_gain(A_x, B_x, P_x, R), P_x, Q, R).holds


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"A": np.eye(3)}, r"A must have shape \(12, 12\), got \(3, 3\)"),
        ({"K": np.full((4, 12), np.nan)}, "K must be finite"),
        ({"Q_f": P + np.triu(P)}, "Q_f must be symmetric"),
        ({"B": np.zeros(12)}, r"B must have shape \(n, m\)"),
    ],
)
def test_matrices_that_do_not_fit_are_named(changed, message):
    values = {"A": A, "B": B, "K": K, "Q_f": P, "Q": Q, "R": R} | changed
    with pytest.raises(ValueError, match=message):
        terminal_decrease(**values)


def test_a_singular_weight_has_no_linear_matrix_inequality():
    with pytest.raises(ValueError, match="Q_f must be positive definite"):
        linear_matrix_inequality(A, B, K, np.zeros((12, 12)), Q, R)


def test_the_cost_of_an_unconstrained_plan_is_the_riccati_cost_to_go():
    qp = hover_qp(10, 0.1 * np.ones(12))
    solution = solve_problem(qp, StructuredSolver())
    assert plan_cost(qp, solution.u, solution.x) == pytest.approx(qp.x_0 @ HOVER_P @ qp.x_0, rel=1e-9)


def test_the_value_of_the_predicted_state_is_less_by_the_stage_cost():
    qp, solver = hover_qp(10, 0.3 * np.ones(12)), StructuredSolver()
    first = solve_problem(qp, solver)
    then = qp._replace(x_0=predicted_state(qp, first.u[0]))
    second = solve_problem(then, solver)
    fall = plan_cost(qp, first.u, first.x) - plan_cost(then, second.u, second.x)
    assert fall == pytest.approx(stage_cost(qp, first.u[0]), rel=1e-9)


def test_a_soft_row_that_is_violated_costs_its_weight():
    rows = velocity_rows(5, 0.1, 10.0)
    qp = hover_qp(5, np.r_[np.zeros(3), 1.0, np.zeros(8)], rows=rows)
    x, u = np.tile(qp.x_0, (6, 1)), np.zeros((5, 4))
    # five stages 0.9 beyond, at weight 10, without the factor 1/2 of the problem
    with_rows, without = plan_cost(qp, u, x), plan_cost(qp._replace(rows=hover_qp(5, qp.x_0).rows), u, x)
    assert with_rows - without == pytest.approx(2.0 * 5 * 10.0 * 0.9)


def test_rows_that_contradict_each_other_have_no_hard_plan():
    qp = hover_qp(5, np.r_[np.zeros(3), 3.0, np.zeros(8)], rows=velocity_rows(5, 0.1, 1e3))
    assert solve_problem(qp, StructuredSolver()) is not None
    assert solve_problem(qp, StructuredSolver(), hard=True) is None


def test_the_terminal_rows_have_the_sign_of_the_law():
    qp = hover_qp(1, np.zeros(12), upper=0.49)  # 2.45 N: 1.96 down, 0.49 up
    x = np.zeros(12)
    x[2] = 1.0  # a metre below: the law wants thrust, and has 0.49 N of it
    thrust = -(K @ x)
    rows = terminal_rows(qp, x, K)
    assert thrust.min() > 0.0 and rows.inputs == pytest.approx(0.49 - thrust.max())
    assert rows.outputs == np.inf


def test_the_terminal_rows_look_one_step_ahead():
    qp = hover_qp(3, np.zeros(12), rows=velocity_rows(3, 0.5, 1e3))
    x = np.r_[np.zeros(3), 0.4, np.zeros(8)]
    u = terminal_rows(qp, x, K).outputs
    assert u == pytest.approx(0.5 - np.abs((A_K @ x)[3:6]).max())


@pytest.mark.parametrize("kind", [LinearMPC, SdcNmpc])
def test_the_problem_of_a_decision_has_the_plan_of_that_decision(kind):
    controller = kind(WEAK, horizon=8)
    plant, rows = at_rest((0.5, -0.4, 0.3), (0.1, -0.2, 0.4)), window(rest, 0, 8)
    qp = controller.problem(plant, rows, np.full(4, 1.96), np.zeros(6), np.zeros(controller.memory_size))
    plan = solve_problem(qp, StructuredSolver()).u
    # the same kernels on the same numbers
    np.testing.assert_allclose(plan, plan_of(decide_once(controller, plant, rows), 8), atol=1e-12)


@pytest.mark.parametrize("kind", [Lqr, Sdre])
def test_the_problem_of_a_law_has_its_gain_as_the_best_one(kind):
    law, plant, rows = kind(TASK), at_rest((0.2, 0.1, -0.1), (0.1, 0.05, -0.2)), window(rest, 0, 0)
    qp = law.problem(plant, rows, np.full(4, 1.96), np.zeros(6), np.zeros(0))
    u = -best_gain(qp.A[0], qp.B[0], qp.Q_f, qp.R[0]) @ (qp.x_0 - qp.r[0])
    np.testing.assert_allclose(decide_once(law, plant, rows).command[0] + qp.lower, u, atol=1e-9)


def test_a_problem_of_numbers_that_are_not_finite_is_refused():
    with pytest.raises(ValueError, match="plant of vehicle 0 is not finite"):
        Lqr(TASK).problem(np.full(16, np.nan), window(rest, 0, 0), np.zeros(4), np.zeros(6), np.zeros(0))


@pytest.mark.parametrize(("task", "level"), [(TASK, 16.66), (WEAK, 1.041)])
def test_the_ellipsoid_of_hover_is_that_of_the_prototype(task, level):
    found = inscribed_ellipsoid(P, law_halfspaces(task, K, A_K))
    assert found.level == pytest.approx(level, rel=1e-3) and found.binding.startswith("rotor")


def test_the_ellipsoid_touches_a_limit_and_exceeds_none():
    limits = law_halfspaces(TASK, K, A_K)
    found = inscribed_ellipsoid(P, limits)
    points = sample_ellipsoid(found, 2000, np.random.default_rng(0), boundary=True)
    assert (np.abs(points @ limits.normals.T) <= limits.bounds * (1.0 + 1e-12)).all()
    h = limits.normals[limits.names.index(found.binding)]
    touching = np.linalg.solve(P, h) * np.sqrt(found.level / (h @ np.linalg.solve(P, h)))
    assert found.value(touching) == pytest.approx(1.0) and h @ touching == pytest.approx(1.96)


def test_the_ellipsoid_of_a_box_is_known_by_hand():
    circle = inscribed_ellipsoid(np.eye(2), BOX)  # x^2 + y^2 <= 1, touching |y| <= 1
    assert (circle.level, circle.binding, circle.size) == (1.0, "y", 1.0)
    np.testing.assert_allclose(circle.projection(np.array([1.0, 0.0]), np.array([0.0, 1.0])), np.eye(2))


def test_samples_fill_the_ellipsoid_uniformly():
    found = inscribed_ellipsoid(np.diag([0.25, 1.0]), BOX)
    values = found.value(sample_ellipsoid(found, 4000, np.random.default_rng(0)))
    # in the plane the share inside half of the radius is 1/4; 4000 draws leave 0.007
    assert values.max() <= 1.0 and np.mean(values <= 0.25) == pytest.approx(0.25, abs=0.03)


def test_all_limits_of_a_task_become_limits_on_the_state():
    limits = Limits(kappa=0.3125, rate=5.0, tilt=0.35, velocity=1.8, position_upper=(2.0, np.inf, np.inf))
    found = law_halfspaces(Task(limits=limits), K, A_K, margin=0.02)
    assert len(found.names) == 4 + 4 + 3 + 2 + 1
    bounds = dict(zip(found.names, found.bounds, strict=True))
    assert bounds["rotor 1"] == pytest.approx(0.49) and bounds["rate of rotor 1"] == pytest.approx(0.25)
    assert (bounds["roll"], bounds["u"], bounds["x"]) == pytest.approx((0.33, 1.78, 1.98))


def test_a_set_point_outside_the_limits_is_refused():
    limits = Limits(position_lower=(0.5, -1.0, -1.0), position_upper=(2.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="the set-point must lie inside all limits"):
        law_halfspaces(Task(limits=limits), K, A_K)


def test_a_shape_that_is_no_ellipsoid_is_refused():
    with pytest.raises(ValueError, match="P must be positive definite"):
        inscribed_ellipsoid(np.diag([1.0, 0.0]), BOX)


def test_the_largest_ellipsoid_of_a_box_is_known_by_hand():
    pytest.importorskip("cvxpy")
    found = largest_ellipsoid(HALF, BOX)  # semi-axes 2 and 1; the solver's tolerance is 1e-8
    np.testing.assert_allclose(found.P / found.level, np.diag([0.25, 1.0]), atol=1e-5)


def test_the_largest_ellipsoid_is_invariant_larger_and_inside_the_limits():
    pytest.importorskip("cvxpy")
    limits = law_halfspaces(WEAK, K, A_K)
    found = largest_ellipsoid(A_K, limits)
    assert found.size > 2.0 * inscribed_ellipsoid(P, limits).size
    points = sample_ellipsoid(found, 500, np.random.default_rng(1), boundary=True)
    for _ in range(200):
        assert (np.abs(points @ limits.normals.T) <= limits.bounds * (1.0 + 1e-6)).all()
        points = points @ A_K.T
    assert found.value(points).max() < 1.0


def test_without_the_packages_the_message_names_the_extra(monkeypatch):
    def missing(name):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(importlib.import_module("controllers.stability.invariant"), "import_module", missing)
    with pytest.raises(ModuleNotFoundError, match=r"pip install .* -e \"\.\[lmi\]\""):
        largest_ellipsoid(HALF, BOX)


def test_a_loop_that_is_not_stable_has_no_ellipsoid():
    with pytest.raises(ValueError, match=r"must be stable, its spectral radius is 1\.5"):
        largest_ellipsoid(1.5 * np.eye(2), BOX)
