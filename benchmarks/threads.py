"""Threads of vector environments: `python -m benchmarks.threads [--rows 4096] [--threads 2] [--json]`.

A step on one thread and on several, in turns, best of the repetitions: wall time, and CPU time of the calling
thread, which does what cannot be shared and its share of the rest. Where other processes want the cores,
wall time says nothing of threads, and the calling thread's is what would be left with cores of their own.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from time import perf_counter, thread_time
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

import quad_envs  # noqa: F401
from baselines.evaluation.table import format_table
from quad_envs import formation_v0

_TEAM = 6
_STEPS = 3  # timed at once


class Gain(NamedTuple):
    """How many times faster several threads are."""

    wall: float
    calling: float  # by CPU time of the calling thread


def gain(make: Callable[[int], Any], threads: int, repetitions: int) -> Gain:
    """Of environments made for a number of threads."""
    envs = {count: make(count) for count in (1, threads)}
    best = {count: (np.inf, np.inf) for count in envs}
    for repetition in range(repetitions + 1):
        for count, env in envs.items():
            if repetition % 10 == 0:
                env.reset(seed=0)
            actions = np.zeros(env.action_space.shape, dtype=np.float32)
            begin = perf_counter(), thread_time()
            for _ in range(_STEPS):
                env.step(actions)
            taken = perf_counter() - begin[0], thread_time() - begin[1]
            if repetition > 0:  # the first compiles
                best[count] = min(best[count][0], taken[0]), min(best[count][1], taken[1])
    return Gain(*(one / many for one, many in zip(best[1], best[threads], strict=True)))


def measure(rows: int, threads: int, repetitions: int) -> dict[str, Gain]:
    """Flights and teams of so many vehicles."""
    helix = "quad/HelixTracking-v0"
    return {
        f"{rows} flights": gain(
            lambda count: gym.make_vec(helix, num_envs=rows, threads=count), threads, repetitions
        ),
        f"{rows // _TEAM} teams of {_TEAM}": gain(
            lambda count: formation_v0.vector_env(rows // _TEAM, vehicles=_TEAM, threads=count),
            threads,
            repetitions,
        ),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.threads", description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, default=4096, help="vehicles (default 4096)")
    parser.add_argument("--threads", type=int, default=2, help="threads beside one (default 2)")
    parser.add_argument("--repetitions", type=int, default=50, help="in turns (default 50)")
    parser.add_argument("--json", action="store_true", help="machine-readable")
    arguments = parser.parse_args()
    found = measure(arguments.rows, arguments.threads, arguments.repetitions)
    if arguments.json:
        json.dump({name: row._asdict() for name, row in found.items()}, sys.stdout, indent=2)
        print()
        return
    rows = [[name, f"{row.wall:.2f}", f"{row.calling:.2f}"] for name, row in found.items()]
    print(format_table([f"{arguments.threads} threads, times faster", "wall", "calling thread"], rows))


if __name__ == "__main__":
    main()
