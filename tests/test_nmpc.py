"""Exact nonlinear MPC: its residual, its fixed point, its memory, and IPOPT on the same problem."""

from __future__ import annotations

import numpy as np
import pytest
from flights import DT, HOVER, TASK, at_rest, decide_once, fly, helix, jumps, plan_of, window

from controllers import ExactNmpc
from controllers.mpc.residual import gauss_newton_weight, rates_residual, velocity_residual
from controllers.qp.riccati import dare
from quad_envs.parameters import Limits
from quad_envs.references.turning import TURN_RATE, turning_rates, with_turn_rates
from quad_envs.rotations import rotation_body_from_inertial
from quad_envs.tasks import Task

N = 25
STATE = np.r_[0.5, -0.4, 0.3, 1, 0.5, -0.5, 0.2, -0.3, 0.1, 0.5, 0.4, 0.1, np.full(4, HOVER)]
SLOW = Task(limits=Limits(kappa=0.3125, rate=5.0))


def residual(x, r, psi_dot=0.0):
    """That of the reward."""
    e = x - r
    e[3:6] = x[3:6] - rotation_body_from_inertial(x[6:9]) @ r[3:6]
    e[9:12] = x[9:12] - turning_rates(x[6:9], psi_dot)
    return e


def turning_window(horizon, psi=0.3, rate=0.0):
    """Rows beside the state of these tests, with a heading that turns."""
    rows = window(helix, 40, horizon)
    rows[:, :3] -= rows[0, :3] - [0.2, 0.1, -0.2]
    headings = psi + rate * DT * np.arange(horizon + 1)
    rows[:, 6], rows[:, 7] = np.sin(headings), np.cos(headings)
    return rows


def test_velocity_residual_is_rotation_and_its_derivative():
    rng = np.random.default_rng(0)
    for _ in range(20):
        Theta, v, D = rng.uniform(-1.4, 1.4, 3), rng.normal(size=3), np.empty((3, 3))
        np.testing.assert_allclose(
            velocity_residual(Theta, v, D), rotation_body_from_inertial(Theta) @ v, atol=1e-14
        )
        step = 1e-6
        differences = [
            (rotation_body_from_inertial(Theta + e) - rotation_body_from_inertial(Theta - e)) @ v / (2 * step)
            for e in step * np.eye(3)
        ]
        np.testing.assert_allclose(D, np.transpose(differences), atol=1e-9)


def test_wanted_rates_are_those_of_the_reward_and_their_derivative():
    rng = np.random.default_rng(4)
    for _ in range(20):
        Theta, psi_dot, D = rng.uniform(-1.4, 1.4, 3), rng.normal(), np.empty((3, 3))
        np.testing.assert_allclose(
            rates_residual(Theta, psi_dot, D), turning_rates(Theta, psi_dot), atol=1e-14
        )
        step = 1e-6
        differences = [
            (turning_rates(Theta + e, psi_dot) - turning_rates(Theta - e, psi_dot)) / (2 * step)
            for e in step * np.eye(3)
        ]
        np.testing.assert_allclose(D, np.transpose(differences), atol=1e-9)


@pytest.mark.parametrize("psi_dot", [0.0, 0.8])
def test_gauss_newton_weight_is_that_of_the_residuals_derivative(psi_dot):
    rng = np.random.default_rng(1)
    x, r, step = rng.normal(size=12), rng.normal(size=12), 1e-6
    differences = [
        (residual(x + e, r, psi_dot) - residual(x - e, r, psi_dot)) / (2 * step) for e in step * np.eye(12)
    ]
    E = np.stack(differences, axis=-1)
    D, out, root = np.empty((6, 3)), np.empty((12, 12)), rng.normal(size=(12, 12))
    velocity_residual(x[6:9], r[3:6], D[:3])
    rates_residual(x[6:9], psi_dot, D[3:])
    Q = root @ root.T
    gauss_newton_weight(Q, D, out)
    np.testing.assert_allclose(out, E.T @ Q @ E, atol=1e-7)


@pytest.mark.parametrize("velocity_error", ["inertial", "body"])
def test_real_time_iteration_stays_at_the_converged_solution(velocity_error):
    """Fed with its own solution at the same state, one pass moves by less than SQP's tolerance."""
    rows = turning_window(N, psi=0.0)
    converged = decide_once(ExactNmpc(SLOW, passes=60, velocity_error=velocity_error), STATE, rows)
    memory = converged.memory[0].copy()
    plan, X = memory[1 : 1 + 4 * N].reshape(N, 4), memory[2 + 5 * N :].reshape(N + 1, 12)
    plan[1:], X[1:] = plan[:-1].copy(), X[:-1].copy()  # undo the shift that the next decision makes
    again = decide_once(ExactNmpc(SLOW, velocity_error=velocity_error), STATE, rows, memory=memory)
    np.testing.assert_allclose(again.command, converged.command, atol=1e-5)


def test_real_time_iteration_costs_what_convergence_costs():
    """Within 0.2 % of converged, section 10; jumps are the hardest case."""
    rti = fly(ExactNmpc(SLOW), jumps, (3, 3, 3), seconds=4.0)
    sqp = fly(ExactNmpc(SLOW, passes=30), jumps, (3, 3, 3), seconds=4.0)
    assert rti.exact_cost == pytest.approx(sqp.exact_cost, rel=2e-3)
    assert not rti.fallbacks.any()


def test_exact_residual_beats_the_unturned_velocity():
    exact, body = (fly(ExactNmpc(TASK, velocity_error=kind), helix) for kind in ("inertial", "body"))
    assert exact.exact_cost < 0.97 * body.exact_cost


def test_guess_does_not_depend_on_the_origin():
    """Observations give positions relative to the vehicle: p = 0 in every call must do."""
    controller, memory, relative = ExactNmpc(TASK), None, None
    plant = at_rest()
    for k in range(3):
        plant[:3] = 0.1 * k, 0.2 * k, -0.1 * k
        plant[8] = 0.2 * k
        rows = window(helix, k, N)
        a = decide_once(controller, plant, rows, memory=memory)
        moved, shifted = plant.copy(), rows.copy()
        moved[:3], shifted[:, :3] = 0.0, rows[:, :3] - plant[:3]
        b = decide_once(controller, moved, shifted, memory=relative)
        np.testing.assert_allclose(a.command, b.command, atol=1e-9)
        memory, relative = a.memory[0], b.memory[0]


@pytest.mark.parametrize("frame", ["heading", "hover"])
def test_guess_survives_a_wrapped_yaw(frame):
    controller, turn = ExactNmpc(TASK, frame=frame), 2 * np.pi
    rows = window(helix, 0, N, psi=np.pi - 0.01)
    memory = decide_once(controller, at_rest(Theta=(0, 0, np.pi - 0.02)), rows).memory[0]
    other = memory.copy()
    other[2 + 5 * N :].reshape(N + 1, 12)[:, 8] -= turn
    plant = at_rest(Theta=(0, 0, np.pi - 0.01))
    a, b = (decide_once(controller, plant, rows, memory=each) for each in (memory, other))
    np.testing.assert_allclose(a.command, b.command, atol=1e-9)


def ipopt_plan(x_0, rows, last, task, horizon, velocity_error, terminal, stage=lambda cost: cost):
    """The same nonlinear program, written for CasADi from the chapter and solved by IPOPT: inputs, (N, 4).

    `stage` is what a plan pays for the cost |e(x_{i+1})|^2 + |u_i|^2 of a stage.
    """
    import casadi as ca

    params, limits = task.params, task.limits
    B_c, (Jx, Jy, Jz) = ca.DM(params.input_matrix()), params.inertia

    def rotation(Theta):
        sf, cf, st, ct, ss, cs = (f(Theta[i]) for i in range(3) for f in (ca.sin, ca.cos))
        return ca.vertcat(
            ca.horzcat(ct * cs, ct * ss, -st),
            ca.horzcat(st * cs * sf - ss * cf, st * ss * sf + cs * cf, ct * sf),
            ca.horzcat(st * cs * cf + ss * sf, st * ss * cf - cs * sf, ct * cf),
        )

    def f(x, F):
        V, Theta, Omega = x[3:6], x[6:9], x[9:12]
        R = rotation(Theta)
        sf, cf, ct, tt = ca.sin(Theta[0]), ca.cos(Theta[0]), ca.cos(Theta[1]), ca.tan(Theta[1])
        W = ca.vertcat(
            ca.horzcat(1, sf * tt, cf * tt), ca.horzcat(0, cf, -sf), ca.horzcat(0, sf / ct, cf / ct)
        )
        gyro = ca.vertcat(
            (Jy - Jz) / Jx * Omega[1] * Omega[2],
            (Jz - Jx) / Jy * Omega[0] * Omega[2],
            (Jx - Jy) / Jz * Omega[0] * Omega[1],
        )
        gravity = R @ ca.DM([0, 0, params.gravity])
        return ca.vertcat(R.T @ V, ca.cross(V, Omega) + gravity, W @ Omega, gyro) + B_c @ F

    def error(x, row):
        r = ca.DM([*row[:3], *row[3:6], 0, 0, np.arctan2(row[6], row[7]), 0, 0, 0])
        v = rotation(x[6:9]) @ r[3:6] if velocity_error == "inertial" else r[3:6]
        # The heading turns about the inertial z axis, seen in body axes.
        Omega_ref = rotation(x[6:9]) @ ca.DM([0, 0, row[TURN_RATE]])
        return ca.vertcat(x[:3] - r[:3], x[3:6] - v, x[6:9] - r[6:9], x[9:12] - Omega_ref)

    u = ca.SX.sym("u", 4, horizon)
    x, cost, before, moves = ca.DM(x_0), 0, ca.DM(last - HOVER), []
    for i in range(horizon):
        F = u[:, i] + HOVER
        moves.append(u[:, i] - before)
        before = u[:, i]
        k1 = f(x, F)
        k2 = f(x + DT / 2 * k1, F)
        k3 = f(x + DT / 2 * k2, F)
        k4 = f(x + DT * k3, F)
        x = x + DT / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        e = error(x, rows[i + 1])
        W = ca.DM(terminal) if i == horizon - 1 else ca.DM.eye(12)
        cost += stage(e.T @ W @ e + ca.dot(u[:, i], u[:, i]))
    problem = {"x": ca.vec(u), "f": cost, "g": ca.vertcat(*moves)}
    quiet = {"ipopt.print_level": 0, "print_time": False, "ipopt.tol": 1e-11}
    solver = ca.nlpsol("solver", "ipopt", problem, quiet)
    step = limits.rate * DT
    box = {"lbx": -HOVER, "ubx": np.tile(task.force_max - HOVER, horizon), "lbg": -step, "ubg": step}
    return np.array(solver(x0=0.0, **box)["x"]).reshape(horizon, 4)


@pytest.mark.slow
@pytest.mark.parametrize("velocity_error", ["inertial", "body"])
@pytest.mark.parametrize("limits", [Limits(), Limits(kappa=0.3125, rate=5.0)], ids=["free", "tight"])
@pytest.mark.parametrize("rate", [0.0, 0.8])
def test_converged_plan_is_that_of_ipopt(velocity_error, limits, rate):
    """Gauss-Newton and IPOPT stop at 1e-6 N each."""
    from controllers import hover_pair

    task, horizon = Task(limits=limits), 15
    rows = turning_window(horizon, rate=rate)
    P = dare(*hover_pair(task.params, DT), np.eye(12), np.eye(4))
    last = np.full(4, HOVER)
    controller = ExactNmpc(task, horizon=horizon, passes=100, velocity_error=velocity_error, frame="hover")
    plan = plan_of(decide_once(controller, STATE, rows, last), horizon)
    expected = ipopt_plan(STATE[:12], with_turn_rates(rows, DT), last, task, horizon, velocity_error, P)
    np.testing.assert_allclose(plan, expected, atol=1e-5)
