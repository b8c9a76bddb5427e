"""A weight on changes of the command: the optimum, agreement with dense QPs, and what it does in flight."""

from __future__ import annotations

import daqp
import gymnasium
import numpy as np
import pytest
from flights import HOVER, TASK, WEAK, at_rest, decide_once, helix, plan_of, window
from ocp_problems import LIMITS, MODELS, random_qp

from baselines import check_policy, make_policy
from baselines.certify import certify
from baselines.evaluation.rollout import run_episodes
from benchmarks.condensed import dense_program
from controllers import ExactNmpc, LinearMPC, SdcNmpc
from controllers.qp import Status, StructuredSolver, residuals
from controllers.qp.ocp import condense
from controllers.qp.osqp import OsqpSolver
from quad_envs.parameters import Limits
from quad_envs.tasks import Task

N = 12
MPCS = (LinearMPC, SdcNmpc, ExactNmpc)
LAST = np.array([1.2, 2.6, 1.7, 2.4])
HELIX = "quad/HelixTracking-v0"


def roll_out(qp, u):
    x = [qp.x_0]
    for i, u_i in enumerate(u):
        j = i if len(qp.A) > 1 else 0
        x.append(qp.A[j] @ x[-1] + qp.B[j] @ u_i + qp.c[i])
    return np.array(x)


def cost_of(qp, u):
    """The cost of a plan as `ocp.py` writes it, without the soft rows."""
    e, total, before = roll_out(qp, u) - qp.r, 0.0, qp.u_last
    for i, u_i in enumerate(u):
        Q, R = (weight[i if len(weight) > 1 else 0] for weight in (qp.Q, qp.R))
        total += e[i] @ Q @ e[i] + u_i @ R @ u_i + (u_i - before) @ qp.R_rate @ (u_i - before)
        before = u_i
    return 0.5 * (total + e[-1] @ qp.Q_f @ e[-1])


def dense(qp):
    """H and g of the cost in u, by evaluating it: it is quadratic, so that differences are exact."""
    shape = (len(qp.c), 4)
    nv = shape[0] * 4
    unit = np.eye(nv).reshape(nv, *shape)
    zero = cost_of(qp, np.zeros(shape))
    plus, minus = (np.array([cost_of(qp, s * e) for e in unit]) for s in (1.0, -1.0))
    both = np.array([[cost_of(qp, a + b) for b in unit] for a in unit])
    return both - plus[:, None] - plus[None] + zero, 0.5 * (plus - minus)


def with_rate(qp, rng):
    """The problem with a random weight of the changes, of full rank or of rank 2, small or large."""
    root = rng.normal(size=(4, rng.choice([2, 4]))) * rng.choice([0.1, 1.0, 30.0])
    return qp._replace(R_rate=np.ascontiguousarray(root @ root.T))


def weights(rate, size=1.0):
    return {"number": size, "diagonal": size * np.array([1.0, 2.0, 3.0, 4.0]), "matrix": size * MATRIX}[rate]


MATRIX = np.eye(4) + 0.4


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("limits", LIMITS)
@pytest.mark.parametrize("horizon", [1, 2, 25])
def test_a_random_problem_satisfies_the_optimality_conditions(model, limits, horizon):
    """As without the weight: 1e-9 is round-off over several hundred steps."""
    rng = np.random.default_rng([7, horizon, MODELS.index(model), LIMITS.index(limits)])
    solver, solved = StructuredSolver(), 0
    for _ in range(4):
        qp = with_rate(random_qp(rng, horizon, model, limits), rng)
        solution = solver.solve(qp)
        if solution.status == Status.OPTIMAL:
            solved += 1
            assert max(residuals(qp, solution)) < 1e-9
        else:
            assert solution.status == Status.INFEASIBLE and limits in ("hard", "mixed")
    assert solved > 0


@pytest.mark.parametrize("model", MODELS)
def test_the_condensed_cost_is_the_cost_as_written(model):
    qp = with_rate(random_qp(np.random.default_rng(3), 3, model, "none"), np.random.default_rng(4))
    H, g = dense(qp)
    condensed = condense(qp)
    scale = np.abs(H).max()
    np.testing.assert_allclose(condensed.H, H, rtol=0.0, atol=1e-10 * scale)
    np.testing.assert_allclose(condensed.g, g, rtol=0.0, atol=1e-10 * np.abs(g).max())


@pytest.mark.parametrize("mpc", MPCS)
@pytest.mark.parametrize("rate", ["number", "diagonal", "matrix"])
def test_a_decision_is_the_one_of_an_independent_dense_program(mpc, rate):
    """Box and rate limits bind. DAQP stops at 1e-10 of the rows, which its Hessian makes 1e-8 N at most."""
    task = Task(limits=Limits(kappa=0.3125, rate=8.0))
    controller = mpc(task, horizon=N, R_rate=weights(rate, 3.0))
    plant, rows = at_rest(p=(1.5, -1.0, 0.5), Theta=(0.2, -0.1, 0.3)), window(helix, 0, N)
    arguments = plant, rows, LAST, np.zeros(6), np.zeros(controller.memory_size)
    qp = controller.problem(*arguments)
    if mpc is SdcNmpc:  # whose decision may take a second pass with other matrices
        controller = mpc(task, horizon=N, R_rate=weights(rate, 3.0), relinearisations=0)
    H, g = dense(qp)
    _, _, matrix, lower, upper, _, _ = dense_program(qp)
    u, _, flag, _ = daqp.solve(
        H, g, matrix, upper, lower, np.zeros(len(lower), np.int32), primal_tol=1e-10, dual_tol=1e-10
    )
    assert flag == 1
    decision = decide_once(controller, plant, rows, LAST)
    np.testing.assert_allclose(decision.command[0], u[:4] - qp.lower, rtol=0.0, atol=1e-7)
    assert (
        np.abs(decide_once(mpc(task, horizon=N), plant, rows, LAST).command - decision.command).max() > 1e-2
    )


@pytest.mark.parametrize("model", MODELS)
def test_osqp_finds_the_same_plan(model):
    """Its tolerance of 1e-8 leaves some 1e-5 N in the inputs; the same object takes problems without it."""
    rng = np.random.default_rng(5)
    backend = OsqpSolver(eps=1e-8, max_iter=100_000)
    for limits in ("none", "soft"):
        qp = with_rate(random_qp(rng, 6, model, limits), rng)
        for problem in (qp, qp._replace(R_rate=None), qp):
            exact = StructuredSolver().solve(problem)
            np.testing.assert_allclose(backend.solve(problem).u, exact.u, rtol=0.0, atol=1e-4)


@pytest.mark.parametrize("first", ["one weight for all stages", "one of each stage"])
def test_a_solver_serves_weights_of_each_stage_after_one_for_all(first):
    """Its memory is divided by their number: what one problem left there must not count in the next."""
    rng, N = np.random.default_rng(6), 6
    one = with_rate(random_qp(rng, N, "ltv", "none"), rng)
    one = one._replace(Q=one.Q[:1], R=one.R[:1], stationary=False)
    each = one._replace(Q=np.repeat(one.Q, N, axis=0), R=np.repeat(one.R, N, axis=0))
    problems = (one, each) if first == "one weight for all stages" else (each, one)
    solver = StructuredSolver()
    a, b = (solver.solve(problem).u for problem in problems)
    np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("mpc", MPCS)
def test_both_solvers_decide_alike(mpc):
    """OSQP stops at residuals of 1e-5, which is some 1e-3 N in the first input."""
    plant, rows = at_rest(p=(1.5, -1.0, 0.5)), window(helix, 0, N)
    decisions = [
        decide_once(mpc(WEAK, horizon=N, R_rate=2.0, solver=solver), plant, rows, LAST)
        for solver in ("structured", "osqp")
    ]
    np.testing.assert_allclose(decisions[1].command, decisions[0].command, rtol=0.0, atol=1e-2)


@pytest.mark.parametrize("mpc", MPCS)
def test_zeros_are_no_weight_at_all(mpc):
    plant, rows = at_rest(p=(1.5, -1.0, 0.5)), window(helix, 0, N)
    plain = decide_once(mpc(TASK, horizon=N), plant, rows, LAST)
    zeros = decide_once(mpc(TASK, horizon=N, R_rate=np.zeros(4)), plant, rows, LAST)
    np.testing.assert_array_equal(plain.command, zeros.command)
    np.testing.assert_array_equal(plain.memory, zeros.memory)


@pytest.mark.parametrize("mpc", MPCS)
def test_a_weight_that_outweighs_everything_keeps_the_command_of_before(mpc):
    """1e6 against a position weight of 1: changes of about 1e-6 times an unweighted one of 1 N."""
    decision = decide_once(mpc(TASK, horizon=N, R_rate=1e6), at_rest(p=(1.0, 0.0, 0.5)), last=LAST)
    np.testing.assert_allclose(decision.command[0], LAST, rtol=0.0, atol=1e-3)
    np.testing.assert_allclose(plan_of(decision, N) + HOVER, np.tile(LAST, (N, 1)), rtol=0.0, atol=1e-2)


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (-1.0, r"R_rate must be positive semidefinite, its smallest eigenvalue is -1"),
        ((1.0, 2.0), r"R_rate must be a finite number, 4 of them"),
        (np.triu(np.ones((4, 4))), r"R_rate must be symmetric"),
    ],
)
@pytest.mark.parametrize("mpc", MPCS)
def test_a_weight_that_is_none_is_refused_by_name(mpc, value, said):
    with pytest.raises(ValueError, match=said):
        mpc(TASK, horizon=N, R_rate=value)


def test_chapter_nine_has_no_certificate_for_it():
    with pytest.raises(ValueError, match="R_rate makes the cost depend on the command before"):
        certify("quad/Regulation-v0", "lmpc", policy_kwargs={"R_rate": 1.0})


@pytest.mark.parametrize("name", ["lmpc", "sdc-nmpc", "nmpc"])
def test_commands_change_less_the_more_changes_weigh(name):
    """Three starts of a helix in one batch; the change that the start of an episode makes is counted, too."""
    env = gymnasium.make_vec(HELIX, num_envs=3, time_limit=4.0)
    changes = []
    for R_rate in (None, 10.0, 100.0):
        policy = make_policy(name, env, horizon=10, R_rate=R_rate)
        flown = list(run_episodes(policy, env, 3, 0))
        assert not any(episode.crashed for episode in flown)
        steps = [np.diff(episode.commands, axis=0, prepend=HOVER) for episode in flown]
        changes.append(float(np.mean(np.abs(steps))))
    assert changes[0] > 1.1 * changes[1] > 1.1 * 1.1 * changes[2]


@pytest.mark.parametrize("options", [{}, {"solver": "osqp"}, {"reject_disturbance": True}])
def test_the_protocol_holds(options):
    """Rows independent, states of an episode begin anew, nothing kept in attributes: `check_policy`."""
    env = gymnasium.make(HELIX, rate_limit=10.0)
    check_policy(make_policy("lmpc", env, horizon=5, R_rate=1.0, **options), env)
