"""How soon training passes the controllers: `python -m benchmarks.learn RUN ... [--json]`.

Reads the learning curves of training runs (`quad-envs train`, or OUT/networks of `quad-envs benchmark
rl-vs-mpc`) and flies LQR, LMPC and exact NMPC from the very starts by which the curves were judged, so that
the difference is a paired one. CPU-seconds are those of training alone, on the machine that trained.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from baselines import evaluate, make_policy
from baselines.evaluation.table import format_number, format_table
from baselines.files import read_json
from baselines.training.held_out import CHOOSING, HeldOutFlights, Point
from baselines.training.run_folder import RunFolder

CONTROLLERS = ("lqr", "lmpc", "nmpc")


class Run(NamedTuple):
    """A training, and when it passed each controller."""

    env_id: str
    algorithm: str
    seed: int
    best: float  # score of the curve's best point
    last: Point
    passed: dict[str, float]  # controller -> CPU-seconds; nan if never


def read_runs(folders: Sequence[Path]) -> list[Run]:
    """The runs in folders, with the controllers flown once per task."""
    flown: dict[str, dict[str, float]] = {}
    runs = []
    for folder in folders:
        about = read_json(folder / "config.json")
        curve = RunFolder(folder, about).read_curve()
        if not curve:
            continue
        key = json.dumps([about["env_id"], about["env_kwargs"]])
        if key not in flown:
            flown[key] = _controllers(about["env_id"], about["env_kwargs"])
        passed = {
            name: next((point.cpu_seconds for point in curve if point.score > score), float("nan"))
            for name, score in flown[key].items()
        }
        best = max(point.score for point in curve)
        runs.append(Run(about["env_id"], about["algorithm"], about["seed"], best, curve[-1], passed))
    return runs


def _controllers(env_id: str, env_kwargs: dict[str, object]) -> dict[str, float]:
    """Scores of the controllers on the starts that choose policies."""
    flights = HeldOutFlights(env_id, env_kwargs)
    return {
        name: evaluate(make_policy(name, flights.env), flights.env, flights.flights, CHOOSING)
        .summary()["score"]
        .mean
        for name in CONTROLLERS
    }


def _lines(runs: Sequence[Run]) -> list[list[str]]:
    """One line per task and algorithm: seeds that passed, and the slowest and the median of them."""
    groups = defaultdict(list)
    for run in runs:
        groups[run.env_id, run.algorithm].append(run)
    lines = []
    for (env_id, algorithm), group in sorted(groups.items()):
        line = [env_id, algorithm, str(len(group))]
        line.append(f"{min(run.best for run in group):.3f} to {max(run.best for run in group):.3f}")
        line.append(format_number(sum(run.last.cpu_seconds for run in group) / len(group), 3))
        for name in CONTROLLERS:
            times = sorted(run.passed[name] for run in group if run.passed[name] == run.passed[name])
            spread = f", {times[0]:.0f} to {times[-1]:.0f} s" if times else ""
            line.append(f"{len(times)} of {len(group)}{spread}")
        lines.append(line)
    return lines


def main() -> None:
    """Read and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.learn", description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folder of a training")
    parser.add_argument("--json", action="store_true", help="machine-readable")
    arguments = parser.parse_args()
    runs = read_runs(arguments.runs)
    if arguments.json:
        print(json.dumps([run._asdict() | {"last": run.last._asdict()} for run in runs], indent=1))
        return
    header = [
        "task",
        "algorithm",
        "seeds",
        "best score",
        "CPU-s",
        *(f"passes {name}" for name in CONTROLLERS),
    ]
    print(format_table(header, _lines(runs)))


if __name__ == "__main__":
    main()
