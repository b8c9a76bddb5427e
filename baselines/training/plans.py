"""What a training is to be, checked before anything is written; and how far one in a folder is."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from quad_envs.arguments.kinds import is_whole
from quad_envs.arguments.names import shown
from quad_envs.tasks import Task, TeamTask

from ..errors import CheckpointError, ResultsError
from ..policies.checkpoints import load_checkpoint
from ..policies.network import Network
from ..policies.trained import checkpoint_folder, require_sensor
from ..policies.tuned import names_tuned
from .algorithm_options import check_sizes
from .algorithms import algorithm_for, check_training, require_packages, require_resumable
from .beginning import with_estimate_inputs
from .clock import Budget
from .held_out import Point, read_point, training_options
from .hyperparameters import hyperparameters, plain_options
from .request import TrainingRequest
from .run_folder import RunFolder

_ORIGIN = ("env_id", "algorithm", "seed", "steps", "digest")  # what is said of a network to begin with
_SEEDS = 5_000  # training seeds lie below; rows of a vector environment count on from there


@dataclass(frozen=True, slots=True)
class Plan:
    """A training that can be done. `make_plan` makes it."""

    env_id: str
    env_kwargs: dict[str, Any]
    algorithm: str
    seed: int
    budget: Budget
    task_options: Any  # TrackingOptions or options of a team
    options: Any  # hyperparameters
    about: dict[str, Any]  # as config.json says it
    network: Network | None = None  # to begin with

    def folder(self, path: Path) -> RunFolder:
        """The folder of the run."""
        return RunFolder(path, self.about)


class Start(NamedTuple):
    """From where a training goes on; all zero for a new one."""

    network: Network | None = None
    seconds: float = 0.0
    steps: int = 0
    updates: int = 0
    resumed: int = 0  # times
    curve: tuple[Point, ...] = ()
    best: Point | None = None


def make_plan(request: TrainingRequest) -> Plan:
    """What is asked for, checked.

    Raises:
        ValueError: If an argument is not allowed or the algorithm cannot act on the task.
        MissingPackageError: If what the algorithm needs is not installed.
        CheckpointError: If there is no checkpoint where it is to begin.
    """
    env_id, algorithm = request.env_id, request.algorithm
    if not is_whole(request.seed) or not 0 <= request.seed < _SEEDS:
        raise ValueError(
            f"seed of a training must be a whole number, 0 to {_SEEDS - 1}, got {shown(request.seed)}; later "
            "ones are held out for evaluation"
        )
    seed = int(request.seed)
    kwargs = dict(request.env_kwargs or {})
    task_options = training_options(env_id, kwargs)
    mission = task_options.task.mission
    entry = algorithm_for(algorithm, mission)
    seconds = entry.seconds if request.seconds is None and request.steps is None else request.seconds
    budget = Budget(seconds, request.steps)
    require_packages(algorithm)
    env_id = env_id.removeprefix("quad_envs:")
    options = hyperparameters(algorithm, env_id, request.hyper)
    check_sizes(options, task_options.task.layout.size)
    source = request.start_from
    network, origin = (None, None) if source is None else _origin(source, algorithm, task_options.task)
    if network is not None and getattr(options, "disturbance_estimate", False):
        network = with_estimate_inputs(network, task_options.task)
    check_training(algorithm, task_options, options, network)
    made_by = replace(request, env_id=env_id, seconds=budget.seconds, out=None, resume=False)
    about = {
        "env_id": env_id,
        "env_kwargs": {key: value if _is_plain(value) else repr(value) for key, value in kwargs.items()},
        "mission": mission,
        "algorithm": algorithm,
        "kind": entry.kind,
        "seed": seed,
        "hyperparameters": plain_options(options),
        "start_from": origin,
        "made_by": made_by.command,
    }
    return Plan(env_id, kwargs, algorithm, seed, budget, task_options, options, about, network)


def _origin(source: str | Path, algorithm: str, task: Task | TeamTask) -> tuple[Network, dict[str, Any]]:
    """The network to begin with, and what made it."""
    require_resumable(algorithm)
    if names_tuned(source):
        raise CheckpointError(
            f"{os.fspath(source)!r} is a tuned policy, which has no network to begin with: name the folder "
            "of a training, or a shipped network"
        )
    network, said = load_checkpoint(checkpoint_folder(source))
    mission = said.get("mission")
    if mission is not None and mission != task.mission:
        raise CheckpointError(
            f"{os.fspath(source)!r} was trained on {shown(said.get('env_id'))}, a task of the kind "
            f"{shown(mission)}, and no training on {task.env_id}, one of {task.mission}, can go on from it: "
            "begin with a network of the same kind"
        )
    require_sensor(repr(os.fspath(source)), said, task)
    return network, {name: said[name] for name in _ORIGIN if name in said}


def _is_plain(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    if isinstance(value, dict):
        return all(map(_is_plain, value.values()))
    return value is None or isinstance(value, str | int | float)


def read_start(folder: RunFolder) -> Start:
    """Where the run in a folder stands.

    Raises:
        ResultsError: If there is no run, it is another one, or it does not say how far it was.
        CheckpointError: If its last policy cannot be read.
    """
    network, said, curve = folder.read()
    try:
        point = read_point(said)
        if not curve or curve[-1].updates < point.updates:  # a session that ended between these two files
            curve.append(point)
        return Start(
            network,
            float(said["cpu_seconds"]),
            int(said["steps"]),
            int(said["updates"]),
            int(said["resumed"]) + 1,
            tuple(curve),
            read_point(said["best"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ResultsError(
            f"{str(folder.last)!r} does not say how far the training was: {error!r}"
        ) from error
