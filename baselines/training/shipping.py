"""Shipped policies: `python -m baselines.training.shipping RUN ...` copies networks of runs into the suite.

A shipped policy is a checkpoint with the command, seed, versions and revision that made it, its learning
curve, and its score on starts that neither training nor the choice of the best network has seen.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from ..files import read_json
from ..policies.checkpoints import load_checkpoint, save_checkpoint
from ..policies.trained import SHIPPED
from .held_out import HELD_OUT, HeldOutFlights, Point, Progress

_SAID = (
    *("env_id", "env_kwargs", "mission", "algorithm", "kind", "seed", "hyperparameters", "made_by", "budget"),
    *("cpu_seconds", "steps", "updates"),
)


def shipped_folder(env_id: str, algorithm: str) -> Path:
    """Where the policy of an algorithm for a task goes, as policies/ppo-helix."""
    task = env_id.rsplit("/", 1)[-1].removesuffix("-v0").removesuffix("Tracking")
    return SHIPPED / f"{algorithm}-{task.lower()}"


def judged(network_folder: Path) -> Point:
    """The network of a checkpoint on held-out starts of the task on which it was trained."""
    network, said = load_checkpoint(network_folder)
    flights = HeldOutFlights(said["env_id"], said["env_kwargs"])
    spent = Progress(said["updates"], said["steps"], float("nan"))
    return flights.judge(network, said["cpu_seconds"], spent, HELD_OUT)


def ship(run: Path) -> Path:
    """Copy the best network of a run into the suite.

    Args:
        run: Folder of a training.

    Returns:
        Where it is now.

    Raises:
        CheckpointError: If it holds no checkpoint, or the suite's folder cannot be written.
    """
    network, said = load_checkpoint(run)
    folder, point = shipped_folder(said["env_id"], said["algorithm"]), judged(run)
    about = {name: said[name] for name in _SAID} | {
        "score": point.score,
        "violation_share": point.violation_share,
        "crashes": point.crashes,
        "starts": {"seed": HELD_OUT, "flights": point.flights},
        "git_revision": read_json(run / "config.json")["git_revision"],
        "versions": said["versions"],
    }
    save_checkpoint(folder, network, about)
    shutil.copyfile(run / "curve.csv", folder / "curve.csv")
    return folder


if __name__ == "__main__":
    for name in sys.argv[1:]:
        where = ship(Path(name))
        print(f"{name} -> {where.name}: score {judged(where).score:.4f}")
