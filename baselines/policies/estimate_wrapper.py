"""Sharing estimates: a wrapper that runs a target filter per agent and lets neighbours exchange them.

Each agent filters what its own observation holds. Its estimate and covariance travel with its messages, and
in the step in which a message arrives the receiver intersects the covariances: all agents fuse at once, from
estimates of before any fusion, moved on by the message's age. The block `estimate` at the end of the
observation then has the own estimate and, of each comm slot, what came with the message.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo.utils import BaseParallelWrapper

from controllers.estimation import covariance_intersection
from controllers.estimation.consistency import nees
from controllers.estimation.ekf import constant_velocity_model
from quad_envs.names import unknown_name
from quad_envs.observations.team import (
    COMM_AGE,
    COMM_POSITION,
    COMM_WEIGHT,
    N_ESTIMATE,
)
from quad_envs.parameters import Array
from quad_envs.tasks import TeamTask

from .estimation import make_estimator
from .estimation_kernels import P, X
from .protocol import Actions

Fusion = Literal["trace", "equal", "determinant", "none"]
_VECH = np.triu_indices(3)  # xx, xy, xz, yy, yz, zz
_BOUND = 1e6

_Dict = dict[str, Any]


class _Heard(NamedTuple):
    """Estimates that came with the messages of this step, relative to their receivers."""

    x: Array  # (m, K, 6)
    P: Array  # (m, K, 6, 6)
    valid: NDArray[np.bool_]  # (m, K)


class EstimateWrapper(BaseParallelWrapper):  # type: ignore[misc]
    """A team with a target whose agents filter, exchange and fuse estimates, and observe them.

    Infos gain `nees` (e'P^-1 e of the own estimated position, chi^2 with 3 degrees of freedom), `nis` (of the
    agent's own measurements of this step, chi^2 with `nis_rows` degrees of freedom; nan without any), and
    `mode`, "EKF,m" with m measurements held. The estimates in `env.task.layout` have a name of their own, so
    that `make_policy(name, env)` reads them.

    Args:
        env: A ParallelEnv of this suite with a target.
        fusion: Weights of the covariance intersection: "trace" (1 / tr P), "equal", "determinant" (smallest
            determinant); "none": nobody tells anybody.
        q: Of the target's motion in the filters, see `estimation.make_estimator`; None: 0.02 for
            estimation, 0.05 m^2/s^3 for tracking.
        estimator: "ekf", "trilateration", "polar-ekf", "random-walk", or an object of the user's.

    Raises:
        ValueError: If the environment has no target, or estimates already, or an option is not allowed.
    """

    def __init__(self, env: Any, fusion: Fusion = "trace", q: Any = None, estimator: Any = "ekf") -> None:
        super().__init__(env)
        inner = getattr(env, "task", None)
        if not isinstance(inner, TeamTask) or inner.layout.estimate:
            raise ValueError(
                f"EstimateWrapper needs a ParallelEnv of this suite without estimates, got {env!r}; take "
                "quad_envs.target_tracking_v0 or cooperative_estimation_v0"
            )
        if fusion not in get_args(Fusion):
            raise ValueError(unknown_name("fusion", fusion, get_args(Fusion)))
        self._inner, self.fusion = inner, fusion
        self.estimator = make_estimator(inner, estimator, q)
        if fusion != "none" and not self.estimator.can_fuse:
            raise ValueError(
                f"{estimator!r} cannot take fused estimates over: give it `replaced(memory, x, P)`, or "
                "choose fusion='none'"
            )
        self.task = replace(inner, layout=replace(inner.layout, estimate=True))
        size = self.task.layout.size
        self.observation_spaces = {
            name: spaces.Box(-_BOUND, _BOUND, (size,), np.float32) for name in env.possible_agents
        }
        self._senders: NDArray[np.int64] = env.unwrapped.senders
        self._begin()

    def _begin(self) -> None:
        n, K = self._senders.shape
        self._step = 0
        self._filters: Array = np.zeros((n, self.estimator.size))
        self._told = np.full((n, K), -1, dtype=np.int64)  # step at which the last message of a slot was sent
        self._sent: list[tuple[Array, Array]] = []  # estimates of all agents before fusion, step by step

    def __getstate__(self) -> _Dict:
        """Everything: attributes that begin with an underscore are those of this wrapper."""
        return self.__dict__

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        """The attributes."""
        self.__dict__.update(state)

    def observation_space(self, agent: str) -> spaces.Box:
        """Of one agent, with the block of estimates; always the same object."""
        return self.observation_spaces[agent]

    def reset(self, seed: int | None = None, options: _Dict | None = None) -> tuple[_Dict, _Dict]:
        """Begin an episode with filters that know the prior and the first measurements."""
        observations, infos = self.env.reset(seed=seed, options=options)
        self._begin()
        self._truth: Array = self.env.unwrapped.target
        return self._share(observations, infos), infos

    def step(self, actions: Mapping[str, Any]) -> tuple[_Dict, _Dict, _Dict, _Dict, _Dict]:
        """A step of the environment, then one of the filters."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        self._step += 1
        return self._share(observations, infos), rewards, terminated, truncated, infos

    def _share(self, observations: Mapping[str, Actions], infos: _Dict) -> _Dict:
        """Filter, exchange, fuse; observations with estimates. Adds to the infos."""
        names = list(observations)
        if not names:
            return {}
        agents = np.array([self.env.possible_agents.index(name) for name in names])
        rows = np.stack([observations[name] for name in names])
        start = np.full(len(names), self._step == 0)
        done = self.estimator.step(rows, self._filters[agents], start)
        heard = self._exchange(agents, done.filters, done.parts.comm)
        filters = self._fused(done.filters, heard)
        self._filters[agents] = filters
        block = self._block(filters, heard)
        consistency = self._consistency(agents, filters)
        for i, name in enumerate(names):
            infos[name]["nees"] = float(consistency[i])
            infos[name]["nis"] = float(done.reports[i, 0])
            infos[name]["nis_rows"] = int(done.reports[i, 1])
            infos[name]["mode"] = f"EKF,{int(done.reports[i, 2])}"
        return {name: np.concatenate([row, more]) for name, row, more in zip(names, rows, block, strict=True)}

    def _exchange(self, agents: NDArray[np.int64], filters: Array, comm: Array) -> _Heard:
        """What the messages that arrive in this step bring."""
        n, K, layout = len(agents), self._senders.shape[1], self._inner.layout
        everybody = np.zeros_like(self._filters)
        everybody[agents] = filters
        self._sent.append((everybody[:, X].copy(), everybody[:, P].reshape(-1, 6, 6).copy()))
        heard = _Heard(np.zeros((n, K, 6)), np.zeros((n, K, 6, 6)), np.zeros((n, K), dtype=np.bool_))
        if self.fusion == "none":
            return heard
        slots = comm.reshape(n, K, layout.comm_size)
        ages = np.rint(slots[..., COMM_AGE] / self.task.dt).astype(np.int64)
        sent = self._step - ages
        heard.valid[:] = (slots[..., COMM_WEIGHT] > 0.0) & (sent > self._told[agents])
        for step in np.unique(sent[heard.valid]).tolist():
            which = heard.valid & (sent == step)
            sender = self._senders[agents][which]
            everywhere, spreads = self._sent[step]
            x, covariance = self._moved_on(everywhere[sender], spreads[sender], self._step - step)
            x[:, :3] += slots[which][:, COMM_POSITION]
            heard.x[which], heard.P[which] = x, covariance
        told = self._told[agents]
        told[heard.valid] = sent[heard.valid]
        self._told[agents] = told
        return heard

    def _moved_on(self, x: Array, covariance: Array, steps: int) -> tuple[Array, Array]:
        """Estimates (m, 6) some steps later, from an origin that stays."""
        if steps == 0:
            return x, covariance
        F, Q = constant_velocity_model(steps * self.task.dt, self.estimator.q)
        return x @ F.T, F @ covariance @ F.T + Q

    def _fused(self, filters: Array, heard: _Heard) -> Array:
        """The filters after covariance intersection, (m, size)."""
        if not heard.valid.any():
            return filters
        n = len(filters)
        own = np.ones((n, 1), dtype=np.bool_)
        fused = covariance_intersection(
            np.concatenate([filters[:, None, X], heard.x], axis=1),
            np.concatenate([filters[:, P].reshape(n, 1, 6, 6), heard.P], axis=1),
            np.concatenate([own, heard.valid], axis=1),
            self.fusion,
        )
        out = filters.copy()
        out[:, X], out[:, P] = fused.x, fused.P.reshape(n, 36)
        return self.estimator.take_over(out)

    def _block(self, filters: Array, heard: _Heard) -> Actions:
        """The estimate block of the observation, (m, (1 + K) 13)."""
        n = len(filters)
        x = np.concatenate([filters[:, None, X], heard.x], axis=1)
        covariance = np.concatenate([filters[:, P].reshape(n, 1, 6, 6), heard.P], axis=1)
        out = np.zeros((*x.shape[:2], N_ESTIMATE), dtype=np.float32)
        out[..., 0] = np.concatenate([np.ones((n, 1)), heard.valid], axis=1)
        out[..., 1:7] = x
        out[..., 7:] = covariance[..., :3, :3][..., _VECH[0], _VECH[1]]
        return out.reshape(n, -1)

    def _consistency(self, agents: NDArray[np.int64], filters: Array) -> Array:
        """Normalised error squared of the positions, from the truth."""
        truth = self._truth[min(self._step, len(self._truth) - 1), :3]
        error = filters[:, X][:, :3] + self.env.unwrapped.plants[agents, :3] - truth
        return nees(error, filters[:, P].reshape(-1, 6, 6)[:, :3, :3])
