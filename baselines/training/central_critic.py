"""MAPPO: PPO of one actor for all vehicles, with a critic that sees the whole team.

The actor sees what it will see in flight; the critic, needed in training only, sees the `state()` of the
team beside that, each vehicle from its own point of view (Yu et al., 2022, call it agent-specific). Every
vehicle has its own reward and its own advantage. A crash is the end for those that crashed: for the rest of
their team it is a truncation, after which they have what the critic expects.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy

from quad_envs.envs.team.batch import TeamBatch
from quad_envs.envs.team.options import TeamOptions
from quad_envs.observations.tracking import N_REFERENCE
from quad_envs.plant import Array
from quad_envs.tasks import TeamTask

from ..policies.network import Floats, Network
from . import sb3
from .algorithm_options import MappoOptions
from .held_out import Training
from .learner import Tanh
from .sb3 import flights_of, make_ppo, updates
from .vec_env import Bools, TaskOptions, TrainingVecEnv

_MOST = 10.0  # to which what the critic sees is clipped
# Of [p - p*, p_j - p_i, V_B, phi, theta, sin psi, cos psi, Omega, F / u_T - 1] of a vehicle, as features.
_SCALES = np.array([*(2.0,) * 3, *(2.0,) * 3, *(3.0,) * 3, 0.5, 0.5, 1.0, 1.0, *(3.0,) * 3, *(1.0,) * 4])


class CriticView:
    """The state of a team as each of its vehicles sees it: itself first, the others after it in their order.

    Args:
        task: Of the team.
    """

    def __init__(self, task: TeamTask) -> None:
        self._task, n = task, task.vehicles
        self._slots = np.zeros((n, 3)) if not task.slots else np.array(task.slots)
        self._order = (np.arange(n)[:, None] + np.arange(n)) % n
        self.size = n * (len(_SCALES) + n + 1) + N_REFERENCE * (task.layout.preview + 1) + 6 + 1

    def __call__(self, states: Array) -> Floats:
        """What the critic sees of vehicle i of team t in row t N + i.

        Args:
            states: (m, S), of `state()`.

        Returns:
            (m N, size): all vehicles (N x 20: error of position, place relative to the own one, velocity,
            attitude, rates, rotor forces), the graph (N x N) with the own row and column first, who this is
            (N numbers, one of them 1), preview and target relative to the own place, time.
        """
        n, order, part = self._task.vehicles, self._order, self._task.state_slices
        plants = states[:, part["plants"]].reshape(-1, n, 16)
        places = plants[:, :, :3]
        target = states[:, None, part["target"]].repeat(n, axis=1)
        preview = states[:, None, part["preview"]].repeat(n, axis=1)
        preview = preview.reshape(len(states), n, -1, N_REFERENCE)
        leads = self._task.mission == "formation"
        middle = preview[:, :, 0, :3] if leads else target[:, :, :3]
        rows = _own_parts(plants, middle + self._slots, self._task.hover_force)[:, order]
        rows[..., 3:6] = places[:, order] - places[:, :, None]
        preview[..., :3] -= places[:, :, None] * leads
        target[..., :3] -= places * (not leads)
        graph = states[:, part["graph"]].reshape(-1, n, n)[:, order[:, :, None], order[:, None, :]]
        parts = (
            rows / _SCALES,
            graph / 10.0,
            np.broadcast_to(np.eye(n), (len(states), n, n)),
            preview / np.array([2.0, 2.0, 2.0, 3.0, 3.0, 3.0, 1.0, 1.0]),
            target / 2.0,
            np.broadcast_to(states[:, None, part["time"]], (len(states), n, 1)),
        )
        flat = np.concatenate([entry.reshape(len(states) * n, -1) for entry in parts], axis=1)
        out: Floats = np.clip(flat, -_MOST, _MOST).astype(np.float32)
        return out


def _own_parts(plants: Array, wanted: Array, hover: float) -> Array:
    """Of each vehicle what no other one is needed for, unscaled, (m, N, 20); three columns stay empty."""
    out = np.zeros((*plants.shape[:2], len(_SCALES)))
    out[..., :3] = plants[..., :3] - wanted
    out[..., 6:11] = plants[..., 3:8]
    out[..., 11], out[..., 12] = np.sin(plants[..., 8]), np.cos(plants[..., 8])
    out[..., 13:16] = plants[..., 9:12]
    out[..., 16:] = plants[..., 12:] / hover - 1.0
    return out


class CentralEnv(TrainingVecEnv):
    """Teams whose rows are features of the actor, then what the critic sees of the state.

    Args:
        options: Of the task.
        n: Number of teams.
        seed: See `TrainingVecEnv`.
        given: Of `TrainingVecEnv`.
    """

    _batch: TeamBatch

    def __init__(self, options: TeamOptions, n: int, seed: Any = 0, **given: Any) -> None:
        super().__init__(options, n, seed, blame="agent", **given)
        assert isinstance(self.task, TeamTask)
        self._view = CriticView(self.task)
        size = self.encoder.size + self._view.size
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float32)

    def _see(
        self, observations: Floats, begins: Bools | None = None, rows: NDArray[np.int64] | None = None
    ) -> Floats:
        told = self._view(self._batch.state())
        own = super()._see(observations, begins, rows)
        return np.concatenate([own, told if rows is None else told[rows]], axis=1)


class CentralLayers(torch.nn.Module):
    """Hidden layers of an actor that sees the first numbers of a row, and of a critic that sees all.

    Args:
        seen: How many the actor sees.
        size: Of a row.
        actor: Widths of its layers.
        critic: Likewise.
    """

    def __init__(self, seen: int, size: int, actor: tuple[int, ...], critic: tuple[int, ...]) -> None:
        super().__init__()
        self._seen, self.latent_dim_pi, self.latent_dim_vf = seen, actor[-1], critic[-1]
        self.policy_net, self.value_net = _layers((seen, *actor)), _layers((size, *critic))

    def forward(self, rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Both."""
        return self.forward_actor(rows), self.forward_critic(rows)

    def forward_actor(self, rows: torch.Tensor) -> torch.Tensor:
        """The actor's last hidden layer."""
        out: torch.Tensor = self.policy_net(rows[:, : self._seen])
        return out

    def forward_critic(self, rows: torch.Tensor) -> torch.Tensor:
        """The critic's last hidden layer."""
        out: torch.Tensor = self.value_net(rows)
        return out


def _layers(sizes: tuple[int, ...]) -> torch.nn.Sequential:
    """Linear layers, each with a tanh after it."""
    pairs = [(torch.nn.Linear(a, b), Tanh()) for a, b in pairwise(sizes)]
    return torch.nn.Sequential(*(module for pair in pairs for module in pair))


class CentralPolicy(ActorCriticPolicy):
    """The policy of stable-baselines3 with `CentralLayers`; `seen` as there."""

    def __init__(self, *args: Any, seen: int, **kwargs: Any) -> None:
        self._seen = seen
        super().__init__(*args, **kwargs)

    def _build_mlp_extractor(self) -> None:
        assert isinstance(self.net_arch, dict)
        actor, critic = tuple(self.net_arch["pi"]), tuple(self.net_arch["vf"])
        self.mlp_extractor = CentralLayers(self._seen, self.features_dim, actor, critic)  # type: ignore[assignment]


def check(task_options: TaskOptions, options: MappoOptions, start: Network | None = None) -> None:
    """Refuse what `train` would, before anything is written.

    Raises:
        ValueError: If the task is of one vehicle; see `sb3.check`.
    """
    if not isinstance(task_options, TeamOptions):
        raise ValueError(
            f"mappo needs the state() of a team for its critic, and {task_options.env_id} is flown by one "
            "vehicle: train with ppo, or take quad/Formation-v0"
        )
    sb3.check(task_options, options, start)


def train(
    task_options: TeamOptions,
    options: MappoOptions,
    seed: int,
    spent: Callable[[], float],
    start: Network | None = None,
) -> Training:
    """Train with PPO and a critic of the whole team; otherwise as `sb3.train_ppo`.

    Raises:
        ValueError: See `check`; or `start` has other layers.
        TrainingError: If a loss or a weight is not finite.
    """
    check(task_options, options)
    if start is not None:
        rate = options.start_learning_rate
        options = replace(options, log_std_init=options.start_log_std, learning_rate=rate)
    flights = make_central_flights(task_options, options, seed, start)
    yield from updates(make_mappo(flights, options, seed, spent), flights, options, spent, start)


def make_central_flights(
    task_options: TeamOptions, options: MappoOptions, seed: int, start: Network | None = None
) -> CentralEnv:
    """Teams to train on, see `sb3.make_flights`."""
    return flights_of(CentralEnv, task_options, options, seed, start)


def make_mappo(flights: CentralEnv, options: MappoOptions, seed: int, spent: Callable[[], float]) -> Any:
    """The learner, not yet trained."""
    layers = {"pi": list(options.net_arch), "vf": list(options.critic_arch)}
    policy = CentralPolicy, {"net_arch": layers, "seen": flights.encoder.size}
    return make_ppo(flights, options, seed, spent, policy=policy)
