"""Steps of this checkout beside those of another one: options of vectors, single flights, teams, in turns."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from .turns import HERE, at_work

_TEAMS = (6, 100)
_STEPS = """
import json, sys
from time import process_time
import gymnasium as gym
import numpy as np
import quad_envs
from quad_envs import formation_v0

known = {}

def single(env, action):
    if env.step(action)[2:4] != (False, False):
        env.reset()

def make(kind, env_id, rows, options):
    if kind == "team":
        team = formation_v0.parallel_env(vehicles=rows, time_limit=1e4)
        team.reset(seed=0)
        actions = {name: np.zeros(4, np.float32) for name in team.agents}
        return lambda: team.step(actions)
    if kind == "one":
        one, action = gym.make(env_id), np.zeros(4, np.float32)
        one.reset(seed=0)
        return lambda: single(one, action)
    vector, actions = gym.make_vec(env_id, num_envs=rows, **options), np.zeros((rows, 4), np.float32)
    vector.reset(seed=0)
    return lambda: vector.step(actions)

for line in sys.stdin:
    name, kind, env_id, rows, options, steps = json.loads(line)
    if name not in known:
        known[name] = make(kind, env_id, rows, options)
    step = known[name]
    begin = process_time()
    for _ in range(steps):
        step()
    print(1e9 * (process_time() - begin) / steps / rows, flush=True)
"""


class Pair(NamedTuple):
    """CPU-ns of a row's step, here and there."""

    here: float
    there: float


def steps_beside(
    other: Path, options: Mapping[str, Mapping[str, Any]], rows: int, steps: int, repetitions: int
) -> dict[str, Pair]:
    """Best of the repetitions of each case.

    Args:
        other: The other checkout.
        options: Name -> keyword arguments of a vector of so many rows, `env_id` among them.
        rows: Rows of the vectors.
        steps: In one go, as long as an episode.
        repetitions: In turns.
    """
    helix, default = "quad/HelixTracking-v0", {}
    cases: dict[str, tuple[str, str, int, dict[str, Any], int]] = {
        "one env": ("one", helix, 1, default, 10 * steps),
        "vector of 64": ("vector", helix, 64, default, steps),
        "vector of 4096": ("vector", helix, 4096, default, steps // 4),
        **{f"PettingZoo, {n} vehicles": ("team", helix, n, default, steps) for n in _TEAMS},
    }
    for name, chosen in options.items():
        known = {key: value for key, value in chosen.items() if key != "env_id"}
        cases[f"{rows} with {name}"] = ("vector", chosen.get("env_id", helix), rows, known, steps)
    best = dict.fromkeys(cases, Pair(float("inf"), float("inf")))
    with at_work(HERE, _STEPS) as ours, at_work(other, _STEPS) as theirs:
        turn = {"here": ours, "there": theirs}
        for repetition in range(repetitions + 1):
            for name, case in cases.items():
                taken = {where: float(process.ask(name, *case)) for where, process in turn.items()}
                if repetition > 0:  # the first compiles
                    best[name] = Pair(*map(min, best[name], Pair(**taken)))
            turn = dict(reversed(turn.items()))  # who is second finds another cache
    return best
