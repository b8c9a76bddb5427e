"""The Riccati equation: residual, scipy, stability, and what is refused."""

import numpy as np
import pytest
import scipy.linalg
from ocp_problems import HOVER, HOVER_P, model_pair

from controllers.qp.linalg import lu_solve, matmul, matvec
from controllers.qp.riccati import DARE_SCRATCH, dare, lqr_gain, solve_dare

Q, R = np.eye(12), np.eye(4)


def riccati_step(A, B, P):
    return Q + A.T @ P @ A - A.T @ P @ B @ np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)


@pytest.mark.parametrize("seed", range(5))
def test_dare_agrees_with_scipy(seed):
    A, B = model_pair(np.random.default_rng(seed), 0.3)
    expected = scipy.linalg.solve_discrete_are(A, B, Q, R)
    np.testing.assert_allclose(dare(A, B, Q, R), expected, atol=1e-9 * np.abs(expected).max())


def test_the_solution_is_a_fixed_point_of_the_recursion():
    np.testing.assert_allclose(riccati_step(*HOVER, HOVER_P), HOVER_P, atol=1e-11 * HOVER_P.max())


def test_doubling_k_times_equals_two_to_the_k_steps_of_the_recursion():
    P = np.zeros((12, 12))
    for _ in range(2**12):
        P = riccati_step(*HOVER, P)
    np.testing.assert_allclose(HOVER_P, P, atol=1e-9 * P.max())


def test_hover_takes_a_dozen_doublings():
    P = np.empty((12, 12))
    assert 8 <= solve_dare(*HOVER, Q, R, P, np.empty((DARE_SCRATCH, 12, 12))) <= 14


def test_the_gain_stabilises():
    A, B = model_pair(np.random.default_rng(3), 0.5)
    K, _ = lqr_gain(A, B, Q, R)
    assert np.abs(np.linalg.eigvals(A - B @ K)).max() < 1.0


def test_the_solution_is_symmetric_and_positive_definite():
    np.testing.assert_array_equal(HOVER_P, HOVER_P.T)
    assert np.linalg.eigvalsh(HOVER_P)[0] > 0.0


def test_a_scalar_equation_has_the_closed_form_solution():
    one = np.eye(1)
    golden = (1.0 + np.sqrt(5.0)) / 2.0  # P = 1 + P / (1 + P)
    np.testing.assert_allclose(dare(one, one, one, one), golden)


def test_an_unstable_mode_without_control_is_refused():
    A = np.diag([1.5, 0.5])
    with pytest.raises(ValueError, match="no stabilising solution"):
        dare(A, np.array([[0.0], [1.0]]), np.eye(2), np.eye(1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"A": np.eye(3)}, r"A must have shape \(12, 12\)"),
        ({"B": np.zeros(12)}, "B must have shape"),
        ({"Q": np.full((12, 12), np.nan)}, "Q must be finite"),
        ({"Q": np.triu(np.ones((12, 12)))}, "Q must be symmetric"),
        ({"R": -np.eye(4)}, "R must be positive definite"),
    ],
)
def test_bad_data_are_named(change, message):
    data = {"A": HOVER[0], "B": HOVER[1], "Q": Q, "R": R} | change
    with pytest.raises(ValueError, match=message):
        dare(**data)


def test_kernels_equal_their_numpy_twins():
    rng = np.random.default_rng(4)
    A = rng.normal(size=(12, 12))
    B = rng.normal(size=(12, 4))
    x = rng.normal(size=12)
    dense, vector = np.empty((12, 4)), np.empty(12)
    matmul(A, B, dense)
    np.testing.assert_allclose(dense, A @ B, atol=1e-14)
    matvec(A, x, vector)
    np.testing.assert_allclose(vector, A @ x, atol=1e-14)


def test_elimination_pivots():
    A = np.array([[0.0, 2.0], [1.0, 1.0]])  # zero pivot without exchange
    X = np.array([[2.0], [3.0]])
    lu_solve(A, X)
    np.testing.assert_array_equal(X, [[2.0], [1.0]])


@pytest.mark.parametrize("far", [1e2, 1e4, 1e6, 1e8])
def test_weights_far_apart_have_the_solution_that_scipy_finds(far):
    P = dare(*HOVER, far * Q, R / far)
    expected = scipy.linalg.solve_discrete_are(*HOVER, far * Q, R / far)
    # scipy's own residual there is 1e-13 of P; the condition of the equation takes the rest.
    np.testing.assert_allclose(P, expected, atol=1e-9 * np.abs(expected).max())
