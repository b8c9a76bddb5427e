"""The folder of a training run.

network.safetensors, policy.json    the best policy, so that the folder itself is a checkpoint
last/                               the last policy, from which --resume goes on
curve.csv                           one row per evaluation
config.json                         task, algorithm, seed, hyperparameters, versions, revision, command
tensorboard/                        its log, where TensorBoard is installed
"""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..errors import ResultsError
from ..files import plain_json, provenance, read_json, write_atomic, write_csv
from ..policies.checkpoints import DESCRIPTION, WEIGHTS, load_checkpoint, save_checkpoint
from ..policies.network import Network
from .held_out import Point, read_point
from .hyperparameters import recorded_hyperparameters

_IDENTITY = ("env_id", "env_kwargs", "algorithm", "seed", "hyperparameters")  # a resumed run must agree
_ORIGIN = "start_from"  # and this, which older runs do not say
_FILES = (WEIGHTS, DESCRIPTION, "curve.csv", "config.json")


class RunFolder:
    """Writes and reads the folder of a run. Use it under `results.locked`.

    Args:
        path: The folder.
        about: Task, algorithm, seed and hyperparameters, as in config.json.
    """

    def __init__(self, path: Path, about: Mapping[str, Any]) -> None:
        self.path, self.about = path, dict(about)

    @property
    def last(self) -> Path:
        """Where the last policy is."""
        return self.path / "last"

    def begin(self, fresh: bool) -> None:
        """Make the folder ready for a new run.

        Raises:
            ResultsError: If it holds an earlier run and `fresh` is False, or files that no training wrote.
        """
        found = self._config()
        if found is None:
            foreign = [name for name in _FILES if (self.path / name).exists()]
            if foreign:
                raise ResultsError(
                    f"{str(self.path)!r} holds a {foreign[0]} that no training has written; choose another "
                    "folder, or move it away"
                )
        elif not fresh and any((place / WEIGHTS).exists() for place in (self.last, self.path)):
            raise ResultsError(
                f"{str(self.path)!r} holds a training of {found['algorithm']} on {found['env_id']}, seed "
                f"{found['seed']}: go on with it (--resume), discard it (--fresh), or choose another folder"
            )
        else:
            # First what --resume would go on from, and config.json in the end: it says whose the others are.
            for name in (f"{self.last.name}/{WEIGHTS}", *_FILES[:-1]):
                (self.path / name).unlink(missing_ok=True)
            for name in (self.last.name, "tensorboard"):
                shutil.rmtree(self.path / name, ignore_errors=True)
            (self.path / _FILES[-1]).unlink(missing_ok=True)
        self.write_config([])

    def has_policy(self) -> bool:
        """Whether there is something to go on from: a run that ended before its first policy begins anew.

        Raises:
            ResultsError: If there is no run.
        """
        if self._config() is None:
            raise ResultsError(
                f"{str(self.path)!r} holds no training that could be resumed; leave --resume out"
            )
        return (self.last / WEIGHTS).exists()

    def read(self) -> tuple[Network, dict[str, Any], list[Point]]:
        """The last network, what policy.json says of it, and the curve so far.

        Raises:
            ResultsError: If there is no run, or it is another one.
            CheckpointError: If its last policy cannot be read.
        """
        found = self._config()
        if found is None:
            raise ResultsError(
                f"{str(self.path)!r} holds no training that could be resumed; leave --resume out"
            )
        recorded = recorded_hyperparameters(found["algorithm"], found["hyperparameters"])
        asked, found = plain_json(self.about), {**found, "hyperparameters": recorded}
        differing = [name for name in (*_IDENTITY, _ORIGIN) if found.get(name) != asked.get(name)]
        if differing:
            name = differing[0]
            raise ResultsError(
                f"{str(self.path)!r} holds another training: its {name} is {json.dumps(found.get(name))}, "
                f"asked for is {json.dumps(asked.get(name))}; give the same, or choose another folder"
            )
        network, described = load_checkpoint(self.last)
        return network, described, self.read_curve()

    def mend(self, curve: Sequence[Point]) -> None:
        """Make best policy and curve what the last policy says: a session may have ended between these files.

        Args:
            curve: Up to the last policy.
        """
        for place in (self.path, self.last):
            for name in (WEIGHTS, DESCRIPTION):
                (place / f"{name}.new").unlink(missing_ok=True)
        network, said = load_checkpoint(self.last)
        if said["best"]["updates"] == said["updates"]:
            save_checkpoint(self.path, network, said)
        self.write_curve(curve)

    def note_session(self) -> None:
        """Say in config.json that the run goes on, by which command."""
        found = self._config() or {}
        self.write_config([*found.get("commands", []), found.get("command")])

    def save_best(self, network: Network, about: Mapping[str, Any]) -> None:
        """Write the best policy."""
        save_checkpoint(self.path, network, {**plain_json(self.about), **plain_json(about)})

    def save_last(self, network: Network, about: Mapping[str, Any]) -> None:
        """Write the last policy."""
        save_checkpoint(self.last, network, {**plain_json(self.about), **plain_json(about)})

    def write_curve(self, points: Sequence[Point]) -> None:
        """Write the whole curve."""
        if points:
            write_csv(self.path / "curve.csv", [point._asdict() for point in points])

    def read_curve(self) -> list[Point]:
        """The curve so far; empty if there is none."""
        path = self.path / "curve.csv"
        points: list[Point] = []
        unreadable = (FileNotFoundError, ValueError, TypeError, KeyError, csv.Error)
        with suppress(*unreadable), open(path, newline="") as file:
            points.extend(map(read_point, csv.DictReader(file)))
        return points

    def write_config(self, commands: Sequence[Any]) -> None:
        """Write config.json; `commands` are those of earlier sessions of this run."""
        found = {"training": 1, **plain_json(self.about), **provenance(), "commands": list(commands)}
        write_atomic(self.path / "config.json", (json.dumps(found, indent=1) + "\n").encode())

    def _config(self) -> dict[str, Any] | None:
        path = self.path / "config.json"
        if not path.exists():
            return None
        found = read_json(path)
        if isinstance(found, dict) and found.get("training") and all(name in found for name in _IDENTITY):
            if isinstance(found["hyperparameters"], dict):
                return found
        raise ResultsError(
            f"{str(self.path)!r} holds a config.json that no training has written; choose another folder"
        )
