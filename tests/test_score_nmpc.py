"""NMPC that plans for the score: its weights, what its plans promise, its step control, IPOPT, flights."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from flights import DT, HOVER, TASK, at_rest, calm, decide_once, held_under, helix, plan_of, rest, window
from rows_alone import require_equal_alone
from test_nmpc import STATE, ipopt_plan, turning_window

from baselines import evaluate, make_policy
from controllers import ExactNmpc
from controllers.mpc.score import score_loss, tangent_weight
from controllers.qp.osqp import OsqpSolver
from quad_envs.dynamics import derivative_reference
from quad_envs.parameters import Limits
from quad_envs.references.turning import with_turn_rates
from quad_envs.reward import stage_cost
from quad_envs.tasks import Task

N = 25
MORE = N + 1  # horizon of a window from which the next sample has its own, too


def predicted(x_0, u, rows, task=TASK):
    """Stage costs l(x_{i+1}, u_i) along a plan u (N, 4), by RK4 on the exact model."""
    x, costs = x_0[:12].copy(), []
    for i, du in enumerate(u):
        F = du + HOVER

        def f(y, F=F):
            return derivative_reference(y, F, task.params)

        k1 = f(x)
        k2 = f(x + DT / 2 * k1)
        k3 = f(x + DT / 2 * k2)
        k4 = f(x + DT * k3)
        x = x + DT / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        costs.append(float(stage_cost(x, rows[i + 1], F, HOVER, task.weights)))
    return np.array(costs)


def loss(costs):
    """What stage costs lose of the score."""
    return float(np.sum(costs / (1.0 + costs)))


def test_the_tangent_lies_above_what_the_score_loses():
    rng = np.random.default_rng(0)
    for a, b in 10.0 ** rng.uniform(-4, 5, (2000, 2)):
        bound = score_loss(a) + tangent_weight(a) * (b - a)
        assert score_loss(b) <= bound + 1e-12 * max(1.0, abs(bound))
        assert score_loss(a) == pytest.approx(1.0 - 1.0 / (1.0 + a), abs=1e-12)


@pytest.mark.parametrize("floor", [0.05, 0.5])
def test_stages_are_weighed_by_the_slope_at_the_shifted_guess(floor):
    """Against the reward's own stage cost at the guess that the memory holds."""
    score = ExactNmpc(TASK, objective="score", floor=floor, frame="hover")
    cost = ExactNmpc(TASK, frame="hover")
    rows = window(helix, 0, MORE)
    memory = decide_once(cost, at_rest((0.3, -0.2, 0.4)), rows[:-1]).memory[0]
    X, F = memory[2 + 5 * N :].reshape(N + 1, 12), memory[1 : 1 + 4 * N].reshape(N, 4)
    after = np.minimum(np.arange(N + 1) + 1, N)
    plant = np.r_[X[1], F[0]]
    given = plant, rows[1:], F[0], np.zeros(6), memory
    weighed, plain = score.problem(*given), cost.problem(*given)
    guess, inputs = X[after], F[np.minimum(np.arange(N) + 1, N - 1)]
    w = 1.0 / (1.0 + stage_cost(guess[1:], rows[2:], inputs, HOVER, TASK.weights)) ** 2
    w = np.maximum(w / w.max(), floor)
    np.testing.assert_allclose(weighed.Q[1:], plain.Q[1:] * w[:-1, None, None], rtol=1e-9)
    np.testing.assert_allclose(weighed.R, plain.R * w[:, None, None], rtol=1e-9)
    np.testing.assert_allclose(weighed.Q_f, plain.Q_f * w[-1], rtol=1e-9)
    np.testing.assert_array_equal(weighed.rows.weight, plain.rows.weight)


def test_without_a_floor_below_one_it_is_the_nmpc_of_the_cost():
    rows = window(helix, 0, N)
    a, b = (ExactNmpc(TASK, **options) for options in ({}, {"objective": "score", "floor": 1.0}))
    first = decide_once(a, STATE, rows)
    for memory in (first.memory[0], decide_once(a, STATE, rows, memory=first.memory[0]).memory[0]):
        np.testing.assert_array_equal(
            decide_once(a, STATE, rows, memory=memory).command,
            decide_once(b, STATE, rows, memory=memory).command,
        )


def test_along_a_flight_its_plans_lose_less_of_the_score_than_those_for_the_cost():
    """The model's own prediction, by equations that the controller does not share."""
    cost, score = (ExactNmpc(TASK, objective=name, frame="hover") for name in ("cost", "score"))
    plant, memories, losses = at_rest((0.5, -0.5, 0.5)), [None, None], []
    for k in range(40):
        rows = window(helix, k, N)
        decisions = [
            decide_once(mpc, plant, rows, memory=memory)
            for mpc, memory in zip((cost, score), memories, strict=True)
        ]
        memories = [decision.memory[0] for decision in decisions]
        losses.append([loss(predicted(plant, plan_of(each, N), rows)) for each in decisions])
        plant = held_under(plant, decisions[1].command[0], TASK, calm, k)
    of_cost, of_score = np.array(losses[3:]).T
    assert of_score.mean() < of_cost.mean()
    assert (of_score < of_cost)[-10:].all()  # near the reference


@pytest.mark.parametrize("options", [{}, {"R_rate": 2.0}, {"Q": 3.0, "R": 0.5, "terminal": 0.5}])
def test_osqp_finds_the_same_command(options):
    """Its tolerance is of the heaviest stage, beside which the first one weighs 0.03."""
    rows = window(helix, 0, N)
    exact, approximate = (
        ExactNmpc(TASK, objective="score", solver=solver, **options) for solver in ("structured", "osqp")
    )
    approximate._backend = OsqpSolver(eps=3e-7, persistent=False)
    memory = decide_once(exact, at_rest((1.0, -0.5, 0.5)), rows).memory[0]
    a, b = (decide_once(mpc, at_rest((1.0, -0.5, 0.5)), rows, memory=memory) for mpc in (exact, approximate))
    np.testing.assert_allclose(a.command, b.command, atol=1e-2)


@pytest.mark.parametrize("solver", ["structured", "osqp"])
def test_a_plan_that_promises_less_than_its_guess_is_made_for_the_cost_instead(solver):
    """The guess says that the vehicle is at its reference, which is 1 m away: no weight of it holds."""
    score, cost = (ExactNmpc(TASK, objective=name, solver=solver) for name in ("score", "cost"))
    rows = window(rest, 0, N)
    rows[:, 0] = 1.0
    honest = decide_once(cost, at_rest(), rows).memory[0]
    boast = honest.copy()
    boast[2 + 5 * N :].reshape(N + 1, 12)[2:] = np.r_[1.0, np.zeros(11)]
    boast[2 + 5 * N :].reshape(N + 1, 12)[1] = 0.0
    a, b = (decide_once(mpc, at_rest(), rows, memory=boast) for mpc in (score, cost))
    np.testing.assert_allclose(a.command, b.command, atol=1e-9)
    a, b = (decide_once(mpc, at_rest(), rows, memory=honest) for mpc in (score, cost))
    assert np.abs(a.command - b.command).max() > 0.01


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"objective": "reward"}, "'cost', 'score'"),
        ({"floor": 0.0}, r"floor must lie in \(0, 1\], got 0.0"),
        ({"floor": 1.5}, "which is the quadratic cost"),
    ],
)
def test_an_objective_or_floor_that_means_nothing_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ExactNmpc(TASK, **options)


def test_rows_decide_as_single_vehicles_do():
    rng = np.random.default_rng(1)
    mpc = ExactNmpc(TASK, objective="score")
    plants = STATE + rng.normal(0.0, 0.3, (5, 16))
    require_equal_alone(mpc, plants)


@pytest.mark.parametrize("env_id", ["quad/HelixTracking-v0", "quad/SpiralTracking-v0", "quad/Regulation-v0"])
def test_score_nmpc_scores_more_than_nmpc_and_costs_more(env_id):
    env = gym.make_vec(env_id, num_envs=6)
    nmpc, score = (evaluate(make_policy(name, env), env, 6, 0) for name in ("nmpc", "score-nmpc"))
    gain = [b.score - a.score for a, b in zip(nmpc.records, score.records, strict=True)]
    assert min(gain) > 0.0 and np.mean(gain) > 0.02
    assert score.summary()["quadratic_cost"].mean > nmpc.summary()["quadratic_cost"].mean
    assert not any(record.crashed or record.violation_share for record in score.records)


def test_score_nmpc_keeps_the_limits_of_the_corridor():
    env = gym.make_vec("quad/CorridorTracking-v0", num_envs=6)
    nmpc, score = (evaluate(make_policy(name, env), env, 6, 0).summary() for name in ("nmpc", "score-nmpc"))
    assert score["violation_share"].mean == 0.0
    assert score["score"].mean > nmpc["score"].mean - 0.001  # 100 starts have it above, six do not tell


def test_its_usual_floor_is_higher_where_the_state_is_limited():
    free, limited = Task(), Task(limits=Limits(tilt=0.35))
    floors = [
        ExactNmpc(task, objective="score").options.least_weight(task.limits) for task in (free, limited)
    ]
    assert floors == [0.03, 0.1]
    for task, floor in zip((free, limited), floors, strict=True):
        usual, chosen = (ExactNmpc(task, objective="score", **more) for more in ({}, {"floor": floor}))
        assert usual._floor == chosen._floor == floor


SCENES = {
    "free, turning": (STATE, Limits(), turning_window(15)),
    "free, helix": (STATE, Limits(), window(helix, 0, 15)),
    "weak rotors and a rate limit, turning": (STATE, Limits(kappa=0.3125, rate=5.0), turning_window(15)),
    "weak rotors and a rate limit, helix": (STATE, Limits(kappa=0.3125, rate=5.0), window(helix, 0, 15)),
    "at rest, helix": (at_rest((1.0, -0.5, 0.5)), Limits(), window(helix, 0, 15)),
    "weak rotors, turning": (at_rest((1.5, 1.0, -0.8)), Limits(kappa=0.3125), turning_window(15)),
}


@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES)
def test_its_converged_plan_is_the_one_that_ipopt_finds_for_the_score_itself(scene):
    """Weights of a tangent are exact where the plan is its own guess; 1e-4 of a stage is where both stop.

    The terminal weight is that of a stage, so that the sum of l / (1 + l) is all there is.
    """
    x_0, limits, rows = SCENES[scene]
    task, horizon, last = Task(limits=limits), 15, np.full(4, HOVER)
    cost, score = (
        ExactNmpc(task, horizon=horizon, passes=100, frame="hover", terminal=np.eye(12), **options)
        for options in ({}, {"objective": "score", "floor": 1e-5})
    )
    memory = decide_once(cost, x_0, rows, last).memory[0]
    plans = [plan_of(decide_once(mpc, x_0, rows, last, memory=memory), horizon) for mpc in (cost, score)]
    best = ipopt_plan(
        *(x_0[:12], with_turn_rates(rows, DT), last, task, horizon, "inertial", np.eye(12)),
        stage=lambda cost: cost / (1.0 + cost),
    )
    costs, ours, optimum = (loss(predicted(x_0, plan, rows, task)) for plan in (*plans, best))
    assert abs(ours - optimum) < 1e-4 < costs - ours
