"""PPO, PPO-Lagrangian and SAC of stable-baselines3 on the suite's own batched environments: model-free.

The reward that trains is THE reward. Seeds give equal runs. Torch and stable-baselines3 are needed here only:
what comes out is a `Network`.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import fields, replace
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecEnv

from quad_envs.envs.team.options import TeamOptions
from quad_envs.envs.tracking.options import TrackingOptions
from quad_envs.wrappers.encoded_space import stages_of
from quad_envs.wrappers.encoding import Encoding

from ..errors import TrainingError
from ..policies.disturbance_estimate import sees_estimate
from ..policies.network import Network
from .algorithm_options import PpoLagrangianOptions, PpoOptions, SacOptions
from .beginning import require_continuable
from .features import require_measured, training_features, training_task
from .held_out import Progress, Training
from .lagrangian import LagrangianBuffer, LagrangianEnv, Multiplier, Probe
from .learner import RowBuffer, RowPPO, Tanh
from .vec_env import TaskOptions, TrainingVecEnv

F = TypeVar("F", bound=TrainingVecEnv)
_PROBES = 500_000_009  # from the seed of training to that of the flights which measure violations
_QUIET = 0.1  # factor on the weights of SAC's noise, at the start
_NEVER = 2**31  # updates between logs of stable-baselines3; runs keep their own


def check(task_options: TaskOptions, options: PpoOptions | SacOptions, start: Network | None = None) -> None:
    """Refuse what training would, before anything is written.

    Raises:
        ValueError: If nobody measures a target, or training cannot go on from `start`.
    """
    if isinstance(task_options, TeamOptions):
        require_measured(task_options)
    sees = options.disturbance_estimate, options.heading_axes
    features = training_features(task_options, options.stages, *sees)
    if start is None:
        return
    if isinstance(task_options, TeamOptions):
        require_continuable(start, features, options.net_arch, 4, "clip")
        return
    # One vehicle goes on with what the network sees, if it is there and nothing else is asked for.
    seen = start.features
    layout = replace(training_task(task_options).layout, disturbance_estimate=sees_estimate(seen))
    seen.columns(layout)  # says what is missing
    others = options.stages is not None and features.names != seen.names
    if others or (options.heading_axes and not seen.heading_axes):
        raise ValueError(
            "a training that goes on from a network sees what that one sees, not other stages or "
            "heading_axes: leave these hyperparameters out, or begin without a network"
        )
    wanted = list(pairwise((len(seen.names), *options.net_arch, 4)))
    require_layers(start, wanted, "tanh" if isinstance(options, SacOptions) else "clip")


def require_layers(network: Network, wanted: list[tuple[int, int]], squash: str) -> None:
    """Check that a learner can take over a network.

    Args:
        network: To begin with.
        wanted: (inputs, outputs) of each layer of the learner.
        squash: How its outputs come into [-1, 1].

    Raises:
        ValueError: If not.
    """
    found = [tuple(W.shape) for W in network.weights]
    kinds = network.squash, network.commands, network.activation
    if found != wanted or kinds != (squash, "hover", "tanh"):
        raise ValueError(
            f"the network has layers {found}, squash, commands and activation {kinds}, this training "
            f"{wanted} and {(squash, 'hover', 'tanh')}: go on with the algorithm and the net_arch that "
            "made it"
        )


def train_ppo(
    task_options: TaskOptions,
    options: PpoOptions,
    seed: int,
    spent: Callable[[], float],
    start: Network | None = None,
) -> Training:
    """Train with PPO, see `algorithms`; vehicles of a team share the network, which comes without its noise.

    Of `start` neither critic nor noise is known: the critic learns anew, and the policy stands still for the
    first `critic_updates`.

    Raises:
        ValueError: If actions of the task are no rotor commands, or `start` has other layers.
        TrainingError: If a loss or a weight is not finite.
    """
    flights = make_flights(task_options, options, seed, start)
    model = make_ppo(flights, options, seed, spent)
    yield from updates(model, flights, options, spent, start)


def train_ppo_lagrangian(
    task_options: TaskOptions,
    options: PpoLagrangianOptions,
    seed: int,
    spent: Callable[[], float],
    start: Network | None = None,
) -> Training:
    """Train with PPO under a bound on the share of violating steps; otherwise as `train_ppo`.

    Raises:
        ValueError: If the task has no limits, or its actions are no rotor commands.
        TrainingError: If a loss or a weight is not finite.
    """
    flights = make_flights(task_options, options, seed, start)
    if not flights.task.constraint_names:
        raise ValueError(
            f"{flights.task.env_id} has no limits that ppo-lagrangian could keep: train with ppo, or set "
            "tilt_limit, velocity_limit, position_limit or rate_limit"
        )
    multiplier = Multiplier(options.limit, options.proportional, options.integral)
    env = LagrangianEnv(flights, options.gamma)
    buffer = {"env": env, "multiplier": multiplier, "n_epochs": options.n_epochs}
    torch.manual_seed(seed)
    model = make_ppo(env, options, seed, spent, (LagrangianBuffer, buffer))
    # Other starts than those of training, so that both see new ones.
    probe = Probe(make_flights(task_options, replace(options, n_envs=options.probes), seed + _PROBES, start))
    yield from updates(model, flights, options, spent, start, (multiplier, probe))


def train_sac(
    task_options: TaskOptions,
    options: SacOptions,
    seed: int,
    spent: Callable[[], float],
    start: Network | None = None,
) -> Training:
    """Train with SAC, on tasks of one vehicle; otherwise as `train_ppo`.

    Raises:
        ValueError: If the task is one of several vehicles.
        TrainingError: If a loss or a weight is not finite.
    """
    if isinstance(task_options, TeamOptions):
        raise ValueError(
            f"sac cannot act in {task_options.env_id}, a PettingZoo task of several vehicles: its replay "
            "would mix what neighbours did while they learned; ppo and ppo-lagrangian train there"
        )
    flights = make_flights(task_options, options, seed, start)
    model = make_sac(flights, options, seed, spent)
    yield from updates(model, flights, options, spent, start)


def make_flights(
    task_options: TaskOptions,
    options: PpoOptions | SacOptions,
    seed: int,
    start: Network | None = None,
) -> TrainingVecEnv:
    """Flights to train on: as many teams as make about `n_envs` vehicles, or `n_envs` single ones.

    Raises:
        ValueError: If the preview has not the stages that the network shall see, or actions of the task are
            no rotor commands.
    """
    return flights_of(TrainingVecEnv, task_options, options, seed, start)


def flights_of(
    kind: Callable[..., F],
    task_options: TaskOptions,
    options: PpoOptions | SacOptions,
    seed: int,
    start: Network | None = None,
) -> F:
    """Flights of a kind, see `make_flights`."""
    size = task_options.vehicles if isinstance(task_options, TeamOptions) else 1
    stages = options.stages
    if stages is None and isinstance(task_options, TrackingOptions):
        stages = stages_of(task_options.task.layout.preview)
    encoding = Encoding(
        training_features(task_options, stages, options.disturbance_estimate, options.heading_axes),
        options.command_range,
    )
    if start is not None:
        encoding = start.encoding
    n = max(1, options.n_envs // size)
    return kind(task_options, n, seed, encoding=encoding, episode_steps=options.episode_steps)


def make_ppo(
    env: VecEnv,
    options: PpoOptions,
    seed: int,
    spent: Callable[[], float],
    buffer: tuple[type[RowBuffer], dict[str, Any]] = (RowBuffer, {}),
    policy: tuple[str | type[ActorCriticPolicy], dict[str, Any]] = ("MlpPolicy", {}),
) -> PPO:
    """The learner, not yet trained; `buffer` and `policy` are a class and what it needs."""
    samples = env.num_envs * options.n_steps
    arguments = _arguments(PPO, options, spent)
    arguments["batch_size"] = math.ceil(samples / max(1, round(samples / options.batch_size)))
    model = RowPPO(
        policy[0],
        env,
        **arguments,
        policy_kwargs={
            "net_arch": list(options.net_arch),
            "activation_fn": Tanh,
            "log_std_init": options.log_std_init,
            "optimizer_kwargs": {"eps": 1e-5, "fused": True},
            **policy[1],
        },
        rollout_buffer_class=buffer[0],
        rollout_buffer_kwargs=buffer[1],
        seed=seed,
        device="cpu",
    )
    model.set_logger(Logger(None, []))
    return model


def make_sac(env: VecEnv, options: SacOptions, seed: int, spent: Callable[[], float]) -> SAC:
    """The learner, not yet trained."""
    model = SAC(
        "MlpPolicy",
        env,
        **_arguments(SAC, options, spent),
        policy_kwargs={
            "net_arch": list(options.net_arch),
            "activation_fn": Tanh,
            "n_critics": options.n_critics,
            "optimizer_kwargs": {"fused": True},
        },
        seed=seed,
        device="cpu",
    )
    noise: torch.nn.Linear = model.actor.log_std  # type: ignore[assignment]  # Stable-Baselines3 says Parameter
    with torch.no_grad():  # it hardly depends on what is seen, and does not tip the vehicle over
        noise.weight.mul_(_QUIET)
        noise.bias.fill_(options.log_std_init)
    model.set_logger(Logger(None, []))
    return model


def _arguments(
    learner: type[PPO | SAC], options: PpoOptions | SacOptions, spent: Callable[[], float]
) -> dict[str, Any]:
    """Hyperparameters that a learner takes under the same names; the learning rate falls."""
    taken = inspect.signature(learner).parameters
    same = {entry.name: getattr(options, entry.name) for entry in fields(options) if entry.name in taken}
    return same | {"learning_rate": _falling(options.learning_rate, options.final_rate, spent)}


def export(model: PPO | SAC, encoding: Encoding) -> Network:
    """The policy without its noise.

    Args:
        model: With tanh layers.
        encoding: Of what it sees and commands.
    """
    layers = _policy_layers(model)
    return Network(
        encoding.features,
        tuple(np.ascontiguousarray(layer.weight.detach().numpy().T) for layer in layers),
        tuple(layer.bias.detach().numpy().copy() for layer in layers),
        squash="tanh" if isinstance(model, SAC) else "clip",
        command_range=encoding.command_range,
    )


def take_over(model: PPO | SAC, network: Network) -> None:
    """Give a learner the policy of a network.

    Raises:
        ValueError: If the network has other layers.
    """
    layers = _policy_layers(model)
    wanted = [(layer.in_features, layer.out_features) for layer in layers]
    require_layers(network, wanted, "tanh" if isinstance(model, SAC) else "clip")
    with torch.no_grad():
        for layer, W, b in zip(layers, network.weights, network.biases, strict=True):
            layer.weight.copy_(torch.from_numpy(W.T))
            layer.bias.copy_(torch.from_numpy(b))


def _policy_layers(model: PPO | SAC) -> list[torch.nn.Linear]:
    """From features to the mean of the action."""
    if isinstance(model, SAC):
        modules = [*model.actor.latent_pi, model.actor.mu]
    else:
        modules = [*model.policy.mlp_extractor.policy_net, model.policy.action_net]
    return [module for module in modules if isinstance(module, torch.nn.Linear)]


def _falling(first: float, last_share: float, spent: Callable[[], float]) -> Callable[[float], float]:
    """Learning rate that falls in a straight line over the budget, whatever stable-baselines3 counts."""
    return lambda _: first * (1.0 - (1.0 - last_share) * min(spent(), 1.0))


def updates(
    model: PPO | SAC,
    flights: TrainingVecEnv,
    options: PpoOptions | SacOptions,
    spent: Callable[[], float],
    start: Network | None,
    bound: tuple[Multiplier, Probe] | None = None,
) -> Training:
    """Learn in pieces of some steps of all rows, each checked before it is handed out."""
    steps = options.n_steps if isinstance(options, PpoOptions) else options.progress_steps
    if start is not None:
        take_over(model, start)
    update = 0
    while spent() < 1.0:
        held = start is not None and isinstance(options, PpoOptions) and update < options.critic_updates
        for layer in _policy_layers(model):
            layer.requires_grad_(not held)
        update += 1
        try:
            model.learn(flights.num_envs * steps, reset_num_timesteps=False, log_interval=_NEVER)
        except ValueError as error:
            # Torch and the environment refuse what is not finite, each with words of its own.
            if _unsound(model) is None:
                raise
            raise _lost(model, update) from error
        if _unsound(model) is not None:
            raise _lost(model, update)
        tally = flights.tally()
        if bound is not None and isinstance(options, PpoLagrangianOptions) and spent() >= options.free:
            multiplier, probe = bound
            multiplier.update(probe.share(model, steps))
        yield Progress(update, model.num_timesteps, tally.reward), export(model, flights.encoder.encoding)


def _unsound(model: PPO | SAC) -> str | None:
    """What is not finite in a learner: a loss or the weights; None where all is well."""
    for name, value in model.logger.name_to_value.items():
        if "loss" in name and not np.isfinite(value):
            return f"{name.removeprefix('train/').replace('_', ' ')} is {value}"
    if not all(bool(torch.isfinite(parameter).all()) for parameter in model.policy.parameters()):
        return "a weight is not finite"
    if isinstance(model, PPO):
        noise = model.policy.log_std.detach().exp()
        if not bool((torch.isfinite(noise) & (noise > 0.0)).all()):
            return f"the standard deviation of an action is {float(noise.max())}"
    return None


def _lost(model: PPO | SAC, update: int) -> TrainingError:
    return TrainingError(
        f"{_unsound(model)} at update {update}: the last good policy is kept; a smaller learning_rate may "
        "help"
    )
