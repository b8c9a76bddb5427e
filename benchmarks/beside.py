"""Decisions of this checkout beside those of another one, in two processes that fly in turns."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from .turns import HERE, at_work

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


def decisions_beside(other: Path, rows: int, steps: int, repetitions: int) -> dict[str, Pair]:
    """CPU-us per row: p50 of single decisions, and the mean of batches of so many rows.

    Flights repeat exactly; of each decision the shortest time counts.
    """
    found = {}
    with at_work(HERE, _FLIGHTS) as ours, at_work(other, _FLIGHTS) as theirs:
        for name in POLICIES:
            for scene in ("nominal", "tight"):
                for n in (1, rows):
                    taken = [
                        [process.ask(name, scene, n, steps) for process in (ours, theirs)]
                        for _ in range(repetitions + 1)  # the first compiles
                    ]
                    shortest = np.min(taken[1:], axis=0)
                    middle = np.median(shortest, axis=1) if n == 1 else shortest.mean(axis=1)
                    found[f"{name}, {scene}, {n}"] = Pair(*map(float, middle))
    return found
