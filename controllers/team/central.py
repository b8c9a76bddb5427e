"""One MPC over all vehicles, the dissertation's future work (8.2.3): a yardstick for the distributed ones.

It is privileged: it knows every state and commands every vehicle. With x_n = S_n u + f_n of each vehicle it
minimises the sum of their costs (5.5) within box and rate of the rotors and, soft with a slack per row,

    the limits of the task, of every vehicle at the stages 1..N
    a_ijn'(p_i(k+n) - p_j(k+n)) >= d_s                                   of every pair at the stages 1..N
    a_ijN'(p_i(k+N) + t_b v_i(k+N) - p_j(k+N) - t_b v_j(k+N)) >= d_s     likewise, v = R_BI(Theta_k)'V_B

The normals a_ijn follow the previous plan, so that a pair that has begun to pass keeps its sides. OSQP solves
it, set up anew and started cold at each sample: nothing is kept outside the memory, so that a flight can be
repeated. The matrices are filled as dense ones, which limits the team: their size grows with the fourth power
of the number of vehicles.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import osqp
import scipy.sparse as sparse
from numpy.typing import ArrayLike, NDArray

from quad_envs.arguments.checks import array_bytes, require_memory
from quad_envs.observations.tracking import N_REFERENCE
from quad_envs.parameters import ATTITUDE, N_INPUT, N_STATE, POSITION, VELOCITY, Array
from quad_envs.references.turning import TURN_RATE, turning_rates, with_turn_rates
from quad_envs.rotations import rotation_body_from_inertial, wrap_angle
from quad_envs.tasks import TeamTask

from ..controller import PLANT_SIZE, Decision, as_array
from ..fallback import CLIPPED_SDRE, HOVER, NONE, PREVIOUS_PLAN, limit_command
from ..frame import add_rotor_lag
from ..model import sdc_pair
from ..mpc.kernels import left_model
from ..mpc.mpc import mpc_data
from ..mpc.options import MpcOptions, chosen, shared
from ..qp.ocp import Condensed, OcpQp, condense, no_rows
from .options import CentralOptions

_SOLVED = 1
_NO_BOUND = 1e30  # OSQP's infinity
_SLACK_SCALE = 1e-2  # m per unit of a slack variable: unscaled, OSQP needs many times the iterations
_COINCIDENT = 1e-9  # m
_MOST_VEHICLES = 15  # its dense rows take 20 MB; 0.2 GB with 30 vehicles, 17 GB with 100


class _Sample(NamedTuple):
    """The problem of one sample: 1/2 z'H z + g'z, lower <= A z <= upper, z = [u of all vehicles, slacks]."""

    H: Array
    g: Array
    A: Array
    lower: Array
    upper: Array


def level_frame_weight(P: Array, Theta: Array) -> Array:
    """T'P T with T = blkdiag(Rz(-psi), Rz(-psi) R_BI', I, I): P, which belongs to hover, in the level frame.

    Args:
        P: (12, 12).
        Theta: Roll, pitch, yaw, (3,), rad.

    Returns:
        (12, 12).
    """
    T = np.eye(N_STATE)
    level = rotation_body_from_inertial(np.array([0.0, 0.0, Theta[2]]))
    T[POSITION, POSITION] = level
    T[VELOCITY, VELOCITY] = level @ rotation_body_from_inertial(Theta).T
    return np.asarray(T.T @ P @ T)


class CentralMpc:
    """One quadratic program over a whole team, from the whole truth.

    Args:
        task: What is known of the flight.
        options: See `CentralOptions`; None for the defaults.
        changes: Fields of it, such as horizon=10, which replace those of `options`.

    Raises:
        TypeError: If there is no such option.
        ValueError: If an option is not allowed, or the team has more than 15 vehicles.
    """

    options_type = CentralOptions

    def __init__(self, task: TeamTask, options: CentralOptions | None = None, **changes: Any) -> None:
        if task.vehicles > _MOST_VEHICLES:
            raise ValueError(
                f"a central MPC takes at most {_MOST_VEHICLES} vehicles, got {task.vehicles}: it fills dense "
                "matrices, whose size grows with the fourth power of that number; use a distributed MPC"
            )
        self.task, self.options = task, chosen(CentralOptions, options, changes)
        options, self.horizon = self.options, int(self.options.horizon)
        inputs = N_INPUT * task.vehicles * self.horizon
        require_memory(
            f"a central MPC of {task.vehicles} vehicles and horizon {self.horizon}",
            array_bytes((inputs, inputs)),
            "choose a shorter horizon",
        )
        self.alpha, self.braking_time = float(options.alpha), options.braking
        self.swirl = float(options.swirl)
        single = shared(MpcOptions, options, plan_tilt=math.inf, plan_rate=math.inf)
        self._data = mpc_data(task, single, "attitude")
        self._validity = self._data.model_tilt, self._data.first_angle
        self._pairs = np.stack(np.triu_indices(task.vehicles, 1), axis=-1)
        n, N, K = task.vehicles, self.horizon, len(self._data.normal)
        self._per_pair = N + (self.braking_time > 0.0)
        self._weights = np.concatenate(
            [
                np.tile(self._data.weight, n),
                np.full(len(self._pairs) * self._per_pair, float(options.separation_weight)),
            ]
        )
        self._mask = self._pattern(n, N_INPUT * N, K)
        self.memory_size = 1 + n * N * (N_INPUT + 3)
        self._settings = {
            "eps_abs": options.eps,
            "eps_rel": options.eps,
            "max_iter": options.max_iter,
            "polishing": True,
        }

    def decide(
        self,
        plant: ArrayLike,
        preview: ArrayLike,
        slots: ArrayLike,
        last_command: ArrayLike,
        memory: ArrayLike,
    ) -> Decision:
        """Commands of the whole team.

        Args:
            plant: True [p, V_B, Theta, Omega, F] of all vehicles, (n, 16).
            preview: What the slots are relative to, from now on, (>= N+1, 8), absolute: the leader's
                reference, or the target's true path; p, v (inertial), sin and cos of psi_ref.
            slots: Wanted positions relative to it, (n, 3), m: delta_i1 or delta_it.
            last_command: Last applied rotor commands, (n, 4), N.
            memory: Of the previous decision, (memory_size,); zeros at the start.

        Returns:
            Commands; the fallback and OSQP's iterations are the same for all vehicles.

        Raises:
            ValueError: If a shape is wrong or a number is not finite.
        """
        plants, rows, offsets, last, kept = self._checked(plant, preview, slots, last_command, memory)
        condensed = self._condense(plants, rows, offsets)
        n, N = len(plants), self.horizon
        u, iterations = self._solve(self._sample(plants, condensed, last, kept))
        hover, level = self.task.hover_force, NONE
        forces = np.full((n, N, N_INPUT), hover)
        if u is not None:
            forces += u.reshape(n, N, N_INPUT)
        elif kept[0] > 0.0:
            level = PREVIOUS_PLAN
            old = kept[1 : 1 + n * N * N_INPUT].reshape(n, N, N_INPUT)
            forces = np.concatenate([old[:, 1:], old[:, -1:]], axis=1)
        else:
            level, free = CLIPPED_SDRE, _unconstrained(condensed)
            if free is None:
                level, free = HOVER, np.zeros(forces.size)
            forces += free.reshape(n, N, N_INPUT)
        command = np.empty((n, N_INPUT))
        for i in range(n):
            limit_command(forces[i, 0], last[i], self._data.rate_step, self._data.force_max, command[i])
        inputs = (forces - hover).reshape(n, N * N_INPUT)
        positions = [(part.S @ inputs[i] + part.f)[1:, POSITION] for i, part in enumerate(condensed)]
        memory = np.concatenate([[float(level <= PREVIOUS_PLAN)], forces.ravel(), np.ravel(positions)])
        if not np.isfinite(memory).all():  # so far away that nobody knows where: the next sample starts anew
            memory = np.zeros(self.memory_size)
        left = [
            left_model(level, part.f[0], part.S @ inputs[i] + part.f, part.f[:1], *self._validity)
            for i, part in enumerate(condensed)
        ]
        return Decision(command, memory, np.full(n, level), np.full(n, iterations), np.array(left, np.int64))

    def _checked(self, *arguments: ArrayLike) -> list[Array]:
        """The arguments as arrays, in the right shapes and finite."""
        arrays = [as_array(value) for value in arguments]
        n, stages = self.task.vehicles, self.horizon + 1
        shapes = [(n, PLANT_SIZE), (stages, N_REFERENCE), (n, 3), (n, N_INPUT), (self.memory_size,)]
        names = ("plant", "preview", "slots", "last_command", "memory")
        arrays[1] = arrays[1][:stages]
        for name, array, shape in zip(names, arrays, shapes, strict=True):
            if array.shape != shape:
                raise ValueError(f"{name} must have shape {shape} for this task, got {array.shape}")
            if not np.isfinite(array).all():
                raise ValueError(
                    f"{name} is not finite at {tuple(np.argwhere(~np.isfinite(array))[0].tolist())}"
                )
        return arrays

    def _condense(self, plants: Array, rows: Array, slots: Array) -> list[Condensed]:
        """Each vehicle's dynamics and cost in its inputs, inertial axes."""
        data, N, found = self._data, self.horizon, []
        psi_dot = with_turn_rates(rows, self.task.dt)[:, TURN_RATE]
        for plant, slot in zip(plants, slots, strict=True):
            x = plant[:N_STATE].copy()
            add_rotor_lag(plant, np.full(N_INPUT, self.task.hover_force), data.B_c, data.lag, x)
            A, B = sdc_pair(x, self.task.params, self.task.dt, self.alpha)
            r = np.zeros((N + 1, N_STATE))
            r[:, POSITION] = rows[:, :3] + slot
            r[:, VELOCITY] = rows[:, 3:6] @ rotation_body_from_inertial(x[ATTITUDE]).T
            r[:, 9:12] = turning_rates(x[ATTITUDE], psi_dot)
            r[:, 8] = x[8] + wrap_angle(np.arctan2(rows[:, 6], rows[:, 7]) - x[8])
            P = level_frame_weight(data.P, x[ATTITUDE])
            zero, box = np.zeros(N_INPUT), np.full(N_INPUT, math.inf)
            qp = OcpQp(
                A[None], B[None], np.zeros((N, N_STATE)), data.Q, data.R, P, False, x, r, -box, box,
                math.inf, zero, no_rows(),
            )  # fmt: skip
            found.append(condense(qp))
        return found

    def _normals(self, plants: Array, kept: Array) -> Array:
        """a_ijn, (pairs, N, 3), along the difference of the previous plans; zero where they coincide."""
        i, j = self._pairs.T
        n, N = len(plants), self.horizon
        p = np.repeat(plants[:, None, POSITION], N, axis=1)
        if kept[0] > 0.0:
            old = kept[-n * N * 3 :].reshape(n, N, 3)
            before = old[:, -2] if N > 1 else plants[:, POSITION]
            p = np.concatenate([old[:, 1:], (2.0 * old[:, -1] - before)[:, None]], axis=1)
        d = p[i] - p[j]
        gap = np.linalg.norm(d, axis=-1, keepdims=True)
        a = np.where(gap > _COINCIDENT, d / np.maximum(gap, _COINCIDENT), 0.0)
        turn = rotation_body_from_inertial(np.array([0.0, 0.0, -self.swirl]))
        return np.asarray(a @ turn.T)

    def _sample(self, plants: Array, condensed: list[Condensed], last: Array, kept: Array) -> _Sample:
        """Cost and rows; rows in the order box, rate, limits from below and above, pairs, slacks."""
        data, n, N = self._data, len(plants), self.horizon
        nv, K, P = N_INPUT * N, len(data.normal), len(self._pairs) * self._per_pair
        hover, size, slack = self.task.hover_force, n * N_INPUT * N, n * K + P
        H, A = (
            np.zeros((size + slack, size + slack)),
            np.zeros((2 * size + 2 * n * K + P + slack, size + slack)),
        )
        lower, upper = np.full(len(A), -math.inf), np.full(len(A), math.inf)
        lower[:size], upper[:size] = -hover, np.tile(data.force_max - hover, n * N)
        A[:size, :size] = np.eye(size)
        limits, pairs = 2 * size, 2 * size + 2 * n * K
        normals = data.normals[data.normal]
        for i, part in enumerate(condensed):
            u, k = slice(i * nv, (i + 1) * nv), slice(size + i * nv, size + (i + 1) * nv)
            H[u, u] = part.H
            A[k, u] = np.eye(nv) - np.eye(nv, k=-N_INPUT)
            lower[k], upper[k] = -data.rate_step, data.rate_step
            move = slice(k.start, k.start + N_INPUT)
            lower[move] = np.minimum(last[i] - hover - data.rate_step, data.force_max - hover)
            upper[move] = np.maximum(last[i] - hover + data.rate_step, -hover)
            matrix = np.einsum("ka,kau->ku", normals, part.S[data.stage])
            value = np.einsum("ka,ka->k", normals, part.f[data.stage])
            below, above = limits + i * K, limits + (n + i) * K
            A[below : below + K, u], A[above : above + K, u] = matrix, matrix
            lower[below : below + K], upper[above : above + K] = data.lower - value, data.upper - value
        self._separate(plants, condensed, kept, A[pairs : pairs + P], lower[pairs : pairs + P])
        slacks = _SLACK_SCALE * np.eye(slack)
        A[limits : limits + n * K, size:] = slacks[: n * K]
        A[limits + n * K : pairs, size:] = -slacks[: n * K]
        A[pairs : pairs + P, size:] = slacks[n * K :]
        A[pairs + P :, size:] = np.eye(slack)
        lower[pairs + P :] = 0.0
        g = np.concatenate([*(part.g for part in condensed), _SLACK_SCALE * self._weights])
        return _Sample(H, g, A, lower, upper)

    def _separate(
        self, plants: Array, condensed: list[Condensed], kept: Array, A: Array, lower: Array
    ) -> None:
        """Rows of the pairs, in place."""
        N, nv = self.horizon, N_INPUT * self.horizon
        R = rotation_body_from_inertial(plants[:, ATTITUDE])
        braking = [self.braking_time * R[i].T @ part.S[N, VELOCITY] for i, part in enumerate(condensed)]
        drift = [self.braking_time * R[i].T @ part.f[N, VELOCITY] for i, part in enumerate(condensed)]
        for row, ((i, j), normals) in enumerate(zip(self._pairs, self._normals(plants, kept), strict=True)):
            for stage in range(self._per_pair):
                n, k = min(stage, N - 1) + 1, self._per_pair * row + stage
                a = normals[n - 1]
                if not a.any():
                    continue
                value = a @ (condensed[i].f[n, POSITION] - condensed[j].f[n, POSITION])
                for vehicle, sign in ((i, 1.0), (j, -1.0)):
                    matrix = condensed[vehicle].S[n, POSITION]
                    if stage == N:
                        matrix = matrix + braking[vehicle]
                        value += sign * a @ drift[vehicle]
                    A[k, vehicle * nv : (vehicle + 1) * nv] = sign * a @ matrix
                lower[k] = self.task.separation - value

    def _pattern(self, n: int, nv: int, K: int) -> NDArray[np.bool_]:
        """Which entries of the rows may be non-zero."""
        size, P = n * nv, len(self._pairs) * self._per_pair
        slack = n * K + P
        mask = np.zeros((2 * size + 2 * n * K + P + slack, size + slack), dtype=bool)
        mask[:size, :size] = np.eye(size, dtype=bool)
        blocks = np.kron(np.eye(n, dtype=bool), np.ones((nv, nv), dtype=bool))
        mask[size : 2 * size, :size] = blocks & ((np.eye(size) + np.eye(size, k=-N_INPUT)) > 0.0)
        start = 2 * size
        for _ in range(2):
            mask[start : start + n * K, :size] = np.kron(np.eye(n, dtype=bool), np.ones((K, nv), dtype=bool))
            mask[start : start + n * K, size : size + n * K] = np.eye(n * K, dtype=bool)
            start += n * K
        for row, pair in enumerate(self._pairs):
            for vehicle in pair:
                rows = slice(start + row * self._per_pair, start + (row + 1) * self._per_pair)
                mask[rows, vehicle * nv : (vehicle + 1) * nv] = True
        mask[start : start + P, size + n * K :] = np.eye(P, dtype=bool)
        mask[start + P :, size:] = np.eye(slack, dtype=bool)
        return mask

    def _solve(self, sample: _Sample) -> tuple[Array | None, int]:
        """The inputs of all vehicles, or None; OSQP's iterations."""
        lower, upper = np.maximum(sample.lower, -_NO_BOUND), np.minimum(sample.upper, _NO_BOUND)
        held = (lower <= upper).all()  # not if one is beyond what counts as a bound, nor if it is nan
        if not (held and all(np.isfinite(part).all() for part in (sample.H, sample.g, sample.A))):
            return None, 0
        size = self.task.vehicles * N_INPUT * self.horizon
        vehicles = self.task.vehicles
        triangle = np.zeros(sample.H.shape, dtype=bool)
        triangle[:size, :size] = np.triu(np.kron(np.eye(vehicles), np.ones((size // vehicles,) * 2))) > 0.0
        P = _csc(triangle, sample.H.T[triangle.T])
        A = _csc(self._mask, sample.A.T[self._mask.T])
        solver = osqp.OSQP()
        try:
            solver.setup(P, sample.g, A, lower, upper, verbose=False, **self._settings)
        except osqp.OSQPException:  # the numbers are such that rounding leaves no convex cost
            return None, 0
        result = solver.solve(raise_error=False)
        iterations = int(result.info.iter)
        # After any other status x holds large finite numbers: only the status tells.
        if int(result.info.status_val) != _SOLVED:
            return None, iterations
        z = np.asarray(result.x, dtype=np.float64)
        return (z[:size], iterations) if np.isfinite(z).all() else (None, iterations)


def _unconstrained(condensed: list[Condensed]) -> Array | None:
    """Inputs of each vehicle that minimise its own cost without constraints, or None if none are found."""
    try:
        free = np.array([np.linalg.solve(part.H, -part.g) for part in condensed])
    except np.linalg.LinAlgError:
        return None
    return free if np.isfinite(free).all() else None


def _csc(mask: NDArray[np.bool_], values: Array) -> Any:
    """The sparse matrix of a pattern; values column by column."""
    columns, rows = np.nonzero(mask.T)
    indptr = np.concatenate([[0], np.cumsum(np.bincount(columns, minlength=mask.shape[1]))])
    return sparse.csc_matrix((values, rows.astype(np.int32), indptr.astype(np.int32)), shape=mask.shape)
