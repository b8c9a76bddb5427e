"""The Riccati recursion in vector registers beside its equations in numpy, and what is made of it."""

from __future__ import annotations

import re

import numpy as np
import pytest
import recursion_twin as twin
from numba.core.caching import NullCache
from ocp_problems import HOVER_P, MODELS, random_qp

from controllers.model import sdc_pair
from controllers.qp.products import (
    add_matvec_transposed,
    add_product,
    negate,
    product,
    symmetric_part,
    transpose,
)
from controllers.qp.recursion import RECURSION_SCRATCH, Feedback, Regulator, optimal_plan, riccati_pass
from quad_envs.compilation.decorators import kernel
from quad_envs.parameters import QuadrotorParams

VIOLENT = np.repeat([3.0, 6.0, 1.5, 12.0], 3)  # a violent state: 6 m/s, upside down, 700 deg/s


@kernel
def all_products(L, R, S, x, out, more):
    product(L, R, out[0])
    add_product(S, L, R, out[1])
    negate(R, out[2])
    transpose(L, more)
    symmetric_part(S, out[3])
    add_matvec_transposed(S, x, -2.0, out[4, 0])


@pytest.mark.parametrize("n", [4, 8, 12, 16])
def test_products_equal_their_numpy_twins(n):
    rng = np.random.default_rng(n)
    L, R, S = (rng.normal(size=(n, n)) for _ in range(3))
    x, out, more = rng.normal(size=n), np.zeros((5, n, n)), np.zeros((n, n))
    all_products(L, R, S, x, out, more)
    expected = L.T @ R, S + L.T @ R, -R, 0.5 * (S + S.T)
    for one, other in zip(out, expected, strict=False):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-14 * n)
    np.testing.assert_array_equal(more, L.T)
    np.testing.assert_array_equal(out[3], out[3].T)
    np.testing.assert_allclose(out[4, 0], -2.0 * S.T @ x, atol=1e-14 * n)


def solve(problem):
    """Feedback, inputs and states of the kernels."""
    N, n = problem.c.shape
    feedback = Feedback(
        np.zeros((len(problem.A), n + 4, n)), np.zeros((N, 4, n)), np.zeros((N, 4, 4)), np.zeros((N, n))
    )
    scratch, u, x = np.zeros((RECURSION_SCRATCH, n, n)), np.zeros((N, 4)), np.zeros((N + 1, n))
    riccati_pass(problem, feedback, scratch)
    optimal_plan(problem, feedback, u, x, scratch[0])
    return feedback, u, x


def relative(found, expected):
    return np.abs(found - expected).max() / np.abs(expected).max()


def agree_with_the_twin(problem):
    feedback, u, x = solve(problem)
    K, S, P_next = twin.backward(problem)
    gains = feedback.K[:1] if problem.stationary else feedback.K
    factors = feedback.D[:1] if problem.stationary else feedback.D
    assert relative(gains, K[: len(gains)]) < 1e-12
    assert relative(factors @ np.swapaxes(factors, 1, 2), np.linalg.inv(S[: len(factors)])) < 1e-12
    u_twin, x_twin = twin.forward(problem, K, S, P_next)
    assert relative(u, u_twin) < 1e-12
    assert relative(x, x_twin) < 1e-12


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("N", [1, 2, 25])
def test_the_plan_equals_the_readable_recursion(model, N):
    rng = np.random.default_rng([N, MODELS.index(model)])
    for _ in range(5):
        agree_with_the_twin(Regulator(*random_qp(rng, N, model, "none")[:9]))


def test_the_plan_of_pairs_met_on_a_violent_flight_equals_the_readable_recursion():
    rng = np.random.default_rng(3)
    for _ in range(20):
        pairs = [sdc_pair(VIOLENT * rng.normal(size=12), QuadrotorParams(), 0.05, 1.0) for _ in range(25)]
        A, B = (np.ascontiguousarray([pair[k] for pair in pairs]) for k in range(2))
        c, r = 0.1 * rng.normal(size=(25, 12)), rng.normal(size=(26, 12))
        x_0 = VIOLENT * rng.normal(size=12)
        agree_with_the_twin(Regulator(A, B, c, np.eye(12)[None], np.eye(4)[None], HOVER_P, False, x_0, r))


def test_a_problem_over_states_and_last_inputs_equals_the_readable_recursion():
    """Of 16 states, as a weight on changes makes it."""
    rng = np.random.default_rng(4)
    for _ in range(10):
        A, B = 0.3 * rng.normal(size=(9, 16, 16)), rng.normal(size=(9, 16, 4))
        root = rng.normal(size=(9, 16, 16))
        Q = root @ np.swapaxes(root, 1, 2)
        c, r, x_0 = rng.normal(size=(9, 16)), rng.normal(size=(10, 16)), rng.normal(size=16)
        agree_with_the_twin(Regulator(A, B, c, Q, np.eye(4)[None], Q[0].copy(), False, x_0, r))


def test_the_cost_to_go_stays_symmetric():
    problem = Regulator(*random_qp(np.random.default_rng(5), 25, "ltv", "none")[:9])
    scratch, feedback = np.zeros((RECURSION_SCRATCH, 12, 12)), solve(problem)[0]
    riccati_pass(problem, feedback, scratch)
    np.testing.assert_array_equal(scratch[0], scratch[0].T)


def test_the_backward_pass_works_on_vectors():
    """Four products and sums in one instruction: else it takes four times as long."""

    @kernel
    def alone(problem, feedback, scratch):
        riccati_pass(problem, feedback, scratch)

    alone.entry._cache = NullCache()  # what comes from the cache cannot be inspected
    problem = Regulator(*random_qp(np.random.default_rng(6), 3, "ltv", "none")[:9])
    alone(problem, solve(problem)[0], np.zeros((RECURSION_SCRATCH, 12, 12)))
    (assembly,) = alone.entry.inspect_asm().values()
    packed = re.findall(r"\b(?:v?mulpd|vfmadd\w*pd)\b", assembly)  # of two numbers each without AVX
    scalar = re.findall(r"\b(?:v?mulsd|vfmadd\w*sd)\b", assembly)
    assert len(packed) > 100, (len(packed), len(scalar))
    assert len(scalar) < len(packed) / 2, (len(packed), len(scalar))
