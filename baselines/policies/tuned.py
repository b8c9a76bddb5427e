"""Tuned policies: a folder whose tuned.json names a policy and its options, for `make_policy` to make."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from quad_envs.arguments.names import shown

from ..errors import CheckpointError
from ..files import plain_json, write_atomic

if TYPE_CHECKING:  # not at run time: tasks load numba
    from quad_envs.tasks import BaseTask

DESCRIPTION = "tuned.json"
FORMAT = 1
_TOLD = ("env_id", "env_kwargs", "policy", "options", "vehicle", "objective", "score")


class TunedPolicy(NamedTuple):
    """What a folder says of a tuned policy."""

    policy: str  # a name of `make_policy`
    options: dict[str, Any]
    env_id: str  # of the task for which it was tuned
    vehicle: dict[str, Any]  # parameters of the vehicle


def names_tuned(name: str | os.PathLike[str]) -> bool:
    """Whether a name is the folder of a tuned policy."""
    return os.path.isfile(os.path.join(name, DESCRIPTION))


def vehicle_of(task: BaseTask) -> dict[str, Any]:
    """The parameters of a task's vehicle as JSON has them."""
    found: dict[str, Any] = plain_json(asdict(task.params))
    return found


def write_tuned(folder: Path, tuned: TunedPolicy, about: Mapping[str, Any]) -> None:
    """Write tuned.json, whole or not at all.

    Args:
        folder: Made if need be.
        tuned: The policy.
        about: What else to say: score, budget, versions, ...

    Raises:
        ResultsError: If it cannot be written.
    """
    said = {"format": FORMAT, **plain_json(tuned._asdict()), **plain_json(about)}
    write_atomic(folder / DESCRIPTION, (json.dumps(said, indent=1) + "\n").encode())


def read_tuned(folder: str | os.PathLike[str], task: BaseTask) -> TunedPolicy:
    """Read the folder of a tuned policy, for a task.

    Raises:
        CheckpointError: If it is none, or was tuned for another task or vehicle.
    """
    where = f"tuned policy {os.fspath(folder)!r}"
    found, _ = _read(folder, where)
    again = f"tune one for it: quad-envs tune {task.env_id} {found.policy}"
    if found.env_id != task.env_id:
        raise CheckpointError(f"{where} is for {found.env_id}, not for {task.env_id}; {again}")
    here = vehicle_of(task)
    other = [name for name, value in here.items() if found.vehicle.get(name) != value]
    if other:
        name = other[0]
        raise CheckpointError(
            f"{where} is for another vehicle: its {name} is {shown(found.vehicle.get(name))}, here "
            f"{shown(here[name])}; {again} with this vehicle"
        )
    return found


def describe_tuned(folder: str | os.PathLike[str]) -> dict[str, Any]:
    """How a tuned policy was found, and where: what its description says that matters to who flies it.

    Raises:
        CheckpointError: If it cannot be read.
    """
    _, said = _read(folder, f"tuned policy {os.fspath(folder)!r}")
    return {key: said[key] for key in _TOLD if key in said}


def _read(folder: str | os.PathLike[str], where: str) -> tuple[TunedPolicy, dict[str, Any]]:
    """A tuned policy, and the whole of its description."""
    try:
        said = json.loads(Path(folder, DESCRIPTION).read_text(encoding="utf-8"))
        if said["format"] != FORMAT:
            raise ValueError(f"format {shown(said['format'])}, this version reads {FORMAT}")
        found = TunedPolicy(
            str(said["policy"]), dict(said["options"]), str(said["env_id"]), dict(said["vehicle"])
        )
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise CheckpointError(
            f"{where}: cannot read {DESCRIPTION} ({error!r}); tune again with quad-envs tune"
        ) from error
    return found, said
