"""Hyperparameters of each algorithm, as values: reading them loads no torch.

A name of Stable-Baselines3 means what it means there; what it has no name for has one of ours. The comment of
a field is its documentation everywhere.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

from quad_envs.arguments.checks import require_memory, require_whole
from quad_envs.arguments.names import shown

if TYPE_CHECKING:
    from ..policies.network import Squash

_POSITIVE = (
    *("n_envs", "n_steps", "progress_steps", "batch_size", "n_epochs", "learning_rate", "final_rate"),
    *("gamma", "clip_range", "max_grad_norm", "command_range", "train_freq", "gradient_steps"),
    *("buffer_size", "tau", "probes", "start_learning_rate", "final_n_steps", "substeps", "epsilon"),
    *("final_epsilon", "threshold", "n_critics"),
)
# Hyperparameters that take memory or time, and the largest that make sense.
_MOST = {
    **dict.fromkeys(("n_envs", "probes"), 100_000),
    "n_critics": 100,
    **dict.fromkeys(("n_steps", "final_n_steps", "progress_steps", "train_freq"), 10_000),
    "n_epochs": 1_000,
    "substeps": 64,
    **dict.fromkeys(("gradient_steps", "final_gradient_steps", "critic_updates", "episode_steps"), 1_000_000),
    "batch_size": 10_000_000,
    "buffer_size": 100_000_000,
    "learning_starts": 1_000_000_000,
}
_KEPT = ("n_envs", "probes", "n_steps", "final_n_steps", "batch_size", "buffer_size")  # observations
_MAY_BE_NONE = ("gradient_steps", "final_gradient_steps", "critic_updates", "learning_starts")
_WIDEST, _MOST_LAYERS = 10_000, 20
_SHARES = ("free", "final_rate", "gamma", "gae_lambda", "tau", "command_range", "expert_flies")
_WEIGHTS = ("vf_coef", "penalty")  # that may be zero
_LOGARITHMS, _LARGEST_LOGARITHM = ("log_std_init", "start_log_std"), 20
_AUTO = re.compile(r"auto(_(?=[0-9.]*[1-9])[0-9]*\.?[0-9]+(e-?[0-9]+)?)?")


@dataclass(frozen=True, slots=True)
class PolicyGradientOptions:
    """Hyperparameters of the analytic policy gradient."""

    n_envs: int = 64  # flights at once, or vehicles of all teams
    n_steps: int = 25  # of each flight in an update, a window, at the beginning
    final_n_steps: int = 25  # and at the end; long windows see more of what follows, but learn late
    substeps: int = 2  # of the integrator while training; 5 in evaluation
    learning_rate: float = 1e-2  # of Adam, at the beginning
    final_rate: float = 0.03  # share of the learning rate at the end of the budget
    gamma: float = 0.99  # discount per step of a window
    epsilon: float = 1e-3  # of log(r + epsilon), at the beginning
    final_epsilon: float = 1e-3  # and at the end; the larger, the more it is the sum of rewards itself
    penalty: float = 0.0  # weight of the violation cost in the objective
    net_arch: tuple[int, ...] = (64, 64)  # widths of the hidden layers
    max_grad_norm: float = 1.0  # to which gradients are clipped
    squash: Squash = "tanh"  # how outputs come into [-1, 1]; "clip" as what dagger makes of teams
    stages: tuple[int, ...] | None = None  # of a team's preview, that the network sees; None: the usual ones
    separation: float | None = None  # m, below which the cost counts a team's distances; None for the task's
    episode_steps: int | None = None  # of a team's flight in training; None for the task's own
    disturbance_estimate: bool = False  # whether the network sees an estimate of the disturbance
    heading_axes: bool = False  # whether it sees in axes turned to the heading of the reference

    def __post_init__(self) -> None:
        _check_numbers(self)


@dataclass(frozen=True, slots=True)
class DaggerOptions:
    """Hyperparameters of DAgger."""

    expert: str = ""  # a policy, or a trained one; empty: sdc-nmpc, consensus-mpc or cooperative-mpc
    expert_options: Mapping[str, Any] | None = None  # of the expert, as `make_policy` takes them
    n_envs: int = 64  # flights at once, or vehicles of all teams
    n_steps: int = 20  # of each of them between fits
    expert_flies: float = 0.2  # share of the budget in which those that the expert flies fall to none
    gradient_steps: int = 40  # after each n_steps, at the beginning
    final_gradient_steps: int = 200  # and at the end of the budget, when there are many labels
    batch_size: int = 512  # labels of a gradient step
    learning_rate: float = 3e-3  # of Adam, at the beginning
    final_rate: float = 0.02  # share of the learning rate at the end of the budget
    threshold: float = 0.05  # of an output's error, up to which the loss is quadratic
    net_arch: tuple[int, ...] = (64, 64)  # widths of the hidden layers
    squash: Squash = "tanh"  # how outputs come into [-1, 1]; "clip" as PPO, which can then go on from here
    stages: tuple[int, ...] | None = None  # of the preview that the network sees; None for the usual ones
    disturbance_estimate: bool = False  # whether network and expert estimate the disturbance
    heading_axes: bool = False  # whether the network sees in axes turned to the heading of the reference
    separation: float | None = None  # m, that the expert of a team keeps; None for the task's own
    episode_steps: int | None = None  # of a team's flight in training; None for the task's own

    def __post_init__(self) -> None:
        _check_numbers(self)


@dataclass(frozen=True, slots=True)
class PpoOptions:
    """Hyperparameters of PPO."""

    n_envs: int = 512  # flights at once, or vehicles of all teams
    n_steps: int = 32  # of each of them in an update
    batch_size: int = 4096  # samples of a minibatch; made smaller or larger until all of an update are equal
    n_epochs: int = 4  # passes over the samples of an update
    learning_rate: float = 1e-3  # of Adam, at the beginning
    final_rate: float = 0.05  # share of the learning rate at the end of the budget
    gamma: float = 0.99  # discount per step
    gae_lambda: float = 0.98  # of the advantage estimate
    clip_range: float = 0.2  # of the ratio of probabilities
    log_std_init: float = -1.0  # log of an action's standard deviation at the start
    ent_coef: float = 0.0  # weight of the entropy bonus
    vf_coef: float = 0.5  # weight of the value function's loss
    max_grad_norm: float = 0.5  # to which gradients are clipped
    net_arch: tuple[int, ...] = (64, 64)  # widths of the hidden layers, of policy and critic alike
    stages: tuple[int, ...] | None = None  # of the preview that the network sees; None for FilterAndRescale's
    disturbance_estimate: bool = False  # whether the network sees an estimate of the disturbance
    heading_axes: bool = False  # whether it sees in axes turned to the heading of the reference
    command_range: float = 0.5  # largest change of a rotor force, as a share of its force in hover
    episode_steps: int | None = None  # of a flight in training; None for the task's own
    critic_updates: int = 5  # of the critic alone, where training goes on from a policy

    def __post_init__(self) -> None:
        _check_numbers(self)


@dataclass(frozen=True, slots=True)
class MappoOptions(PpoOptions):
    """Hyperparameters of PPO with a critic that sees the whole team."""

    critic_arch: tuple[int, ...] = (
        128,
        128,
    )  # widths of the hidden layers of the critic; net_arch: the actor's
    start_log_std: float = -3.5  # log_std_init, where training goes on from a policy
    start_learning_rate: float = 3e-4  # learning_rate, where training goes on from a policy


@dataclass(frozen=True, slots=True)
class PpoLagrangianOptions(PpoOptions):
    """Hyperparameters of PPO with a bound on the share of violating steps."""

    limit: float = 0.01  # of the share of violating steps without the noise of training
    free: float = 0.5  # share of the budget before the multiplier moves: first fly, then keep limits
    proportional: float = 0.2  # multiplier per relative excess, which counts up to 1
    integral: float = 0.02  # the same, per update
    probes: int = 64  # vehicles that fly without noise, by which violations are measured


@dataclass(frozen=True, slots=True)
class SacOptions:
    """Hyperparameters of SAC."""

    n_envs: int = 16  # flights at once
    train_freq: int = 1  # steps of each flight between updates
    gradient_steps: int = 4  # of an update
    batch_size: int = 128  # samples of a gradient step
    buffer_size: int = 500_000  # steps in the replay buffer, of all flights
    learning_starts: int = 2_000  # steps of random actions before, of all flights
    learning_rate: float = 2e-3  # of Adam, at the beginning
    final_rate: float = 0.1  # share of the learning rate at the end of the budget
    gamma: float = 0.95  # discount per step
    tau: float = 0.2  # by which the target critics follow in a gradient step
    ent_coef: float | str = 0.005  # weight of the entropy; "auto_0.01" learns it, from 0.01
    n_critics: int = 1  # of which the least counts
    log_std_init: float = -1.0  # log of an action's standard deviation at the start
    net_arch: tuple[int, ...] = (64, 64)  # widths of the hidden layers, of policy and critics alike
    stages: tuple[int, ...] | None = None  # of the preview that the network sees; None for FilterAndRescale's
    disturbance_estimate: bool = False  # whether the network sees an estimate of the disturbance
    heading_axes: bool = False  # whether it sees in axes turned to the heading of the reference
    command_range: float = 0.5  # largest change of a rotor force, as a share of its force in hover
    episode_steps: int | None = None  # of a flight in training; None for the task's own
    progress_steps: int = 64  # of each flight between two looks at the policy

    def __post_init__(self) -> None:
        _check_numbers(self)
        weight = self.ent_coef
        if not (_AUTO.fullmatch(weight) if isinstance(weight, str) else 0.0 <= weight < math.inf):
            raise ValueError(
                "hyperparameter ent_coef must be finite and >= 0, or 'auto' or as 'auto_0.01', got "
                f"{shown(weight)}"
            )


def check_sizes(options: Any, width: int) -> None:
    """Refuse sizes that no machine holds, before anything is made.

    Args:
        options: Hyperparameters of any algorithm.
        width: Numbers in an observation.

    Raises:
        ValueError: If there is one; the message has the memory that it would take.
    """
    for one in fields(options):
        value = getattr(options, one.name)
        if value is not None and one.name in _MOST:
            least, most = int(one.name not in _MAY_BE_NONE), _MOST[one.name]
            memory = (lambda n: 4 * n * width) if one.name in _KEPT else None  # the others take time
            require_whole(f"hyperparameter {one.name}", value, least, most, memory)
    for name in ("net_arch", "critic_arch"):
        layers = getattr(options, name, ())
        if len(layers) > _MOST_LAYERS:
            raise ValueError(f"hyperparameter {name} has at most {_MOST_LAYERS} layers, got {shown(layers)}")
        for n in layers:
            require_whole(f"a layer of hyperparameter {name}", n, 1, _WIDEST, lambda n: 4 * n * (n + width))
    kept = options.n_envs * getattr(options, "n_steps", 1) + 2 * getattr(options, "buffer_size", 0)
    require_memory(
        f"training with {kept} observations of {width} numbers at a time",
        4 * kept * width,
        "lower the hyperparameters n_envs, n_steps or buffer_size",
    )


def _check_numbers(options: PolicyGradientOptions | DaggerOptions | PpoOptions | SacOptions) -> None:
    """Refuse hyperparameters that make no sense.

    Raises:
        ValueError: If there is one; the message names it.
    """
    for name in {field.name for field in fields(options)} & {*_POSITIVE, *_SHARES, *_WEIGHTS}:
        value = getattr(options, name)
        least = "> 0" if name in _POSITIVE else ">= 0"
        if not 0.0 <= value < math.inf or (name in _POSITIVE and value == 0.0):
            raise ValueError(f"hyperparameter {name} must be finite and {least}, got {shown(value)}")
        if name in _SHARES and value > 1.0:
            raise ValueError(f"hyperparameter {name} must be at most 1, got {shown(value)}")
    for name in {field.name for field in fields(options)} & set(_LOGARITHMS):
        if not abs(getattr(options, name)) <= _LARGEST_LOGARITHM:
            raise ValueError(
                f"hyperparameter {name} must lie in -{_LARGEST_LOGARITHM} to {_LARGEST_LOGARITHM}, "
                f"got {shown(getattr(options, name))}"
            )
    separation = getattr(options, "separation", None)
    if separation is not None and not 0.0 < separation < math.inf:
        raise ValueError(f"hyperparameter separation must be finite and > 0 m, got {shown(separation)}")
    if options.episode_steps is not None and options.episode_steps < 1:
        raise ValueError(f"hyperparameter episode_steps must be >= 1, got {shown(options.episode_steps)}")
    if not options.net_arch or min(options.net_arch) < 1:
        raise ValueError(
            f"hyperparameter net_arch needs at least one layer, of widths >= 1: {options.net_arch!r}"
        )
