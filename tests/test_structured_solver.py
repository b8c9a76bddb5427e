"""The structured solver against optimality conditions, DAQP, and what theory says of exact penalties."""

import pickle

import numpy as np
import pytest
from ocp_problems import LIMITS, MODELS, hover_qp, random_qp, tilt_rows, velocity_rows

from benchmarks.condensed import solve_daqp
from controllers.qp import Status, StructuredSolver, residuals
from controllers.qp.active_set import Face
from controllers.qp.inverse_factor import inverse_factor
from controllers.qp.ocp import (
    StateRows,
    concatenate_rows,
    condense,
    first_move_bounds,
    output_rows,
    rate_weight,
)
from controllers.qp.recursion import Feedback
from controllers.qp.rows import RowData, row_spans
from controllers.qp.structured import ITERATION_LIMIT, solve_by_dear_inputs, solve_structured
from controllers.qp.working_set import correct
from controllers.qp.workspace import make_workspace
from quad_envs.compilation.packed import pack

SOLVER = StructuredSolver()
FAR = np.r_[3.0, 3.0, 3.0, np.zeros(9)]
FREE = {"lower": np.full(4, -np.inf), "upper": np.full(4, np.inf), "rate_step": np.inf}


def agree_with_conditions(qp, solution):
    found = residuals(qp, solution)
    # Three hundred times the largest seen in a thousand problems: round-off over several hundred steps.
    assert max(found) < 1e-9, found


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("limits", LIMITS)
@pytest.mark.parametrize("N", [1, 2, 5, 25])
def test_a_random_problem_satisfies_the_optimality_conditions(model, limits, N):
    rng = np.random.default_rng([N, MODELS.index(model), LIMITS.index(limits)])
    for _ in range(2):
        qp = random_qp(rng, N, model, limits)
        solution = SOLVER.solve(qp)
        if solution.status == Status.OPTIMAL:
            agree_with_conditions(qp, solution)
        else:
            assert solution.status == Status.INFEASIBLE
            assert limits in ("hard", "mixed")


@pytest.mark.slow
def test_many_random_problems_satisfy_the_optimality_conditions():
    rng = np.random.default_rng(0)
    for _ in range(1000):
        qp = random_qp(rng, int(rng.choice([1, 2, 5, 25])), rng.choice(MODELS), rng.choice(LIMITS))
        solution = SOLVER.solve(qp)
        if solution.status == Status.OPTIMAL:
            agree_with_conditions(qp, solution)
        else:
            assert solution.status == Status.INFEASIBLE


def compare_with_daqp(rng, trials, sizes):
    statuses = set()
    for _ in range(trials):
        qp = random_qp(rng, int(rng.choice(sizes)), rng.choice(MODELS), rng.choice(["none", "hard"]))
        solution = SOLVER.solve(qp)
        u, _, flag, _ = solve_daqp(qp, primal_tol=1e-10, dual_tol=1e-10)
        assert (flag == 1) == (solution.status == Status.OPTIMAL)
        statuses.add(solution.status)
        if flag == 1:
            # Ten times the tolerance that DAQP is given on rows.
            assert np.abs(u - solution.u).max() < 1e-9
    return statuses


def test_daqp_finds_the_same_inputs_and_the_same_infeasible_problems():
    compare_with_daqp(np.random.default_rng(5), 40, [1, 2, 5, 10])


@pytest.mark.slow
def test_daqp_agrees_over_many_problems_of_all_horizons():
    statuses = compare_with_daqp(np.random.default_rng(6), 400, [1, 2, 5, 25])
    assert statuses == {Status.OPTIMAL, Status.INFEASIBLE}


@pytest.mark.parametrize("model", MODELS)
def test_the_unconstrained_plan_is_the_solution_of_the_condensed_system(model):
    qp = random_qp(np.random.default_rng(7), 10, model, "none")._replace(**FREE)
    H, g, S, f = condense(qp)
    u = -np.linalg.solve(H, g)
    solution = SOLVER.solve(qp)
    assert solution.iterations == 0
    np.testing.assert_allclose(solution.u.ravel(), u, atol=1e-9 * np.abs(u).max())
    np.testing.assert_allclose(solution.x, S @ u + f, atol=1e-9 * np.abs(solution.x).max())


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("N", [1, 2, 25])
def test_the_inverse_factor_whitens_the_hessian(model, N):
    qp = random_qp(np.random.default_rng(8), N, model, "none")
    ws = make_workspace(N, 0, len(qp.A))
    solve_structured(*qp[:-2], *qp.rows, rate_weight(qp), 1, False, pack(ws))
    J_T = np.empty((4 * N, 4 * N))
    feedback = Feedback(ws.transposed, ws.K, ws.D, ws.P_c)
    inverse_factor(qp.A, qp.B, qp.stationary, feedback, ws.K, J_T, ws.wide, ws.scratch)
    H = condense(qp).H
    np.testing.assert_allclose(J_T @ H @ J_T.T, np.eye(4 * N), atol=1e-9)  # stored by columns: J_T is J'


def test_the_first_input_of_the_unconstrained_regulator_does_not_depend_on_the_horizon():
    plans = [SOLVER.solve(hover_qp(N, FAR)._replace(**FREE)).u[0] for N in (1, 3, 25)]
    np.testing.assert_allclose(plans[0], plans[1], atol=1e-11)
    np.testing.assert_allclose(plans[0], plans[2], atol=1e-11)


def test_the_regulator_anchors_are_reproduced():
    nominal = SOLVER.solve(hover_qp(25, FAR))
    assert nominal.iterations == 0
    np.testing.assert_allclose(nominal.u[0], [2.814907, 2.814907, -0.056077, -0.056077], atol=1e-6)
    np.testing.assert_allclose(nominal.u[1], [1.635770, 1.635770, 0.681470, 0.681470], atol=1e-6)
    tight = SOLVER.solve(hover_qp(25, FAR, upper=0.49, rate_step=0.25))
    np.testing.assert_allclose(tight.u[0], [0.25, 0.25, -0.25, -0.25], atol=1e-9)
    np.testing.assert_allclose(tight.u[1], [0.49, 0.49, -0.218067, -0.218067], atol=1e-6)


def test_moving_position_and_reference_together_changes_no_input():
    qp = random_qp(np.random.default_rng(9), 10, "lti", "none")
    qp = hover_qp(10, qp.x_0, upper=0.49, rate_step=0.25)._replace(r=qp.r)
    shift = np.r_[5.0, -2.0, 1.0, np.zeros(9)]
    moved = qp._replace(x_0=qp.x_0 + shift, r=qp.r + shift)
    np.testing.assert_allclose(SOLVER.solve(moved).u, SOLVER.solve(qp).u, atol=1e-9)


def test_inputs_keep_box_and_rate_and_the_first_move():
    qp = hover_qp(25, FAR, upper=0.49, rate_step=0.25)._replace(u_last=np.array([0.1, -0.3, 0.4, 0.0]))
    u = SOLVER.solve(qp).u
    assert (u <= qp.upper + 1e-9).all()
    assert (u >= qp.lower - 1e-9).all()
    assert (np.abs(np.diff(np.vstack([qp.u_last, u]), axis=0)) <= 0.25 + 1e-9).all()


def test_a_box_that_moved_away_is_reached_in_one_step():
    qp = hover_qp(5, FAR, upper=0.0, rate_step=0.25)._replace(u_last=np.full(4, 2.0))
    solution = SOLVER.solve(qp)
    assert solution.status == Status.OPTIMAL
    np.testing.assert_allclose(solution.u[0], 0.0, atol=1e-9)


def test_soft_rows_equal_hard_rows_when_the_weight_exceeds_the_multipliers():
    hard = hover_qp(25, FAR, rows=velocity_rows(25, 0.8, np.inf))
    expected = SOLVER.solve(hard)
    largest = max(expected.multipliers.row_lower.max(), expected.multipliers.row_upper.max())
    assert largest > 1.0
    soft = SOLVER.solve(hard._replace(rows=velocity_rows(25, 0.8, 1.01 * largest)))
    np.testing.assert_allclose(soft.u, expected.u, atol=1e-9)


def test_soft_rows_of_zero_weight_do_nothing():
    free = SOLVER.solve(hover_qp(25, FAR, upper=0.49, rate_step=0.25))
    rows = SOLVER.solve(hover_qp(25, FAR, 0.49, 0.25, velocity_rows(25, 0.1, 0.0)))
    np.testing.assert_array_equal(rows.u, free.u)


def test_a_single_violated_row_has_its_weight_as_multiplier():
    row = output_rows(np.eye(12)[:1], np.array([-np.inf]), np.array([-5.0]), 3.0, 1)
    solution = SOLVER.solve(hover_qp(1, FAR, rows=row))
    assert solution.x[1, 0] > -5.0
    assert solution.multipliers.row_upper[0] == 3.0
    assert solution.multipliers.row_lower[0] == 0.0


def test_contradicting_hard_rows_are_reported_infeasible():
    row = output_rows(np.eye(12)[:1], np.array([-np.inf]), np.array([-5.0]), np.inf, 2)
    assert SOLVER.solve(hover_qp(2, FAR, rows=row)).status == Status.INFEASIBLE


def test_the_same_rows_made_soft_are_always_feasible():
    rows = concatenate_rows(velocity_rows(25, 0.01, 1e3), tilt_rows(25, 0.01, 1e3))
    qp = hover_qp(25, np.r_[FAR[:3], 2.0, -2.0, 1.0, 0.3, -0.3, np.zeros(4)], 0.49, 0.25, rows)
    solution = SOLVER.solve(qp)
    assert solution.status == Status.OPTIMAL
    agree_with_conditions(qp, solution)


@pytest.mark.parametrize("weight", [np.inf, 20.0])
def test_duplicated_and_parallel_rows_are_no_obstacle(weight):
    once = velocity_rows(10, 2.0, weight)
    scaled = once._replace(normals=2.0 * once.normals, lower=2.0 * once.lower, upper=2.0 * once.upper)
    single = SOLVER.solve(hover_qp(10, FAR, rows=velocity_rows(10, 2.0, 4.0 * weight)))
    qp = hover_qp(10, FAR, rows=concatenate_rows(once, once, scaled))
    solution = SOLVER.solve(qp)
    agree_with_conditions(qp, solution)
    np.testing.assert_allclose(solution.u, single.u, atol=1e-9)


@pytest.mark.parametrize("N", [1, 5])
@pytest.mark.parametrize("fixed", [{"rate_step": 0.0}, {"lower": np.full(4, 0.2), "upper": np.full(4, 0.2)}])
def test_inputs_without_freedom_are_returned_as_they_must_be(N, fixed):
    qp = hover_qp(N, FAR)._replace(u_last=np.full(4, 0.2), **fixed)
    solution = SOLVER.solve(qp)
    assert solution.status == Status.OPTIMAL
    np.testing.assert_allclose(solution.u, 0.2, atol=1e-9)


def test_an_equality_row_holds():
    row = output_rows(np.eye(12)[3:4], np.array([-0.2]), np.array([-0.2]), np.inf, 3)
    row = StateRows(row.normals, *(column[2:] for column in row[1:]))  # at the last stage alone
    solution = SOLVER.solve(hover_qp(3, np.r_[np.zeros(3), -0.2, np.zeros(8)], rows=row))
    assert solution.status == Status.OPTIMAL
    assert abs(solution.x[3, 3] + 0.2) < 1e-9


def test_the_iteration_limit_is_reported():
    solution = StructuredSolver(iteration_limit=3).solve(hover_qp(25, FAR, upper=0.49, rate_step=0.25))
    assert solution.status == Status.ITERATION_LIMIT
    assert solution.iterations == 3


@pytest.mark.parametrize("field", ["x_0", "r", "u_last"])
def test_a_number_that_is_not_finite_is_a_status_of_the_kernel(field):
    qp = hover_qp(5, FAR)
    broken = getattr(qp, field).copy()
    broken.flat[0] = np.nan
    qp = qp._replace(**{field: broken})
    ws = make_workspace(5, 0, 1)
    status, _ = solve_structured(*qp[:-2], *qp.rows, rate_weight(qp), 100, False, pack(ws))
    assert status == Status.NOT_FINITE


def test_a_workspace_of_another_horizon_is_refused():
    qp = hover_qp(5, FAR)
    with pytest.raises(ValueError, match="workspace does not fit"):
        solve_structured(*qp[:-2], *qp.rows, rate_weight(qp), 100, False, pack(make_workspace(4, 0, 1)))


def test_repeated_solves_in_one_workspace_are_bitwise_equal():
    rng = np.random.default_rng(11)
    problems = [random_qp(rng, 5, model, limits) for model in MODELS for limits in ("soft", "mixed")]
    solver = StructuredSolver()
    first = [solver.solve(qp) for qp in problems]
    for qp, before in zip(problems[::-1], first[::-1], strict=True):
        after = solver.solve(qp)
        np.testing.assert_array_equal(after.u, before.u)
        assert after.iterations == before.iterations


def test_a_pickled_solver_solves_alike():
    qp = hover_qp(5, FAR, 0.49, 0.25)
    solver = StructuredSolver(iteration_limit=77)
    expected = solver.solve(qp)
    copy = pickle.loads(pickle.dumps(solver))
    assert copy.iteration_limit == 77
    np.testing.assert_array_equal(copy.solve(qp).u, expected.u)


def rows_of(qp, ws):
    """All rows of a problem as the kernels of the active set take them."""
    row_spans(qp.rows.normals, ws.spans)
    first_move = np.array(first_move_bounds(qp))
    return RowData(qp.lower, qp.upper, qp.rate_step, first_move, *qp.rows, ws.spans)


def test_refinement_puts_held_inputs_at_the_very_value_of_their_bound():
    qp = hover_qp(25, FAR, upper=0.49, rate_step=0.25)
    ws = make_workspace(25, 0, 1)
    solve_structured(*qp[:-2], *qp.rows, rate_weight(qp), ITERATION_LIMIT, False, pack(ws))
    exact, held = ws.u.copy(), ws.state[:100].reshape(25, 4) + ws.state[100:200].reshape(25, 4)
    assert held.sum() > 10
    ws.u[:] += 0.1 * np.random.default_rng(12).normal(size=ws.u.shape)
    face = Face(ws.u, ws.x, *ws.factors, ws.active, ws.state, ws.vectors)
    correct(rows_of(qp, ws), np.zeros(100), face, int((ws.state == 1).sum()))
    assert np.isin(ws.u[held == 1], (-1.96, 0.49)).all()
    assert np.abs(ws.u - exact)[held == 0].max() > 1e-3  # the gradient that would show the rest was left out


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("limits", LIMITS)
def test_dear_inputs_lead_to_the_same_optimum(model, limits):
    rng = np.random.default_rng([16, MODELS.index(model), LIMITS.index(limits)])
    for N in (1, 5, 15):
        qp = random_qp(rng, N, model, limits)
        expected = SOLVER.solve(qp)
        ws = make_workspace(N, len(qp.rows.normal), len(qp.A))
        packed = qp._replace(R_rate=rate_weight(qp))
        status, _ = solve_by_dear_inputs(packed, rows_of(qp, ws), 0, 100_000, ws)
        assert status == expected.status
        if status == Status.OPTIMAL:
            # Both are exact: what differs is round-off over some hundred steps.
            np.testing.assert_allclose(ws.u, expected.u, atol=1e-9 * (1.0 + np.abs(ws.u).max()))
