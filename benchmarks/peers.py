"""Other people's solvers as policies on our observations, for comparison in one run."""

from __future__ import annotations

from typing import Any

import numpy as np

from controllers import dare, hover_pair
from controllers.qp import Multipliers, Solution, Status
from controllers.qp.ocp import OcpQp
from quad_envs.constraints import actions_from_forces
from quad_envs.parameters import N_INPUT, N_STATE, Array
from quad_envs.tasks import Task

from .condensed import solve_daqp


class DaqpSolver:
    """DAQP, a dense active-set solver in C, on the condensed problem; hard rows only."""

    def solve(self, qp: OcpQp) -> Solution:
        """Condense and solve."""
        if np.isfinite(qp.rows.weight).any():
            raise ValueError("the DAQP comparison takes hard rows only")
        u, x, flag, iterations = solve_daqp(qp)
        status = Status.OPTIMAL if flag == 1 else Status.INFEASIBLE
        nothing, none = np.zeros_like(u), np.zeros(len(qp.rows.weight))
        return Solution(status, u, x, Multipliers(*(nothing,) * 4, none, none), iterations)


class IpoptPolicy:
    """Exact NMPC to convergence by CasADi and IPOPT: multiple shooting, warm start, box and rate limits.

    The same prediction (one RK4 step per sample), cost (v_ref in the slot of V_B) and constraints as
    `nmpc` with `velocity_error="body"` and `frame="hover"`.
    """

    def __init__(self, task: Task, horizon: int = 25) -> None:
        self.task, self.horizon = task, horizon
        self._solver, self._bounds = _build(task, horizon)

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        """One decision for one vehicle."""
        N = self.horizon
        view = self.task.layout.decode(observation[0])
        x_0 = np.concatenate([np.zeros(3), view.V_B, view.Theta, view.Omega])
        r = _references(view, N)
        if state is None or (episode_start is not None and np.any(episode_start)):
            guess = np.concatenate([np.tile(x_0, N + 1), np.zeros(N_INPUT * N)])
        else:
            guess = state
        last = view.last_command - self.task.hover_force
        answer = self._solver(x0=guess, p=np.concatenate([x_0, last, r.ravel()]), **self._bounds)
        z = np.array(answer["x"]).ravel()
        X, U = z[: N_STATE * (N + 1)].reshape(N + 1, -1), z[N_STATE * (N + 1) :].reshape(N, -1)
        action = actions_from_forces(
            U[:1] + self.task.hover_force, self.task.hover_force, self.task.force_max
        )
        X, U = np.vstack([X[1:], X[-1:]]), np.vstack([U[1:], U[-1:]])
        X[:, :3] -= X[0, :3]
        return action, np.concatenate([X.ravel(), U.ravel()])


def _build(task: Task, N: int) -> tuple[Any, dict[str, Array]]:
    """The NLP once, with x_0, the last input and the references as parameters."""
    import casadi as ca

    step = _rk4(ca, task)
    A, B = hover_pair(task.params, task.dt)
    Q, R = task.weights.Q_matrix(), task.weights.R_matrix()
    P = ca.DM(dare(A, B, Q, R))
    X, U = ca.SX.sym("X", N_STATE, N + 1), ca.SX.sym("U", N_INPUT, N)
    p = ca.SX.sym("p", N_STATE + N_INPUT + N_STATE * (N + 1))
    r = ca.reshape(p[N_STATE + N_INPUT :], N_STATE, N + 1)
    gaps, moves, cost, before = [X[:, 0] - p[:N_STATE]], [], 0, p[N_STATE : N_STATE + N_INPUT]
    for i in range(N):
        e = X[:, i] - r[:, i]
        cost += ca.bilin(ca.DM(Q), e, e) + ca.bilin(ca.DM(R), U[:, i], U[:, i])
        gaps.append(step(X[:, i], U[:, i] + task.hover_force) - X[:, i + 1])
        moves.append(U[:, i] - before)
        before = U[:, i]
    e = X[:, N] - r[:, N]
    cost += ca.bilin(P, e, e)
    problem = {"x": ca.vertcat(ca.vec(X), ca.vec(U)), "p": p, "f": cost, "g": ca.vertcat(*gaps, *moves)}
    options = {
        "ipopt.print_level": 0,
        "print_time": False,
        "ipopt.warm_start_init_point": "yes",
        "ipopt.sb": "yes",
    }
    free, change = np.full(N_STATE * (N + 1), np.inf), np.full(N_INPUT * N, task.limits.rate * task.dt)
    still = np.zeros(N_STATE * (N + 1))
    bounds = {
        "lbx": np.r_[-free, np.full(N_INPUT * N, -task.hover_force)],
        "ubx": np.r_[free, np.tile(task.force_max - task.hover_force, N)],
        "lbg": np.r_[still, -change],
        "ubg": np.r_[still, change],
    }
    return ca.nlpsol("solver", "ipopt", problem, options), bounds


def _derivative(ca: Any, task: Task) -> Any:
    """f(x, F) in CasADi, written from Eq. (2.32) and not from our kernels."""
    params = task.params
    Jx, Jy, Jz = params.inertia
    x, F = ca.SX.sym("x", N_STATE), ca.SX.sym("F", N_INPUT)
    V, Omega = x[3:6], x[9:12]
    sf, cf, st, ct, ss, cs = (g(x[6 + i]) for i in range(3) for g in (ca.sin, ca.cos))
    R = ca.vertcat(
        ca.horzcat(ct * cs, ct * ss, -st),
        ca.horzcat(st * cs * sf - ss * cf, st * ss * sf + cs * cf, ct * sf),
        ca.horzcat(st * cs * cf + ss * sf, st * ss * cf - cs * sf, ct * cf),
    )
    W = ca.vertcat(
        ca.horzcat(1, sf * st / ct, cf * st / ct), ca.horzcat(0, cf, -sf), ca.horzcat(0, sf / ct, cf / ct)
    )
    gyro = ca.vertcat(
        (Jy - Jz) / Jx * Omega[1] * Omega[2],
        (Jz - Jx) / Jy * Omega[0] * Omega[2],
        (Jx - Jy) / Jz * Omega[0] * Omega[1],
    )
    drift = ca.vertcat(R.T @ V, ca.cross(V, Omega) + R @ ca.DM([0, 0, params.gravity]), W @ Omega, gyro)
    return ca.Function("f", [x, F], [drift + ca.DM(params.input_matrix()) @ F])


def _rk4(ca: Any, task: Task) -> Any:
    """x_{k+1} = phi(x_k, F_k): one Runge-Kutta step per sample."""
    f, h = _derivative(ca, task), task.dt
    x, F = ca.SX.sym("x", N_STATE), ca.SX.sym("F", N_INPUT)
    k1 = f(x, F)
    k2 = f(x + h / 2 * k1, F)
    k3 = f(x + h / 2 * k2, F)
    k4 = f(x + h * k3, F)
    return ca.Function("phi", [x, F], [x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])


class DoMpcPolicy:
    """do-mpc as its users set it up: collocation, IPOPT, box limits; it cannot bound the input rate."""

    def __init__(self, task: Task, horizon: int = 25) -> None:
        self.task, self.horizon = task, horizon
        self._window = np.zeros((horizon + 1, N_STATE))
        self._mpc = self._set_up()

    def _set_up(self) -> Any:
        import casadi as ca
        import do_mpc

        task, N = self.task, self.horizon
        model = do_mpc.model.Model("continuous")
        x, u = model.set_variable("_x", "x", (N_STATE, 1)), model.set_variable("_u", "u", (N_INPUT, 1))
        r = model.set_variable("_tvp", "r", (N_STATE, 1))
        model.set_rhs("x", _derivative(ca, task)(x, u + task.hover_force))
        model.setup()
        mpc = do_mpc.controller.MPC(model)
        mpc.settings.n_horizon, mpc.settings.t_step, mpc.settings.store_full_solution = N, task.dt, False
        mpc.settings.supress_ipopt_output()
        Q, R = task.weights.Q_matrix(), task.weights.R_matrix()
        P = dare(*hover_pair(task.params, task.dt), Q, R)
        mpc.set_objective(
            mterm=ca.bilin(ca.DM(P), x - r, x - r),
            lterm=ca.bilin(ca.DM(Q), x - r, x - r) + ca.bilin(ca.DM(R), u, u),
        )
        mpc.bounds["lower", "_u", "u"] = -task.hover_force
        mpc.bounds["upper", "_u", "u"] = task.force_max - task.hover_force
        template = mpc.get_tvp_template()

        def window(t: float) -> Any:
            for i in range(N + 1):
                template["_tvp", i, "r"] = self._window[i]
            return template

        mpc.set_tvp_fun(window)
        mpc.setup()
        return mpc

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        """One decision for one vehicle."""
        view = self.task.layout.decode(observation[0])
        x_0 = np.concatenate([np.zeros(3), view.V_B, view.Theta, view.Omega])
        self._window[:] = _references(view, self.horizon)
        if state is None or (episode_start is not None and np.any(episode_start)):
            self._mpc.reset_history()
            self._mpc.x0 = x_0
            self._mpc.set_initial_guess()
        u = self._mpc.make_step(x_0.reshape(-1, 1)).reshape(1, -1)
        hover = self.task.hover_force
        return actions_from_forces(u + hover, hover, self.task.force_max), True


def _references(view: Any, N: int) -> Array:
    """Rows [p_ref; v_ref; 0 0 psi_ref; 0] of a decoded observation, (N+1, 12)."""
    r = np.zeros((N + 1, N_STATE))
    r[:, :6] = view.preview[: N + 1, :6]
    r[:, 8] = np.arctan2(view.preview[: N + 1, 6], view.preview[: N + 1, 7])
    return r
