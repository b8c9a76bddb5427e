"""Decisions of this checkout beside those of another one, in two processes that fly in turns."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

HERE = Path(__file__).parent.parent
POLICIES = ("lmpc", "sdc-nmpc", "nmpc")
_FLIGHTS = """
import json, sys
from time import process_time_ns
from benchmarks.decide import SCENES
import gymnasium as gym, numpy as np
from baselines import make_policy

envs, policies = {}, {}
def fly(name, scene, rows, steps):
    options = SCENES[scene] | {"start_box": 3.0 if scene == "tight" else 0.5, "start": (0.0, 0.0, 0.0)}
    key = scene, rows
    envs[key] = envs.get(key) or gym.make_vec("quad/Regulation-v0", num_envs=rows, **options)
    policies[name, key] = policies.get((name, key)) or make_policy(name, envs[key])
    observations, _ = envs[key].reset(seed=0)
    state, start, taken = None, np.ones(rows, dtype=np.bool_), []
    for _ in range(steps):
        begin = process_time_ns()
        actions, state = policies[name, key].predict(observations, state, start)
        taken.append((process_time_ns() - begin) / rows / 1e3)
        observations, *_ = envs[key].step(actions)
        start = np.zeros(rows, dtype=np.bool_)
    return taken

for line in sys.stdin:
    print(json.dumps(fly(*json.loads(line))), flush=True)
"""


class Pair(NamedTuple):
    """CPU-us of a decision, here and there."""

    here: float
    there: float


@contextmanager
def _flying(checkout: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that flies what each line asks for, and says how long the decisions took."""
    process = subprocess.Popen(
        [sys.executable, "-c", _FLIGHTS],
        cwd=checkout,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    with process:
        yield process
        assert process.stdin is not None
        process.stdin.close()


def _ask(process: subprocess.Popen[str], *what: Any) -> list[float]:
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write(json.dumps(what) + "\n")
    process.stdin.flush()
    taken: list[float] = json.loads(process.stdout.readline())
    return taken


def decisions_beside(other: Path, rows: int, steps: int, repetitions: int) -> dict[str, Pair]:
    """CPU-us per row: p50 of single decisions, and the mean of batches of so many rows.

    Flights repeat exactly; of each decision the shortest time counts.
    """
    found = {}
    with _flying(HERE) as ours, _flying(other) as theirs:
        for name in POLICIES:
            for scene in ("nominal", "tight"):
                for n in (1, rows):
                    taken = [
                        [_ask(process, name, scene, n, steps) for process in (ours, theirs)]
                        for _ in range(repetitions + 1)  # the first compiles
                    ]
                    shortest = np.min(taken[1:], axis=0)
                    middle = np.median(shortest, axis=1) if n == 1 else shortest.mean(axis=1)
                    found[f"{name}, {scene}, {n}"] = Pair(*map(float, middle))
    return found
