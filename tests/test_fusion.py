"""Covariance intersection, and the reference between formation and target."""

import numpy as np
import pytest
from scipy.optimize import minimize

from controllers.estimation.fusion import covariance_intersection, fuse_point, fuse_reference
from controllers.estimation.fusion_kernels import CI_WEIGHTS
from quad_envs.compilation.decorators import kernel

RNG = np.random.default_rng(0)


def random_spd(*batch, d):
    A = RNG.normal(size=(*batch, d, d))
    return A @ np.swapaxes(A, -1, -2) + 0.1 * np.eye(d)


X, P = RNG.normal(size=(20, 4, 6)), random_spd(20, 4, d=6)


def literal(x, P, w):
    information = np.linalg.inv(P)
    fused = np.linalg.inv(np.einsum("k,kij->ij", w, information))
    return fused @ np.einsum("k,kij,kj->i", w, information, x), fused


@pytest.mark.parametrize("weights", ["trace", "position-trace", "equal", "naive"])
def test_the_result_is_the_weighted_sum_of_information(weights):
    fused = covariance_intersection(X, P, weights=weights)
    for row in range(len(X)):
        block = P[row, :, :3, :3] if weights == "position-trace" else P[row]
        w = np.ones(4) if weights in ("equal", "naive") else 1.0 / np.trace(block, axis1=1, axis2=2)
        x, covariance = literal(X[row], P[row], w if weights == "naive" else w / w.sum())
        np.testing.assert_allclose(fused.x[row], x, atol=1e-10)
        np.testing.assert_allclose(fused.P[row], covariance, atol=1e-10)


def test_determinant_weights_agree_with_a_general_optimiser():
    fused = covariance_intersection(X[:, :3], P[:, :3], weights="determinant")
    for row in range(5):
        information = np.linalg.inv(P[row, :3])

        def log_det(angles, information=information):
            w = np.exp(angles) / np.exp(angles).sum()
            return -np.linalg.slogdet(np.einsum("k,kij->ij", w, information))[1]

        best = min(minimize(log_det, start).fun for start in np.eye(3))
        # Above the optimum by the stopping rule of either at most.
        np.testing.assert_allclose(np.linalg.slogdet(fused.P[row])[1], best, atol=1e-5)


@pytest.mark.parametrize("weights", [name for name in CI_WEIGHTS if name != "naive"])
def test_equal_estimates_stay_as_they_are(weights):
    fused = covariance_intersection(
        np.tile(X[:, :1], (1, 3, 1)), np.tile(P[:, :1], (1, 3, 1, 1)), None, weights
    )
    np.testing.assert_allclose(fused.x, X[:, 0], atol=1e-9)
    np.testing.assert_allclose(fused.P, P[:, 0], atol=1e-9)


def test_masked_estimates_take_no_part():
    mask = RNG.random((20, 4)) < 0.5
    mask[:, 0] = True
    fused = covariance_intersection(np.where(mask[..., None], X, np.nan), P, mask)
    for row in range(20):
        alone = covariance_intersection(X[row, mask[row]][None], P[row, mask[row]][None])
        np.testing.assert_allclose(fused.x[row], alone.x[0], atol=1e-12)
        assert fused.used[row] == mask[row].sum()


def test_bad_estimates_take_no_part():
    x, covariance = X[:1].copy(), P[:1].copy()
    x[0, 1, 2] = np.nan
    covariance[0, 2] = -np.eye(6)
    covariance[0, 3, 0, 0] = np.nan
    fused = covariance_intersection(x, covariance)
    assert fused.used[0] == 1
    np.testing.assert_allclose(fused.x[0], X[0, 0], atol=1e-12)


def test_the_order_of_the_estimates_does_not_matter():
    for weights in CI_WEIGHTS:
        one = covariance_intersection(X, P, None, weights)
        other = covariance_intersection(X[:, ::-1], P[:, ::-1], None, weights)
        np.testing.assert_allclose(one.x, other.x, atol=1e-9)


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="did you mean 'determinant'"):
        covariance_intersection(X, P, None, "determinat")
    with pytest.raises(ValueError, match=r"P must have shape \(20, 4, 6, 6\), got"):
        covariance_intersection(X, P[..., :5])
    with pytest.raises(ValueError, match="vehicle 0 has no estimate to fuse"):
        covariance_intersection(X, P, np.zeros((20, 4)))


@kernel
def compiled(r_f, w_f, P_f, r_t, v_t, P_t, r, w):
    return fuse_point(r_f, w_f, P_f, r_t, v_t, P_t, r, w)


def fused_point(r_f, w_f, P_f, r_t, v_t, P_t):
    r, w = np.empty(3), np.empty(3)
    return r, w, compiled(r_f, w_f, P_f, r_t, v_t, P_t, r, w)


def test_the_reference_is_the_printed_one():
    for _ in range(20):
        r_f, w_f, r_t, v_t = RNG.normal(size=(4, 3))
        P_t, P_f = random_spd(d=3), 0.1
        M = np.linalg.inv(np.eye(3) / P_f + np.linalg.inv(P_t))
        r, w, good = fused_point(r_f, w_f, P_f, r_t, v_t, P_t)
        assert good
        np.testing.assert_allclose(r, M @ (r_f / P_f + np.linalg.solve(P_t, r_t)), atol=1e-12)
        np.testing.assert_allclose(w, M @ (w_f / P_f + np.linalg.solve(P_t, v_t)), atol=1e-12)


def test_compiled_and_readable_reference_agree():
    r_f, w_f, r_t, v_t = RNG.normal(size=(4, 50, 3))
    P_t = random_spd(50, d=3)
    r, w = fuse_reference(r_f, w_f, 0.1, r_t, v_t, P_t)
    for i in range(50):
        np.testing.assert_allclose(
            fused_point(r_f[i], w_f[i], 0.1, r_t[i], v_t[i], P_t[i])[:2], [r[i], w[i]], atol=1e-13
        )


@pytest.mark.parametrize(("P_t", "share"), [(0.0, 1.0), (0.1, 0.5), (1e12, 0.0), (np.inf, 0.0)])
def test_the_reference_lies_between_formation_and_slot_as_the_target_is_known(P_t, share):
    diagonal = np.zeros((3, 3))
    np.fill_diagonal(diagonal, P_t)
    r, w, _ = fused_point(np.zeros(3), np.zeros(3), 0.1, np.ones(3), 2.0 * np.ones(3), diagonal)
    np.testing.assert_allclose(r, share, atol=1e-12)
    np.testing.assert_allclose(w, 2.0 * share, atol=1e-12)


@pytest.mark.parametrize("P_t", [-np.eye(3), np.full((3, 3), np.nan)], ids=["negative", "nan"])
def test_an_impossible_covariance_leaves_the_formation(P_t):
    r, w, good = fused_point(np.ones(3), np.ones(3), 0.1, np.zeros(3), np.zeros(3), P_t)
    assert not good
    np.testing.assert_array_equal(r, 1.0)
    np.testing.assert_array_equal(w, 1.0)
