"""OSQP behind the common interface: agreement with the exact solver, persistence, honest status."""

import pickle

import numpy as np
import pytest
from ocp_problems import LIMITS, MODELS, hover_qp, random_qp, velocity_rows

from controllers.qp import Status, StructuredSolver, residuals
from controllers.qp.ocp import output_rows
from controllers.qp.osqp import OsqpSolver

EXACT = StructuredSolver()
FAR = np.r_[3.0, 3.0, 3.0, np.zeros(9)]


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("limits", LIMITS)
def test_polished_osqp_finds_the_inputs_of_the_structured_solver(model, limits):
    rng = np.random.default_rng([3, MODELS.index(model), LIMITS.index(limits)])
    solver = OsqpSolver(eps=1e-8, max_iter=200_000, polishing=True)
    for N in (1, 2, 8):
        qp = random_qp(rng, N, model, limits)
        expected, found = EXACT.solve(qp), solver.solve(qp)
        assert found.status == expected.status
        if found.status == Status.OPTIMAL:
            np.testing.assert_allclose(found.u, expected.u, atol=1e-5)


def test_updated_data_give_the_result_of_a_fresh_set_up():
    rng = np.random.default_rng(4)
    kept = OsqpSolver(eps=1e-7, max_iter=100_000)
    for _ in range(4):
        qp = random_qp(rng, 5, "ltv", "soft")
        fresh = OsqpSolver(eps=1e-7, max_iter=100_000)
        # Two runs of an iterative solver from different starts, each to 1e-7 of its residuals.
        np.testing.assert_allclose(kept.solve(qp).u, fresh.solve(qp).u, atol=1e-3)


def test_the_workspace_persists_until_the_structure_changes():
    solver = OsqpSolver()
    solver.solve(hover_qp(5, FAR))
    first = solver._problem
    solver.solve(hover_qp(5, 0.5 * FAR, upper=0.49))
    assert solver._problem is first
    solver.solve(hover_qp(5, FAR, rows=velocity_rows(5, 1.0, 10.0)))
    assert solver._problem is not first


def test_a_warm_start_saves_iterations():
    solver = OsqpSolver()
    qp = hover_qp(10, FAR, upper=0.49, rate_step=0.25)
    cold, warm = solver.solve(qp), solver.solve(qp)
    assert warm.iterations < cold.iterations


def test_default_tolerance_gives_small_residuals():
    qp = hover_qp(10, FAR, upper=0.49, rate_step=0.25)
    assert max(residuals(qp, OsqpSolver().solve(qp))) < 1e-2


def test_an_infeasible_problem_has_no_numbers_and_leaves_the_solver_usable():
    solver = OsqpSolver()
    row = output_rows(np.eye(12)[:1], np.array([-np.inf]), np.array([-5.0]), np.inf, 2)
    bad = solver.solve(hover_qp(2, FAR, rows=row))
    assert bad.status == Status.INFEASIBLE
    assert np.isnan(bad.u).all()
    feasible = hover_qp(2, FAR, rows=row._replace(upper=row.upper + 10.0))
    np.testing.assert_allclose(solver.solve(feasible).u, EXACT.solve(feasible).u, atol=1e-2)


@pytest.mark.parametrize("used", [False, True], ids=["at the set-up", "at an update"])
def test_a_matrix_that_cannot_be_factored_is_inaccurate_and_leaves_the_solver_usable(used):
    solver, good = OsqpSolver(), hover_qp(3, FAR)
    if used:
        solver.solve(good)
    rng = np.random.default_rng(0)
    wild = good._replace(A=good.A + 1e200 * rng.normal(size=good.A.shape))
    bad = solver.solve(wild)
    assert bad.status in (Status.INACCURATE, Status.ITERATION_LIMIT)
    assert np.isnan(bad.u).all()
    np.testing.assert_array_equal(solver.solve(good).u, OsqpSolver().solve(good).u)


def test_the_iteration_limit_is_reported():
    solution = OsqpSolver(max_iter=1).solve(hover_qp(10, FAR, upper=0.49, rate_step=0.25))
    assert solution.status == Status.ITERATION_LIMIT


def test_crossing_bounds_are_refused_before_osqp_sees_them():
    qp = hover_qp(2, FAR)._replace(lower=np.full(4, 9.0))
    with pytest.raises(ValueError, match="lower <= upper"):
        OsqpSolver().solve(qp)


def test_a_pickled_solver_rebuilds_its_workspace():
    solver = OsqpSolver(eps=1e-6)
    qp = hover_qp(3, FAR)
    solver.solve(qp)
    copy = pickle.loads(pickle.dumps(solver))
    assert copy.settings == solver.settings
    np.testing.assert_allclose(copy.solve(qp).u, EXACT.solve(qp).u, atol=1e-3)
