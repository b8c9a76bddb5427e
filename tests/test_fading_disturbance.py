"""Plans that expect the estimated disturbance to fade: by least squares, and in gusts."""

from __future__ import annotations

import math

import gymnasium as gym
import numpy as np
import pytest
from flights import HOVER, TASK, at_rest, decide_once
from scipy.linalg import expm

from baselines import evaluate, make_policy
from baselines.training.tuned_options import make_search
from controllers import ExactNmpc, LinearMPC, SdcNmpc
from controllers.model import hover_pair
from controllers.qp.riccati import dare
from quad_envs.tasks import Task

MPCS = {"lmpc": LinearMPC, "sdc-nmpc": SdcNmpc, "nmpc": ExactNmpc}
N = 25
SMALL = 1e-4
FORCE_AND_TORQUE = np.array([0.01, -0.004, 0.001, 0.4, -0.3, 0.2])


def decided(controller, estimate, revealed=None, psi=0.0):
    """The command at rest at the origin, headed as its reference is, of who has estimated this; N."""
    revealed = np.zeros(6) if revealed is None else revealed
    plant, rows = at_rest(Theta=(0.0, 0.0, psi)), np.zeros((N + 1, 8))
    rows[:, 6], rows[:, 7] = np.sin(psi), np.cos(psi)
    memory = decide_once(controller, plant, rows, disturbance=revealed).memory[0].copy()
    memory[1 + 5 * N :][1:7] = estimate
    return decide_once(controller, plant, rows, disturbance=revealed, memory=memory).command[0]


def made(name, time, **options):
    """A controller whose estimate stays as it is set: its gain is all but zero."""
    options = {"reject_disturbance": True, "estimator_gain": 1e-12, **options}
    return MPCS[name](TASK, disturbance_correlation_time=time, **options)


def dense_command(d, time):
    """The first input of the linear problem about hover under d exp(-t / time), by least squares."""
    A, B = hover_pair(TASK.params, TASK.dt)
    G = np.zeros((12, 6))
    G[9:, :3] = np.diag(1.0 / np.asarray(TASK.params.inertia))
    G[3:6, 3:] = np.eye(3) / TASK.params.mass
    A_c, B_c = continuous_pair(A, B)
    E = expm(TASK.dt * np.block([[A_c, G], [np.zeros((6, 18))]]))[:12, 12:]  # of a force that acts for dt
    fade = math.exp(-TASK.dt / time)
    # The equilibrium of what is left at the end: A_c x + B_c u + G d = 0, of the states roll and pitch alone.
    M = np.hstack([A_c[:, 6:8], B_c])
    still = np.linalg.lstsq(M, -G @ d * fade**N, rcond=None)[0]
    x_e, u_e = np.zeros(12), still[2:]
    x_e[6:8] = still[:2]
    Q, R = np.asarray(TASK.weights.Q), np.asarray(TASK.weights.R)
    P = dare(A, B, np.diag(Q), np.diag(R))
    S, f = np.zeros((N + 1, 12, 4 * N)), np.zeros((N + 1, 12))
    for i in range(N):
        S[i + 1] = A @ S[i]
        S[i + 1, :, 4 * i : 4 * i + 4] += B
        f[i + 1] = A @ f[i] + E @ d * fade**i
    rows, wanted = [], []
    for i in range(1, N + 1):
        root = np.linalg.cholesky(P).T if i == N else np.diag(np.sqrt(Q))
        rows.append(root @ S[i])
        wanted.append(root @ (x_e - f[i]))
    rows.append(np.kron(np.eye(N), np.diag(np.sqrt(R))))
    wanted.append(np.tile(np.sqrt(R) * u_e, N))
    return np.linalg.lstsq(np.vstack(rows), np.concatenate(wanted), rcond=None)[0][:4]


def continuous_pair(A, B):
    """A_c and B_c of a zero-order hold, by the series of the logarithm; A - 1 is nilpotent at hover."""
    D = A - np.eye(12)
    A_c = (D - D @ D / 2.0 + D @ D @ D / 3.0) / TASK.dt
    integral = np.eye(12) + TASK.dt * A_c / 2.0 + (TASK.dt * A_c) @ (TASK.dt * A_c) / 6.0
    integral += np.linalg.matrix_power(TASK.dt * A_c, 3) / 24.0
    return A_c, np.linalg.solve(TASK.dt * integral, B)


@pytest.mark.parametrize("name", MPCS)
@pytest.mark.parametrize("time", [0.3, 1.0, math.inf])
def test_a_small_disturbance_is_met_as_the_linear_problem_says(name, time):
    expected = dense_command(FORCE_AND_TORQUE, time)
    found = (decided(made(name, time), SMALL * FORCE_AND_TORQUE) - HOVER) / SMALL
    np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())


@pytest.mark.parametrize("name", MPCS)
def test_it_turns_with_the_vehicle(name):
    psi, controller = 1.3, made(name, 0.5)
    turned = FORCE_AND_TORQUE.copy()
    turned[3:5] = [[np.cos(psi), -np.sin(psi)], [np.sin(psi), np.cos(psi)]] @ FORCE_AND_TORQUE[3:5]
    expected = decided(controller, FORCE_AND_TORQUE)
    np.testing.assert_allclose(decided(controller, turned, psi=psi), expected, atol=1e-6)


@pytest.mark.parametrize("name", MPCS)
def test_what_is_revealed_stays(name):
    """Only the estimate fades."""
    stays, fades = made(name, math.inf), made(name, 0.2)
    nothing = np.zeros(6)
    expected = decided(stays, nothing, FORCE_AND_TORQUE)
    np.testing.assert_allclose(decided(fades, nothing, FORCE_AND_TORQUE), expected, atol=1e-9)
    assert np.abs(decided(fades, FORCE_AND_TORQUE) - expected).max() > 0.01


@pytest.mark.parametrize("name", MPCS)
def test_osqp_plans_the_same(name):
    exact, osqp = (made(name, 0.5, solver=solver) for solver in ("structured", "osqp"))
    expected = decided(exact, FORCE_AND_TORQUE)
    np.testing.assert_allclose(decided(osqp, FORCE_AND_TORQUE), expected, atol=2e-3)


@pytest.mark.parametrize("name", ["lmpc", "sdc-nmpc", "nmpc", "score-nmpc"])
def test_gusts_are_met_better_and_a_steady_wind_hardly_worse(name):
    def score(disturbance, time):
        env = gym.make("quad/HelixTracking-v0", disturbance=disturbance)
        policy = make_policy(name, env, reject_disturbance=True, disturbance_correlation_time=time)
        return evaluate(policy, env, episodes=10, seed=20_000).summary()["score"].mean

    assert score("gusts", 1.0) > score("gusts", math.inf) + 0.01
    assert score("steady", 1.0) > score("steady", math.inf) - 0.01


def test_a_time_that_means_nothing_is_refused():
    for time in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match=r"disturbance_correlation_time must be > 0 s .*, got"):
            LinearMPC(Task(), disturbance_correlation_time=time)


def test_tune_reaches_it_where_it_is_finite():
    task = gym.make("quad/HelixTracking-v0").unwrapped.task
    rejects = {"reject_disturbance": True}
    assert "disturbance_correlation_time" not in make_search("nmpc", task, rejects).names
    fades = {**rejects, "disturbance_correlation_time": 1.0}
    assert "disturbance_correlation_time" in make_search("nmpc", task, fades).names
    with pytest.raises(ValueError, match="disturbance_correlation_time changes nothing here"):
        make_search("nmpc", task, rejects, ["disturbance_correlation_time"])
