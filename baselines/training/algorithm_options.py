"""Hyperparameters of each algorithm, as values: reading them loads no torch."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

from quad_envs.checks import require_memory, require_whole
from quad_envs.names import shown

if TYPE_CHECKING:
    from ..policies.network import Squash

_POSITIVE = (
    *("rows", "horizon", "batch", "epochs", "learning_rate", "final_rate", "discount", "clip"),
    *("gradient_norm", "gradient_steps", "memory", "smoothing", "probes"),
)
# Hyperparameters that take memory or time, and the largest that make sense.
_MOST = {
    **dict.fromkeys(("rows", "flights", "probes"), 100_000),
    **dict.fromkeys(("horizon", "final_horizon", "window"), 10_000),
    **dict.fromkeys(("epochs", "gradient_steps", "substeps"), 1_000),
    **dict.fromkeys(("fits", "final_fits", "critic_updates", "episode_steps"), 1_000_000),
    "batch": 10_000_000,
    "memory": 100_000_000,
    "warm_up": 1_000_000_000,
}
_MAY_BE_NONE = ("fits", "final_fits", "critic_updates", "warm_up")
_WIDEST, _MOST_LAYERS = 10_000, 20
_SHARES = ("free", "final_rate", "discount", "trace", "smoothing")


@dataclass(frozen=True, slots=True)
class PolicyGradientOptions:
    """Hyperparameters of the analytic policy gradient."""

    flights: int = 64
    horizon: int = 25  # steps of a window at the beginning
    final_horizon: int = 25  # and at the end; long windows see more of what follows, but learn late
    substeps: int = 2  # of the integrator while training; 5 in evaluation
    learning_rate: float = 1e-2
    final_rate: float = 0.03  # share of the learning rate at the end of the budget
    discount: float = 0.99
    epsilon: float = 1e-3  # of log(r + epsilon), at the beginning
    final_epsilon: float = 1e-3  # and at the end; the larger, the more it is the sum of rewards itself
    penalty: float = 0.0  # weight of the violation cost in the objective
    hidden: tuple[int, ...] = (64, 64)
    gradient_norm: float = 1.0  # to which gradients are clipped


@dataclass(frozen=True, slots=True)
class DaggerOptions:
    """Hyperparameters of DAgger."""

    expert: str = ""  # a policy, or a trained one; sdc-nmpc for one vehicle, consensus-mpc for formations
    rows: int = 64  # flights, or vehicles of all teams
    window: int = 20  # steps of each row between fits
    expert_flies: float = 0.2  # share of the budget in which the rows that the expert flies fall to none
    fits: int = 40  # minibatches after each window at the beginning
    final_fits: int = 200  # and at the end of the budget, when there are many labels
    batch: int = 512
    learning_rate: float = 3e-3
    final_rate: float = 0.02  # share of the learning rate at the end of the budget
    threshold: float = 0.05  # of an output's error, up to which the loss is quadratic
    hidden: tuple[int, ...] = (64, 64)
    squash: Squash = "tanh"  # how outputs come into [-1, 1]; "clip" as PPO, which can then go on from here
    stages: tuple[int, ...] | None = None  # of the preview that the network sees; None for the usual ones
    separation: float | None = None  # m, that the expert of a team keeps; None for the task's own
    episode_steps: int | None = None  # of a team's flight in training; None for the task's own


@dataclass(frozen=True, slots=True)
class PpoOptions:
    """Hyperparameters of PPO."""

    rows: int = 512  # flights, or vehicles of all teams
    horizon: int = 32  # steps of each row in an update
    batch: int = 4096
    epochs: int = 5
    learning_rate: float = 1e-3
    final_rate: float = 0.05  # share of the learning rate at the end of the budget
    discount: float = 0.99
    trace: float = 0.98  # lambda of the advantage estimate
    clip: float = 0.2  # of the ratio of probabilities
    log_std: float = -2.0  # at the start
    entropy: float = 0.0  # weight of the entropy bonus
    gradient_norm: float = 0.5  # to which gradients are clipped
    hidden: tuple[int, ...] = (64, 64)
    stages: tuple[int, ...] | None = None  # of the preview that the network sees; None for the usual ones
    episode_steps: int | None = None  # of a flight in training; None for the task's own
    critic_updates: int = 5  # of the critic alone, where training goes on from a policy

    def __post_init__(self) -> None:
        _check_numbers(self)


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

    rows: int = 64
    gradient_steps: int = 4  # for each step of all rows
    batch: int = 256
    memory: int = 500_000  # steps in the replay buffer
    warm_up: int = 5_000  # steps of random actions
    learning_rate: float = 1e-3
    final_rate: float = 0.1  # share of the learning rate at the end of the budget
    discount: float = 0.98
    smoothing: float = 0.01  # of the target critics
    hidden: tuple[int, ...] = (64, 64)
    stages: tuple[int, ...] | None = None  # of the preview that the network sees; None for the usual ones
    episode_steps: int | None = None  # of a flight in training; None for the task's own
    horizon: int = 64  # steps of each row between two reports

    def __post_init__(self) -> None:
        _check_numbers(self)


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
            require_whole(f"hyperparameter {one.name}", value, least, most, lambda n: 4 * n * width)
    hidden = options.hidden
    if len(hidden) > _MOST_LAYERS:
        raise ValueError(f"hyperparameter hidden has at most {_MOST_LAYERS} layers, got {shown(hidden)}")
    for n in hidden:
        require_whole("a layer of hyperparameter hidden", n, 1, _WIDEST, lambda n: 4 * n * (n + width))
    rows = getattr(options, "rows", getattr(options, "flights", 1))
    stages = getattr(options, "horizon", getattr(options, "window", 1))
    kept = rows * stages + 2 * getattr(options, "memory", 0)
    require_memory(
        f"training with {kept} observations of {width} numbers at a time",
        4 * kept * width,
        "lower the hyperparameters rows, horizon or memory",
    )


def _check_numbers(options: PpoOptions | SacOptions) -> None:
    """Refuse hyperparameters that make no sense.

    Raises:
        ValueError: If there is one; the message names it.
    """
    for name in {field.name for field in fields(options)} & {*_POSITIVE, *_SHARES}:
        value = getattr(options, name)
        if not 0.0 <= value < math.inf or (name in _POSITIVE and value == 0.0):
            raise ValueError(f"hyperparameter {name} must be finite and positive, got {shown(value)}")
        if name in _SHARES and value > 1.0:
            raise ValueError(f"hyperparameter {name} must be at most 1, got {shown(value)}")
    if options.episode_steps is not None and options.episode_steps < 1:
        raise ValueError(f"hyperparameter episode_steps must be >= 1, got {shown(options.episode_steps)}")
    if not options.hidden or min(options.hidden) < 1:
        raise ValueError(
            f"hyperparameter hidden needs at least one layer, of widths >= 1: {options.hidden!r}"
        )
