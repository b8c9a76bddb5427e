"""The training algorithms by name. One is a generator; everything around it is in `runs`.

    train(task_options, options, seed, spent, start=None) -> Training

`task_options` are the TrackingOptions or team options of the environment, `options` the algorithm's
hyperparameters (a frozen dataclass), `seed` that of everything random, `spent()` the share of the budget that
is used up, 0 to 1: the generator ends at 1, and yields after each update how far it is and the network.
`start` is a network to go on from, for --resume; a generator without this argument cannot be resumed.
`check(task_options, options, start)` in its module, if there is one, refuses what the generator would, before
anything is written.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, NamedTuple

from quad_envs.arguments.extras import install_command
from quad_envs.arguments.names import unknown_name

from ..errors import MissingPackageError
from .algorithm_options import (
    DaggerOptions,
    MappoOptions,
    PolicyGradientOptions,
    PpoLagrangianOptions,
    PpoOptions,
    SacOptions,
)

if TYPE_CHECKING:
    from .held_out import Training

TRACKING, FORMATION, TARGET, ESTIMATION = "tracking", "formation", "target-tracking", "estimation"


class Algorithm(NamedTuple):
    """A row of the registry."""

    module: str
    generator: str  # name in the module
    options: type[Any]  # the dataclass of its hyperparameters
    kind: str  # what it knows: "model-free", "imitation" or "model-based"
    missions: tuple[str, ...]  # on which tasks it can act
    description: str
    seconds: float = 60.0  # default budget, CPU-seconds
    packages: tuple[str, ...] = ("torch",)  # modules that it imports
    steps_per_second: float = (
        45_000.0  # of the environments in a CPU-second, about: for estimates of time alone
    )
    elsewhere: str = ""  # what to do where it cannot act, after a semicolon


_SB3 = ("torch", "stable_baselines3")
ALGORITHMS: dict[str, Algorithm] = {
    "apg": Algorithm(
        ".policy_gradient",
        "train",
        PolicyGradientOptions,
        "model-based",
        (TRACKING, FORMATION, TARGET),
        "analytic policy gradient through the compiled dynamics",
    ),
    "dagger": Algorithm(
        ".imitation",
        "train",
        DaggerOptions,
        "imitation",
        (TRACKING, FORMATION, TARGET),
        "imitation of an MPC, labelled where the network flies",
        15.0,
        steps_per_second=4_000.0,
    ),
    "mappo": Algorithm(
        ".central_critic",
        "train",
        MappoOptions,
        "model-free",
        (FORMATION, TARGET),
        "proximal policy optimisation with a critic that sees the whole team",
        150.0,
        _SB3,
        steps_per_second=37_000.0,
        elsewhere="its critic sees the state() of a team, which one vehicle has not: take ppo",
    ),
    "ppo": Algorithm(
        ".sb3",
        "train_ppo",
        PpoOptions,
        "model-free",
        (TRACKING, FORMATION, TARGET),
        "proximal policy optimisation on the shared reward",
        150.0,
        _SB3,
    ),
    "ppo-lagrangian": Algorithm(
        ".sb3",
        "train_ppo_lagrangian",
        PpoLagrangianOptions,
        "model-free",
        (TRACKING, FORMATION, TARGET),
        "the same, with a multiplier that holds the share of violating steps under a limit",
        150.0,
        _SB3,
    ),
    "sac": Algorithm(
        ".sb3",
        "train_sac",
        SacOptions,
        "model-free",
        (TRACKING,),
        "soft actor-critic on the shared reward",
        150.0,
        _SB3,
    ),
}


def algorithm_for(name: str, mission: str) -> Algorithm:
    """The row of an algorithm that has to act on a kind of task.

    Raises:
        ValueError: If there is no such algorithm, or it cannot act there; it names those that can.
    """
    if name not in ALGORITHMS:
        raise ValueError(unknown_name("training algorithm", name, ALGORITHMS))
    able = [key for key, entry in ALGORITHMS.items() if mission in entry.missions]
    if name not in able:
        serves = " and ".join(ALGORITHMS[name].missions)
        raise ValueError(
            f"algorithm {name!r} trains on {serves} tasks, not on {mission}; those that can act there: "
            f"{', '.join(able) if able else 'none, its agents estimate and do not fly'}"
            f"{f'; {ALGORITHMS[name].elsewhere}' if able and ALGORITHMS[name].elsewhere else ''}"
        )
    return ALGORITHMS[name]


def require_packages(name: str) -> None:
    """Check that what an algorithm imports is installed.

    Raises:
        MissingPackageError: If not; the message names the extra.
    """
    missing = [package for package in ALGORITHMS[name].packages if find_spec(package) is None]
    if missing:
        verb = "is" if len(missing) == 1 else "are"
        raise MissingPackageError(
            f"training with {name!r} needs {' and '.join(missing)}, which {verb} not installed: "
            f"{install_command('rl')}. Trained policies fly without."
        )


def generator_of(name: str) -> Callable[..., Training]:
    """The generator function of an algorithm."""
    entry = ALGORITHMS[name]
    found: Callable[..., Training] = getattr(import_module(entry.module, __package__), entry.generator)
    return found


def check_training(name: str, task_options: Any, options: Any, start: Any) -> None:
    """Refuse what an algorithm would refuse once it trains, as far as it can tell before.

    Args:
        name: Of the algorithm.
        task_options: Of the environment.
        options: Hyperparameters.
        start: Network to go on from, or None.

    Raises:
        ValueError: If it would.
    """
    check = getattr(import_module(ALGORITHMS[name].module, __package__), "check", None)
    if check is not None:
        check(task_options, options, start)


def options_of(name: str) -> type[Any]:
    """The dataclass of an algorithm's hyperparameters."""
    return ALGORITHMS[name].options


def resumable(name: str) -> bool:
    """Whether an algorithm can go on from a network."""
    return "start" in inspect.signature(generator_of(name)).parameters


def require_resumable(name: str) -> None:
    """Check that an algorithm can go on from a network.

    Raises:
        ValueError: If not.
    """
    if not resumable(name):
        raise ValueError(
            f"{name!r} cannot go on from a saved network: its critic and its data are not saved; "
            "train anew with a larger budget (--fresh)"
        )
