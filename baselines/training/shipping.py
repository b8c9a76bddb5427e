"""Shipped policies: `python -m baselines.training.shipping RUN ...` copies networks of runs into the suite.

`--best NAME` copies one of them, that crashes least and then scores most on starts that choose, as NAME. A
shipped policy is a checkpoint with the command, seed, versions and revision that made it, its learning curve,
and its score on starts that neither training nor the choice of the best network has seen: of a team on many,
with the interval over whole teams, since five teams are few and their vehicles are not independent.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from quad_envs.registration import TEAMS

from ..files import read_json
from ..policies.checkpoints import load_checkpoint, save_checkpoint
from ..policies.network_policies import network_policy
from ..policies.trained import SHIPPED, name_for
from .held_out import CHOOSING, HELD_OUT, HeldOutFlights, Point, Progress

_CHOOSING_FLIGHTS = 500  # among runs; while training fewer choose among the networks of one
_MANY_FLIGHTS = 100  # that tell of a team
_SAID = (
    *("env_id", "env_kwargs", "mission", "algorithm", "kind", "seed", "hyperparameters", "made_by", "budget"),
    *("cpu_seconds", "steps", "updates"),
)


def judged(network_folder: Path, seed: int = HELD_OUT, flights: int | None = None) -> Point:
    """The network of a checkpoint in the task on which it was trained, under its conditions.

    Args:
        network_folder: Of the checkpoint.
        seed: Environment seed of the first flight; those from HELD_OUT on are of no choice.
        flights: How many; if not given as many as its description says, else as while training.
    """
    network, said = load_checkpoint(network_folder)
    flights = flights or said.get("starts", {}).get("teams")
    held_out = HeldOutFlights(said["env_id"], said["env_kwargs"], flights)
    spent = Progress(said["updates"], said["steps"], float("nan"))
    return held_out.judge(network, said["cpu_seconds"], spent, seed)


def score_of_teams(network_folder: Path, teams: int = _MANY_FLIGHTS) -> dict[str, Any]:
    """What a description says of the score of a network for a team, on starts of no choice."""
    network, said = load_checkpoint(network_folder)
    held_out = HeldOutFlights(said["env_id"], said["env_kwargs"], teams)
    found = held_out.fly(network_policy(network, held_out.task, "shipped"), HELD_OUT)
    summary = found.summary()
    return {
        "score": summary["score"].mean,
        "score_half_width": summary["score"].half_width,
        "violation_share": summary["violation_share"].mean,
        "crashes": sum(record.crashed for record in found.records),
        "min_separation": min(record.min_separation for record in found.records),
        "starts": {"seed": HELD_OUT, "teams": teams},
    }


def best_of(runs: Sequence[Path]) -> Path:
    """The run whose network crashes least, then scores most, on _CHOOSING_FLIGHTS starts that choose."""

    def rank(run: Path) -> tuple[int, float]:
        point = judged(run, CHOOSING, _CHOOSING_FLIGHTS)
        return point.crashes, -point.score

    return min(runs, key=rank)


def ship(run: Path, name: str = "") -> Path:
    """Copy the best network of a run into the suite.

    Args:
        run: Folder of a training.
        name: Of the policy; by its algorithm and task if not given.

    Returns:
        Where it is now.

    Raises:
        CheckpointError: If it holds no checkpoint, or the suite's folder cannot be written.
    """
    network, said = load_checkpoint(run)
    folder = SHIPPED / (name or name_for(said["algorithm"], said["env_id"]))
    about = {name: said[name] for name in _SAID} | {
        **(score_of_teams(run) if said["env_id"] in TEAMS else _score_of_flights(run)),
        "git_revision": read_json(run / "config.json")["git_revision"],
        "versions": said["versions"],
    }
    save_checkpoint(folder, network, about)
    shutil.copyfile(run / "curve.csv", folder / "curve.csv")
    return folder


def _score_of_flights(run: Path) -> dict[str, Any]:
    """The same of a network for one vehicle."""
    point = judged(run)
    return {
        "score": point.score,
        "violation_share": point.violation_share,
        "crashes": point.crashes,
        "starts": {"seed": HELD_OUT, "flights": point.flights},
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument("--best", default="", metavar="NAME", help="ship the best of the runs as NAME")
    options = parser.parse_args(arguments)
    for run in [best_of(options.runs)] if options.best else options.runs:
        where = ship(run, options.best)
        print(f"{run} -> {where.name}: score {judged(where).score:.4f}")


if __name__ == "__main__":
    main()
