"""Prediction models: identities, and derivatives against independent ones."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import scipy.linalg

from controllers.model import (
    RK4_SCRATCH,
    ZOH_SCRATCH,
    hover_pair,
    jacobian,
    rk4_sensitivities,
    sdc_matrix,
    sdc_pair,
    zero_order_hold,
)
from controllers.qp.riccati import dare, lqr_gain
from quad_envs.dynamics import derivative_reference
from quad_envs.parameters import QuadrotorParams

DT = 0.05
PARAMS = QuadrotorParams()
ODD = QuadrotorParams(mass=1.1, inertia=(0.02, 0.03, 0.05), arm=0.2, drag=0.3)
ANCHOR = np.array([0, 0, 0, 1, -0.5, 0.2, 0.1, -0.2, 0.3, 0.4, -0.3, 0.2])


def random_state(rng, angles=1.4):
    x = rng.normal(size=12) * 2.0
    x[6:9] = rng.uniform(-angles, angles, 3)
    return x


def coefficient_matrix(x, alpha, params):
    A_c = np.empty((12, 12))
    sdc_matrix(np.ascontiguousarray(x, dtype=float), alpha, params.coefficients(), A_c)
    return A_c


def rk4(x, F, d, params):
    x_next, A, B = np.empty(12), np.empty((12, 12)), np.empty((12, 4))
    scratch = np.empty((RK4_SCRATCH, 16))
    rk4_sensitivities(x, F, d, params.coefficients(), params.input_matrix(), DT, x_next, A, B, scratch)
    return x_next, A, B


def disturbed(x, F, d, params):
    return derivative_reference(x, F, params, d[:3], d[3:])


def step(x_and_F, d):
    return rk4(x_and_F[:12].copy(), x_and_F[12:].copy(), d, ODD)[0]


def central_differences(function, x, step):
    return np.stack(
        [(function(x + e) - function(x - e)) / (2 * step) for e in step * np.eye(len(x))], axis=-1
    )


@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("params", [PARAMS, ODD], ids=["published", "odd"])
def test_factorisation_is_exact(alpha, params):
    rng = np.random.default_rng(0)
    for trial in range(200):
        x = random_state(rng)
        x[6] *= trial % 3 != 0  # at angle 0 and near it the quotients are series
        x[7] *= (0.0, 1.0, 1e-6)[trial % 7 % 3]
        F = rng.uniform(0.0, 4.0, 4)
        du = F - params.hover_force
        right = coefficient_matrix(x, alpha, params) @ x + params.input_matrix() @ du
        wrong = derivative_reference(x, F, params)
        assert np.abs(right - wrong).max() <= 1e-13 * (1.0 + np.abs(wrong).max())


def test_coefficients_of_the_anchor_state():
    half, one = coefficient_matrix(ANCHOR, 0.5, PARAMS), coefficient_matrix(ANCHOR, 1.0, PARAMS)
    gravity = [[0, -9.734797, 0], [9.588653, 0, 0], [-0.484712, 0.974298, 0]]
    np.testing.assert_allclose(half[3:6, 6:9], gravity, atol=1e-6)
    np.testing.assert_allclose(half[3:6, 3:6], [[0, 0.1, 0.15], [-0.1, 0, 0.2], [-0.15, -0.2, 0]], atol=1e-15)
    turning = np.array([[0, -0.1, -0.25], [0.1, 0, -0.5], [0.25, 0.5, 0]])
    np.testing.assert_allclose(half[3:6, 9:12], turning, atol=1e-15)
    np.testing.assert_allclose(one[3:6, 9:12], 2 * turning, atol=1e-15)
    assert not one[3:6, 3:6].any()


def test_coefficients_stay_finite_at_vertical_pitch():
    x = np.zeros(12)
    x[7], x[11] = np.pi / 2, 1.0
    assert np.isfinite(coefficient_matrix(x, 1.0, PARAMS)).all()


@pytest.mark.parametrize("rate", [0.5, 5.0, 200.0])
def test_zero_order_hold_is_the_matrix_exponential(rate):
    rng = np.random.default_rng(1)
    for _ in range(20):
        x = random_state(rng)
        x[9:12] *= rate
        A_c, B_c = coefficient_matrix(x, 0.5, PARAMS), PARAMS.input_matrix()
        A, B = np.empty((12, 12)), np.empty((12, 4))
        zero_order_hold(A_c, B_c, DT, A, B, np.empty((ZOH_SCRATCH, 12, 12)))
        exact = scipy.linalg.expm(DT * np.block([[A_c, B_c], [np.zeros((4, 16))]]))
        # The first term left out, 1.2^13 / 14! = 1e-10 at worst, counts where A_c is far from nilpotent.
        tolerance = (1e-14 if rate < 100.0 else 1e-10) * np.abs(exact).max()
        np.testing.assert_allclose(A, exact[:12, :12], atol=tolerance, rtol=0)
        np.testing.assert_allclose(B, exact[:12, 12:], atol=tolerance, rtol=0)


def test_hover_pair_has_the_published_entries():
    A, B = hover_pair(PARAMS, DT)
    g, m = PARAMS.gravity, PARAMS.mass
    assert A[0, 3] == pytest.approx(DT, rel=1e-14)
    assert A[0, 7] == pytest.approx(-g * DT**2 / 2, rel=1e-14)
    assert A[0, 10] == pytest.approx(-g * DT**3 / 6, rel=1e-14)
    assert B[2] == pytest.approx(-(DT**2) / (2 * m), rel=1e-14)
    assert B[5] == pytest.approx(-DT / m, rel=1e-14)
    assert B[9, 1] == pytest.approx(-0.3683036, rel=1e-6)


def test_hover_riccati_solution_has_the_published_entries():
    A, B = hover_pair(PARAMS, DT)
    K, P = lqr_gain(A, B, np.eye(12), np.eye(4))
    diagonal = [31.3253, 31.3253, 27.3491, 18.5583, 18.5583, 11.2606, 176.6108, 176.6108, 92.4145]
    np.testing.assert_allclose(np.diag(P), [*diagonal, 3.5451, 3.5451, 925.1614], rtol=1e-4)
    assert np.trace(P) == pytest.approx(1516.264595, rel=1e-8)
    assert P[0, 3] == pytest.approx(13.74880, rel=1e-6)
    row = [-0.4785, 0, -0.45981, -0.74945, 0, -0.62876, 0, 3.40721, -0.49432, 0, 0.81806, -2.28413]
    np.testing.assert_allclose(K[0], row, atol=1e-4)
    assert np.abs(np.linalg.eigvals(A - B @ K)).max() == pytest.approx(0.988644, rel=1e-5)


@pytest.mark.parametrize(("alpha", "trace"), [(0.5, 1608.932), (1.0, 1685.015)])
def test_riccati_solution_away_from_hover_has_the_published_trace(alpha, trace):
    x = np.array([3, 3, 3, 1, 0.5, -0.5, 0.2, -0.3, 0.1, 0.5, 0.4, 0.1])
    A, B = sdc_pair(x, PARAMS, DT, alpha)
    P = dare(A, B, np.eye(12), np.eye(4))
    assert np.trace(P) == pytest.approx(trace, rel=1e-6)
    np.testing.assert_allclose(
        P, scipy.linalg.solve_discrete_are(A, B, np.eye(12), np.eye(4)), rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize("params", [PARAMS, ODD], ids=["published", "odd"])
def test_jacobian_agrees_with_central_differences(params):
    rng = np.random.default_rng(2)
    for _ in range(50):
        x, F, d, J = random_state(rng), rng.uniform(0.0, 4.0, 4), rng.normal(size=6), np.empty((12, 12))
        jacobian(x, d, params.coefficients(), J)
        differences = central_differences(partial(disturbed, F=F, d=d, params=params), x, 1e-6)
        # Rounding of the differences: 1e-16 of the derivative over the step.
        np.testing.assert_allclose(J, differences, rtol=1e-7, atol=1e-7)


def test_rk4_sensitivities_agree_with_central_differences():
    rng = np.random.default_rng(3)
    for _ in range(50):
        x, F, d = random_state(rng, 1.0), rng.uniform(0.0, 4.0, 4), rng.normal(size=6)
        _, A, B = rk4(x, F, d, ODD)
        by_x = central_differences(partial(step, d=d), np.r_[x, F], 1e-5)
        by_x, by_F = by_x[:, :12], by_x[:, 12:]
        np.testing.assert_allclose(A, by_x, atol=1e-8)
        np.testing.assert_allclose(B, by_F, atol=1e-9)


def test_rk4_agrees_with_its_textbook_form():
    x, F, d = ANCHOR, np.array([2.5, 1.5, 2.2, 1.8]), np.zeros(6)

    def f(y):
        return derivative_reference(y, F, PARAMS)

    k1 = f(x)
    k2 = f(x + DT / 2 * k1)
    k3 = f(x + DT / 2 * k2)
    k4 = f(x + DT * k3)
    np.testing.assert_allclose(rk4(x, F, d, PARAMS)[0], x + DT / 6 * (k1 + 2 * k2 + 2 * k3 + k4), atol=1e-14)
