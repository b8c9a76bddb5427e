"""LMPC and SDC-NMPC that plan for the score: dense least squares, OSQP, their step control, flights."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from flights import HOVER, TASK, at_rest, calm, decide_once, held_under, helix, plan_of, rest, window
from rows_alone import require_equal_alone
from scipy.optimize import lsq_linear

from baselines import evaluate, make_policy
from baselines.training.tuned_options import make_search
from controllers import LinearMPC, SdcNmpc
from controllers.qp.osqp import OsqpSolver
from quad_envs.parameters import Limits
from quad_envs.tasks import Task

N = 25
FAR = at_rest((1.0, -0.5, 0.5))
ONE_PASS = {LinearMPC: {}, SdcNmpc: {"relinearisations": 0}}


def memory_of(mpc, steps=5, start=FAR, task=TASK):
    """Plant, window, last command and memory of a flight after so many samples."""
    plant, last, memory = start, np.full(4, HOVER), np.zeros(mpc.memory_size)
    for k in range(steps):
        decision = decide_once(mpc, plant, window(helix, k, N), last, memory=memory)
        memory, last = decision.memory[0], decision.command[0]
        plant = held_under(plant, last, task, calm, k)
    return plant, window(helix, steps, N), last, memory


def as_late(cost, score):
    """The controller for the cost with the rotor lag that the one for the score predicts."""
    cost._data = cost._data._replace(lag=score._data.lag)
    return cost


def rolled(qp, inputs):
    """States x_1 .. x_N of the problem's model under inputs, (N, 12)."""
    x, states = qp.x_0, []
    for i, u in enumerate(inputs):
        j = i if len(qp.A) > 1 else 0
        x = qp.A[j] @ x + qp.B[j] @ u + qp.c[i]
        states.append(x)
    return np.array(states)


def score_weights(qp, memory, floor):
    """1 / (1 + l)^2 of the previous plan, shifted by a sample and flown by the model, over the largest."""
    after = np.minimum(np.arange(N) + 1, N - 1)
    u = memory[1 : 1 + 4 * N].reshape(N, 4)[after] + qp.lower  # lower is -F_trim
    e = rolled(qp, u) - qp.r[1:]
    loss = np.einsum("ia,ab,ib->i", e, qp.Q[0], e) + np.einsum("ia,ab,ib->i", u, qp.R[0], u)
    w = 1.0 / (1.0 + loss) ** 2
    return np.maximum(w / w.max(), floor)


def dense_plan(qp, w, R_rate=0.0):
    """The weighed problem as one bounded least-squares problem in the inputs."""
    free = rolled(qp, np.zeros((N, 4)))
    columns = []
    for k in range(4 * N):
        u = np.zeros(4 * N)
        u[k] = 1.0
        columns.append((rolled(qp, u.reshape(N, 4)) - free).ravel())
    S = np.stack(columns, axis=-1).reshape(N, 12, 4 * N)
    # x_N has the terminal weight alone
    roots = [np.linalg.cholesky(w[i] * qp.Q[0]).T for i in range(N - 1)]
    roots.append(np.linalg.cholesky(w[N - 1] * qp.Q_f).T)
    rows = [roots[i] @ S[i] for i in range(N)]
    wanted = [roots[i] @ (qp.r[i + 1] - free[i]) for i in range(N)]
    rows.append(np.kron(np.diag(np.sqrt(w)), np.linalg.cholesky(qp.R[0]).T))
    wanted.append(np.zeros(4 * N))
    changes = np.eye(4 * N) - np.eye(4 * N, k=-4)
    rows.append(np.sqrt(R_rate) * changes)
    wanted.append(np.sqrt(R_rate) * np.r_[qp.u_last, np.zeros(4 * N - 4)])
    bounds = np.tile(qp.lower, N), np.tile(qp.upper, N)
    found = lsq_linear(np.vstack(rows), np.concatenate(wanted), bounds, method="bvls", tol=1e-14)
    return found.x.reshape(N, 4)


@pytest.mark.parametrize("kappa", [1.0, 0.3125])  # the box is met
@pytest.mark.parametrize("R_rate", [None, 2.0])
@pytest.mark.parametrize("kind", [LinearMPC, SdcNmpc])
def test_the_plan_is_that_of_dense_least_squares_with_stages_weighed_by_the_slope(kind, R_rate, kappa):
    task, options = Task(limits=Limits(kappa=kappa)), {"R_rate": R_rate, **ONE_PASS[kind]}
    score = kind(task, objective="score", floor=0.05, **options)
    cost = as_late(kind(task, **options), score)
    plant, rows, last, memory = memory_of(score, task=task)
    qp = cost.problem(plant, rows, last, np.zeros(6), memory)
    w = score_weights(qp, memory, 0.05)
    assert w.min() < 0.5 * w.max()  # it is another problem
    plan = plan_of(decide_once(score, plant, rows, last, memory=memory), N)
    np.testing.assert_allclose(plan, dense_plan(qp, w, R_rate or 0.0), atol=1e-6)
    other = plan_of(decide_once(cost, plant, rows, last, memory=memory), N)
    assert np.abs(plan - other).max() > 1e-3


@pytest.mark.parametrize("kind", [LinearMPC, SdcNmpc])
def test_with_a_floor_of_one_and_at_the_first_sample_it_plans_for_the_cost(kind):
    cost, one, score = (
        kind(TASK, **more) for more in ({}, {"objective": "score", "floor": 1.0}, {"objective": "score"})
    )
    plant, rows, last, memory = memory_of(cost)
    a, b = (decide_once(mpc, plant, rows, last, memory=memory) for mpc in (cost, one))
    np.testing.assert_array_equal(a.memory, b.memory)
    as_late(cost, score)._memories.clear()
    a, b = (decide_once(mpc, FAR, window(helix, 0, N)) for mpc in (cost, score))
    if kind is LinearMPC:  # a further pass of SDC-NMPC has the plan of the first one for its guess
        np.testing.assert_allclose(a.command, b.command, atol=1e-9)


@pytest.mark.parametrize("options", [{}, {"R_rate": 2.0}, {"Q": 3.0, "R": 0.5, "terminal": 0.5}])
@pytest.mark.parametrize("kind", [LinearMPC, SdcNmpc])
def test_osqp_finds_the_same_command(kind, options):
    """Its tolerance is of the heaviest stage."""
    exact, approximate = (
        kind(TASK, objective="score", solver=solver, **options) for solver in ("structured", "osqp")
    )
    approximate._backend = OsqpSolver(eps=3e-7, persistent=False)
    start = at_rest((1.5, -1.0, 0.5), Theta=(0.3, -0.3, 1.0))
    plant, rows, last, memory = memory_of(exact, 3, start)
    a, b = (decide_once(mpc, plant, rows, last, memory=memory) for mpc in (exact, approximate))
    np.testing.assert_allclose(a.command, b.command, atol=1e-2)


@pytest.mark.parametrize("solver", ["structured", "osqp"])
@pytest.mark.parametrize("kind", [LinearMPC, SdcNmpc])
def test_a_plan_that_promises_less_than_its_guess_is_made_for_the_cost_instead(kind, solver):
    """The guess does not know of a rate limit that leaves hardly any way to move."""
    slow, options = Task(limits=Limits(rate=0.5)), {"R": 0.1, **ONE_PASS[kind]}
    cost, score = (kind(slow, objective=name, solver=solver, **options) for name in ("cost", "score"))
    cost = as_late(cost, score)
    rows, start = window(rest, 0, N), at_rest((0.5, -0.3, 1.0))
    guesses = [decide_once(kind(task, **options), start, rows).memory[0] for task in (TASK, slow)]
    decided = []
    for memory in guesses:
        memory[5 : 1 + 4 * N] = memory[1 : 1 + 4 * (N - 1)].copy()  # so that the guess, shifted, is the plan
        decided += [decide_once(mpc, start, rows, memory=memory).memory[0] for mpc in (score, cost)]
    boast, for_cost, honest, likewise = decided
    np.testing.assert_allclose(boast, for_cost, atol=1e-6)
    assert np.abs(honest - likewise).max() > 1e-3


@pytest.mark.parametrize("name", ["lmpc", "sdc-nmpc"])
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"objective": "reward"}, "'cost', 'score'"),
        ({"objective": "scor"}, "score"),
        ({"floor": 0.0}, r"floor must lie in \(0, 1\], got 0.0"),
        ({"floor": 1.5}, "which is the quadratic cost"),
        ({"floor": np.nan}, "floor .*got nan"),
    ],
)
def test_an_objective_or_floor_that_means_nothing_is_refused(name, options, message):
    with pytest.raises(ValueError, match=message):
        make_policy(name, TASK, **options)


@pytest.mark.parametrize("options", [{}, {"R_rate": 1.0, "reject_disturbance": True}])
@pytest.mark.parametrize("kind", [LinearMPC, SdcNmpc])
def test_rows_decide_as_single_vehicles_do(kind, options):
    rng = np.random.default_rng(1)
    mpc = kind(TASK, objective="score", **options)
    plants = FAR + rng.normal(0.0, 0.3, (5, 16))
    require_equal_alone(mpc, plants)


@pytest.mark.parametrize("name", ["lmpc", "sdc-nmpc"])
def test_its_floor_is_tuned_where_there_is_one(name):
    assert "floor" in make_search(name, TASK, {"objective": "score"}).names
    assert "floor" not in make_search(name, TASK, {}).names


def test_a_weighed_plan_counts_the_iterations_of_all_of_its_solves():
    mpc = LinearMPC(Task(limits=Limits(kappa=0.3125)), objective="score")
    decision = decide_once(mpc, *memory_of(mpc, 3, at_rest((3.0, 2.0, 1.0)), mpc.task)[:3])
    assert decision.iterations[0] > 0 and decision.fallback[0] == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lmpc", "sdc-nmpc"])
def test_on_held_out_helices_it_scores_more_than_for_the_cost_and_costs_more(name):
    env = gym.make_vec("quad/HelixTracking-v0", num_envs=20)
    cost, score = (
        evaluate(make_policy(name, env, objective=each), env, 20, 10_000) for each in ("cost", "score")
    )
    gain = [b.score - a.score for a, b in zip(cost.records, score.records, strict=True)]
    assert min(gain) > 0.0 and np.mean(gain) > 0.015
    assert score.summary()["quadratic_cost"].mean > cost.summary()["quadratic_cost"].mean
    assert not any(record.crashed or record.violation_share for record in score.records)
