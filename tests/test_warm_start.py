"""A guessed working set changes how the optimum is found, never the optimum."""

import gymnasium as gym
import numpy as np
import pytest
from ocp_problems import LIMITS, MODELS, random_qp

import quad_envs  # noqa: F401  registers the ids
from baselines import check_policy, make_policy
from controllers.qp import Status, StructuredSolver
from controllers.qp.ocp import rate_weight
from controllers.qp.structured import ITERATION_LIMIT, solve_structured, step_limit
from controllers.qp.working_set import DIGITS, pack_working_set, unpack_working_set
from controllers.qp.workspace import make_workspace
from quad_envs.compilation.packed import pack

SOLVER = StructuredSolver()


def solve_from(qp, guess):
    """The solution from a guess of the states of all rows; a cold one if it is None."""
    N, K = len(qp.c), len(qp.rows.normal)
    ws = make_workspace(N, K, len(qp.A))
    if guess is not None:
        ws.guess[:] = guess
    status, steps = solve_structured(
        *qp[:-2], *qp.rows, rate_weight(qp), ITERATION_LIMIT, guess is not None, pack(ws)
    )
    return Status(status), steps, ws.u.copy(), ws.state.copy()


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("limits", LIMITS)
def test_any_guess_leads_to_the_same_optimum(model, limits):
    rng = np.random.default_rng([13, MODELS.index(model), LIMITS.index(limits)])
    for N in (1, 5, 15):
        qp = random_qp(rng, N, model, limits)
        status, _, u, state = solve_from(qp, None)
        for share in (0.02, 0.5):
            guess = np.where(rng.random(len(state)) < share, rng.integers(0, 3, len(state)), state)
            found, _, v, _ = solve_from(qp, guess.astype(np.int8))
            assert found == status
            if status == Status.OPTIMAL:
                # Both are exact: what differs is round-off over some hundred steps.
                np.testing.assert_allclose(v, u, atol=1e-9 * (1.0 + np.abs(u).max()))


@pytest.mark.parametrize("limits", ["soft", "mixed"])
def test_the_right_guess_takes_no_step(limits):
    rng = np.random.default_rng(14)
    for _ in range(5):
        qp = random_qp(rng, 10, "ltv", limits)
        status, steps, u, state = solve_from(qp, None)
        if status == Status.OPTIMAL and steps > 0:
            _, again, v, kept = solve_from(qp, state)
            assert again == 0
            np.testing.assert_allclose(v, u, atol=1e-9)
            np.testing.assert_array_equal(kept, state)


def test_a_working_set_survives_its_memory():
    rng = np.random.default_rng(15)
    for N, H in ((1, 0), (4, 3), (60, DIGITS - 8)):
        stage = np.repeat(np.arange(1, N + 1), H).astype(np.int64)
        pairs = rng.integers(0, 5, 8 * N + N * H)
        state = np.zeros(2 * len(pairs), np.int8)
        parts = np.split(state, np.cumsum([4 * N] * 4 + [N * H]))
        for part, side, digits in (
            (0, 0, pairs[: 4 * N]),
            (2, 0, pairs[4 * N : 8 * N]),
            (4, 0, pairs[8 * N :]),
        ):
            parts[part + side][:] = np.where(digits % 2 == 1, (digits + 1) // 2, 0)
            parts[part + 1][:] = np.where((digits % 2 == 0) & (digits > 0), digits // 2, 0)
        words, found = np.empty(N), np.zeros_like(state)
        counts = np.zeros(N, np.int64)
        pack_working_set(state, stage, counts, words)
        assert unpack_working_set(words.copy(), stage, counts, found) == state.any()
        np.testing.assert_array_equal(found, state)


@pytest.mark.parametrize("junk", [-1.0, 1e300, 5.0**22, 0.4])
def test_a_number_that_is_no_working_set_counts_as_none(junk):
    stage, counts = np.zeros(0, np.int64), np.zeros(2, np.int64)
    guess = np.zeros(32, np.int8)
    unpack_working_set(np.array([junk, 0.0]), stage, counts, guess)
    assert not guess.any()


@pytest.mark.parametrize("name", ["lmpc", "sdc-nmpc", "nmpc"])
@pytest.mark.parametrize("soft_weight", [1e3, np.inf])
def test_decisions_in_flight_are_those_of_a_cold_start(name, soft_weight):
    env = gym.make_vec("quad/CorridorTracking-v0", num_envs=6, rate_limit=2.0, disturbance="gusts")
    policy = make_policy(name, env, horizon=12, soft_weight=soft_weight)
    N = 12
    seen, _ = env.reset(seed=2)
    state, warm_steps, cold_steps = None, 0, 0
    for _ in range(15):
        cold = state
        if state is not None:
            memory = state.memory.copy()
            memory[:, 1 + 4 * N : 1 + 5 * N] = 0.0
            cold = state._replace(memory=memory)
        expected, after = policy.predict(seen, cold)
        action, state = policy.predict(seen, state)
        # Actions are float32 in [-1, 1]: one unit in its last place.
        np.testing.assert_allclose(action, expected, atol=2e-7)
        warm_steps += state.iterations.sum()
        cold_steps += after.iterations.sum()
        seen, *_ = env.step(action)
    assert warm_steps < 0.7 * cold_steps


@pytest.mark.parametrize("solver", ["structured", "osqp"])
def test_policies_of_both_solvers_pass_the_check_of_policies(solver):
    env = gym.make("quad/CorridorTracking-v0", rate_limit=2.0, preview=5)
    check_policy(make_policy("lmpc", env, horizon=5, solver=solver), env)


def test_the_step_limit_grows_with_the_problem():
    assert step_limit(7, 60, 500) == 7
    assert step_limit(ITERATION_LIMIT, 60, 0) > step_limit(ITERATION_LIMIT, 25, 0)
    assert step_limit(ITERATION_LIMIT, 25, 100) > step_limit(ITERATION_LIMIT, 25, 0)
