"""Long flights of every id with random options and actions: nothing is nan, no reward leaves [0, 1]."""

from __future__ import annotations

import gc
import random
from collections.abc import Iterator
from itertools import count

import numpy as np

from quad_envs.registration import TEAMS

from . import drawn
from .found import Found

STEPS = 2000  # of an environment alone; the widest vectors fly an eighth of them
_COPIES = ((1, 4, 17, 64, 256), (1, 3, 4, 17, 64))  # of a vector of vehicles, and of teams
_GROWTH = 8e6  # bytes by which memory may grow over the second half of these steps
_PAGE = 4096


def resident() -> int:
    """Memory of this process that is not swapped out, bytes."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * _PAGE


def soak(seed: int) -> Iterator[Found]:
    """Environments without end: of the id with the fewest steps, singly (with its team) and as a vector."""
    flown = dict.fromkeys(drawn.IDS, 0)
    for k in count():
        rng = random.Random(f"{seed} {k}")
        if k % 2 == 0:
            env_id = min(flown, key=lambda one: flown[one])
        copies = rng.choice(_COPIES[env_id in TEAMS]) if k % 2 else 0
        found = _fly(drawn.draw(rng, env_id, copies), k)
        flown[env_id] += found.tried
        yield found


def _fly(flown: drawn.Drawn, seed: int) -> Found:
    rng = np.random.default_rng(seed)
    wrong, growth, steps, made = "", 0.0, 0, 0
    try:
        wrong = _bad(drawn.reset(flown.env, seed), None)
        while made < STEPS and not wrong:
            found = drawn.step(flown.env, rng)
            wrong = _bad(found.observations, found.rewards)
            steps += max(1, len(found.rewards))
            made += min(max(1, len(found.rewards) // 8), 8)  # a wide vector need not fly for minutes
            if found.ended:
                wrong = wrong or _bad(drawn.reset(flown.env), None)
            if growth == 0.0 and made >= STEPS // 2:
                gc.collect()
                growth = float(resident())
        gc.collect()
        growth = resident() - growth if growth else 0.0
        if growth > _GROWTH:
            wrong = wrong or f"memory grew by {growth / 1e6:.1f} MB"
    except Exception as error:
        wrong = f"{type(error).__name__}: {error}"
    flown.env.close()
    return Found(steps, (f"{flown.what}: {wrong}",) if wrong else (), max(0.0, growth) / 1e6)


def _bad(observations: drawn.Array, rewards: drawn.Array | None) -> str:
    if not np.isfinite(observations).all():
        return "an observation is not finite"
    if rewards is not None and not ((rewards >= 0.0) & (rewards <= 1.0)).all():
        return f"a reward is {rewards.min()} to {rewards.max()}"
    return ""
