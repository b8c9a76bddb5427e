"""Trained networks as policies: the folder of a training run, or a shipped one by its name."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quad_envs.arguments.checks import require_path
from quad_envs.arguments.names import shown, unknown_name

from ..errors import CheckpointError

if TYPE_CHECKING:  # not at run time: tasks load numba, and `quad-envs list` has to be quick
    from quad_envs.tasks import BaseTask

    from .network import NetworkPolicy
    from .network_policies import EstimatingPolicy

SHIPPED = Path(__file__).parent / "shipped"  # one checkpoint per folder, as "apg-helix"
_DESCRIPTION = "policy.json"
_TOLD = ("env_id", "env_kwargs", "algorithm", "kind", "score")


def shipped_policies() -> dict[str, str]:
    """Name -> what it is, of the trained policies that come with the suite; loads none of them."""
    return {path.parent.name: _describe(path) for path in sorted(SHIPPED.glob(f"*/{_DESCRIPTION}"))}


def describe_shipped(name: str) -> dict[str, Any]:
    """How a shipped policy was made, and where: what its description says, without layers and features."""
    said = json.loads((SHIPPED / name / _DESCRIPTION).read_text(encoding="utf-8"))
    return {key: said[key] for key in _TOLD if key in said}


def describe_folder(folder: str) -> dict[str, Any]:
    """The same of the policy in a folder, which is a tuned one or a checkpoint.

    Raises:
        CheckpointError: If it is neither.
    """
    from .checkpoints import load_checkpoint
    from .tuned import describe_tuned, names_tuned

    if names_tuned(folder):
        return describe_tuned(folder)
    said = load_checkpoint(folder)[1]
    return {key: said[key] for key in _TOLD if key in said}


def _describe(path: Path) -> str:
    said = json.loads(path.read_text(encoding="utf-8"))
    where = " with other ".join(filter(None, (said["env_id"], ", ".join(said.get("env_kwargs", {})))))
    return f"{said['algorithm']} ({said['kind']}) on {where}, score {said['score']:.3f}"


@cache
def _shipped_for() -> dict[tuple[str, str], str]:
    """(algorithm, environment id) -> name, of those that were trained for this task alone."""
    files = SHIPPED.glob(f"*/{_DESCRIPTION}")
    said = {path.parent.name: json.loads(path.read_text("utf-8")) for path in files}
    pairs = {name: (entry["algorithm"], entry["env_id"]) for name, entry in sorted(said.items())}
    return {pair: name for name, pair in pairs.items() if name == name_for(*pair)}


def name_for(algorithm: str, env_id: str) -> str:
    """What the shipped policy of an algorithm for a task alone is called, as "ppo-helix"."""
    task = env_id.rsplit("/", 1)[-1].removesuffix("-v0").removesuffix("Tracking")
    return f"{algorithm}-{task.lower()}"


def shipped_for(env_id: str) -> list[str]:
    """Names of the shipped policies for a task."""
    return [name for (_, task), name in _shipped_for().items() if task == env_id]


def shipped_name(algorithm: str, env_id: str) -> str:
    """Name of the shipped policy of an algorithm for a task.

    Raises:
        ValueError: If none is shipped.
    """
    known, env_id = _shipped_for(), env_id.removeprefix("quad_envs:")
    if (algorithm, env_id) not in known:
        tasks = [task for name, task in known if name == algorithm]
        raise ValueError(
            f"no policy of {algorithm!r} is shipped for {env_id}; there are some for: "
            f"{', '.join(tasks) if tasks else 'no task'}"
        )
    return known[algorithm, env_id]


def shipped_kind(name: str) -> str:
    """What a shipped policy knows, as "model-based"; empty if none is called so."""
    if not _is_shipped(name):
        return ""
    return str(json.loads((SHIPPED / name / _DESCRIPTION).read_text(encoding="utf-8"))["kind"])


def names_trained(name: str | os.PathLike[str]) -> bool:
    """Whether a name can only be a trained policy: a path, something on disk, or a shipped name."""
    text = os.fspath(name)
    return (
        isinstance(name, os.PathLike)
        or os.sep in text
        or "/" in text
        or _is_shipped(text)
        or os.path.exists(text)  # which a name that is too long does not
    )


def _is_shipped(name: str) -> bool:
    return os.path.isfile(SHIPPED / name / _DESCRIPTION)


def load_policy(source: str | os.PathLike[str], env: Any) -> NetworkPolicy | EstimatingPolicy:
    """A trained network as a policy; no code of the checkpoint runs, and no torch is needed.

    Args:
        source: The folder of a training run or checkpoint, or a name of `shipped_policies`.
        env: As for `make_policy`: where it is to fly.

    Raises:
        CheckpointError: If it is no checkpoint of this version, or was trained on another kind of task.
    """
    from .checkpoints import load_checkpoint
    from .environments import task_of
    from .network_policies import network_policy

    folder = checkpoint_folder(source)
    network, said = load_checkpoint(folder)
    task = task_of(env)
    where, mission = f"checkpoint {str(folder)!r}", said.get("mission")
    if mission is not None and mission != task.mission:
        raise CheckpointError(
            f"{where} was trained on {shown(said.get('env_id'))}, a task of the kind {shown(mission)}; "
            f"{task.env_id} is one of {task.mission}: train one for it with quad-envs train {task.env_id}"
        )
    require_sensor(where, said, task)
    name = os.fspath(source) if folder.parent == SHIPPED else folder.name or str(folder)
    try:
        return network_policy(network, task, name, str(said.get("kind", "")))
    except ValueError as error:
        made = f", trained on {shown(said['env_id'])}," if "env_id" in said else ""
        raise CheckpointError(f"{where}{made} does not fit {task.env_id}: {error}") from error


def require_sensor(where: str, said: Mapping[str, Any], task: BaseTask) -> None:
    """Check that a network flies, or learns on, with the sensor with which it was trained.

    Args:
        where: What to call the network.
        said: Its description.
        task: Where it is to fly; of one without a target nothing is asked.

    Raises:
        CheckpointError: If it was another one.
    """
    from quad_envs.sensors import DEFAULT_SENSOR
    from quad_envs.tasks import TeamTask

    if not (isinstance(task, TeamTask) and task.layout.target):
        return
    given = said.get("env_kwargs", {})
    trained = given.get("sensor", DEFAULT_SENSOR) if isinstance(given, Mapping) else task.sensor
    if trained != task.sensor:
        raise CheckpointError(
            f"{where} was trained with the sensor {shown(trained)}, and {task.env_id} has {task.sensor!r} "
            f"here: pass sensor={trained!r}, or train one with quad-envs train {task.env_id} --set "
            f"sensor={task.sensor}"
        )


def checkpoint_folder(source: str | os.PathLike[str]) -> Path:
    """Where a checkpoint is.

    Args:
        source: Its folder, or a name of `shipped_policies`.

    Raises:
        CheckpointError: If there is none.
        ValueError: If it is no path.
    """
    require_path("a checkpoint", source)
    text = os.fspath(source)
    if not isinstance(source, os.PathLike) and _is_shipped(text):
        return SHIPPED / text
    path = Path(text)
    if os.path.isfile(path):
        raise CheckpointError(
            f"{text!r} is a file; a trained policy is a folder with network.safetensors and {_DESCRIPTION}. "
            "Zips of Stable-Baselines3 and .pt files of torch are pickles, which are never opened: quad-envs "
            f"export {shlex.quote(text)} FOLDER makes a checkpoint of a zip, baselines.export_policy of a "
            "torch module; a policy of your own in a .py file is named module:factory, as mypolicy:make"
        )
    if not os.path.isdir(path):
        shipped = unknown_name("trained policy", text, shipped_policies())
        raise CheckpointError(f"there is no folder {shown(text, 200)}, and it is not shipped: {shipped}")
    return path
