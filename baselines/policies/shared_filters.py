"""The target filters of many agents, and what they tell each other of their estimates.

Each agent filters what its own observation holds. Its estimate and covariance travel with its messages, and
in the step in which a message arrives the receiver intersects the covariances: all agents fuse at once, from
estimates of before any fusion, moved on by the message's age.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from controllers.estimation import covariance_intersection
from controllers.estimation.ekf import constant_velocity_model
from quad_envs.arguments.names import unknown_name
from quad_envs.observations.team import COMM_AGE, COMM_POSITION, COMM_WEIGHT, N_ESTIMATE
from quad_envs.parameters import Array
from quad_envs.tasks import TeamTask

from .estimation import make_estimator
from .estimation_kernels import P, X
from .protocol import Actions

Fusion = Literal["trace", "equal", "determinant", "none"]
Rows = NDArray[np.int64]
_VECH = np.triu_indices(3)  # xx, xy, xz, yy, yz, zz


class Heard(NamedTuple):
    """Estimates that came with the messages of this step, relative to their receivers."""

    x: Array  # (m, K, 6)
    P: Array  # (m, K, 6, 6)
    valid: NDArray[np.bool_]  # (m, K)


class Known(NamedTuple):
    """What agents know of the target after a step."""

    block: Actions  # (m, (1 + K) 13), the part `estimate` of their observations
    filters: Array  # (m, size), their memories
    reports: Array  # (m, N_REPORT), of their own filters


class SharedFilters:
    """A filter per agent, row t N + i for vehicle i of team t.

    Args:
        task: With a target, as it is without estimates.
        senders: Who speaks in each comm slot, (N, K); -1 for nobody.
        lifetime: s for which a message stays valid.
        teams: Their number.
        fusion: Weights of the covariance intersection: "trace" (1 / tr P), "equal", "determinant" (smallest
            determinant); "none": nobody tells anybody.
        q: Of the target's motion in the filters, see `estimation.make_estimator`.
        estimator: See there.

    Raises:
        ValueError: If an option is not allowed.
    """

    def __init__(
        self,
        task: TeamTask,
        senders: Rows,
        lifetime: float,
        teams: int = 1,
        fusion: Fusion = "trace",
        q: Any = None,
        estimator: Any = "ekf",
    ) -> None:
        if fusion not in get_args(Fusion):
            raise ValueError(unknown_name("fusion", fusion, get_args(Fusion)))
        self.task, self.fusion = task, fusion
        self.estimator = make_estimator(task, estimator, q)
        if fusion != "none" and not self.estimator.can_fuse:
            raise ValueError(
                f"{estimator!r} cannot take fused estimates over: give it `replaced(memory, x, P)`, or "
                "choose fusion='none'"
            )
        n, K = senders.shape
        first = n * np.arange(teams)[:, None, None]
        self._senders: Rows = np.where(senders < 0, 0, first + senders).reshape(-1, K)
        rows = n * teams
        self._memory: Array = np.zeros((rows, self.estimator.size))
        self._told = np.full(
            (rows, K), -1, dtype=np.int64
        )  # step at which the last message of a slot was sent
        self.steps = np.full(rows, -1, dtype=np.int64)  # of the episode
        # Estimates of before fusion, of the last steps of every row.
        depth = 1 if fusion == "none" else round(lifetime / task.dt) + 1
        self._sent_x, self._sent_P = np.zeros((depth, rows, 6)), np.zeros((depth, rows, 6, 6))

    def begin(self, rows: Rows) -> None:
        """An episode of these rows begins with their next observation."""
        self._memory[rows], self._told[rows], self.steps[rows] = 0.0, -1, -1

    def sent(self, step: int) -> tuple[Array, Array]:
        """Estimates (rows, 6) of before fusion that were sent at a step, and covariances (rows, 6, 6)."""
        at = step % len(self._sent_x)
        return self._sent_x[at], self._sent_P[at]

    def step(self, rows: Rows, observations: Actions) -> Known:
        """Filter, exchange, fuse.

        Args:
            rows: Agents that observe, (m,).
            observations: Theirs, (m, layout.size).
        """
        self.steps[rows] += 1
        done = self.estimator.step(observations, self._memory[rows], self.steps[rows] == 0)
        heard = self._exchange(rows, done.filters, done.parts.comm)
        filters = self._fused(done.filters, heard)
        self._memory[rows] = filters
        return Known(estimate_block(filters, heard), filters, done.reports)

    def _exchange(self, rows: Rows, filters: Array, comm: Array) -> Heard:
        """What the messages that arrive in this step bring."""
        m, K, layout = len(rows), self._senders.shape[1], self.task.layout
        depth, now = len(self._sent_x), self.steps[rows]
        self._sent_x[now % depth, rows] = filters[:, X]
        self._sent_P[now % depth, rows] = filters[:, P].reshape(-1, 6, 6)
        heard = Heard(np.zeros((m, K, 6)), np.zeros((m, K, 6, 6)), np.zeros((m, K), dtype=np.bool_))
        if self.fusion == "none":
            return heard
        slots = comm.reshape(m, K, layout.comm_size)
        ages = np.rint(slots[..., COMM_AGE] / self.task.dt).astype(np.int64)
        sent, told = now[:, None] - ages, self._told[rows]
        heard.valid[:] = (slots[..., COMM_WEIGHT] > 0.0) & (sent > told)
        for age in np.unique(ages[heard.valid]).tolist():
            which = heard.valid & (ages == age)
            at, sender = sent[which] % depth, self._senders[rows][which]
            x, covariance = self._moved_on(self._sent_x[at, sender], self._sent_P[at, sender], age)
            x[:, :3] += slots[which][:, COMM_POSITION]
            heard.x[which], heard.P[which] = x, covariance
        told[heard.valid] = sent[heard.valid]
        self._told[rows] = told
        return heard

    def _moved_on(self, x: Array, covariance: Array, steps: int) -> tuple[Array, Array]:
        """Estimates (m, 6) some steps later, from an origin that stays."""
        if steps == 0:
            return x, covariance
        F, Q = constant_velocity_model(steps * self.task.dt, self.estimator.q)
        return x @ F.T, F @ covariance @ F.T + Q

    def _fused(self, filters: Array, heard: Heard) -> Array:
        """The filters after covariance intersection, (m, size)."""
        if not heard.valid.any():
            return filters
        m = len(filters)
        own = np.ones((m, 1), dtype=np.bool_)
        fused = covariance_intersection(
            np.concatenate([filters[:, None, X], heard.x], axis=1),
            np.concatenate([filters[:, P].reshape(m, 1, 6, 6), heard.P], axis=1),
            np.concatenate([own, heard.valid], axis=1),
            self.fusion,
        )
        out = filters.copy()
        out[:, X], out[:, P] = fused.x, fused.P.reshape(m, 36)
        return self.estimator.take_over(out)


def estimate_block(filters: Array, heard: Heard) -> Actions:
    """The part `estimate` of the observation, (m, (1 + K) 13)."""
    m = len(filters)
    x = np.concatenate([filters[:, None, X], heard.x], axis=1)
    covariance = np.concatenate([filters[:, P].reshape(m, 1, 6, 6), heard.P], axis=1)
    out = np.zeros((*x.shape[:2], N_ESTIMATE), dtype=np.float32)
    out[..., 0] = np.concatenate([np.ones((m, 1)), heard.valid], axis=1)
    out[..., 1:7] = x
    out[..., 7:] = covariance[..., :3, :3][..., _VECH[0], _VECH[1]]
    return out.reshape(m, -1)
