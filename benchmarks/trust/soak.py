"""Long flights of every id with random options and actions: nothing is nan, no reward leaves [0, 1]."""

from __future__ import annotations

import gc
import random
from collections.abc import Iterator
from itertools import count

import numpy as np

from . import drawn
from .found import Found

STEPS = 2000  # of a vehicle or a row, in one environment
_GROWTH = 8e6  # bytes by which memory may grow over the second half of these steps
_PAGE = 4096


def resident() -> int:
    """Memory of this process that is not swapped out, bytes."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * _PAGE


def soak(seed: int) -> Iterator[Found]:
    """Environments without end: each id in turn, singly (with its team) and as a vector; tries are steps."""
    for k in count():
        rng = random.Random(f"{seed} {k}")
        env_id = drawn.IDS[k // 2 % len(drawn.IDS)]
        copies = rng.choice([1, 3, 4, 17, 64]) if k % 2 else 0
        yield _fly(drawn.draw(rng, env_id, copies), k)


def _fly(flown: drawn.Drawn, seed: int) -> Found:
    rng = np.random.default_rng(seed)
    wrong, growth, rows, made = "", 0.0, 1, 0
    try:
        wrong = _bad(drawn.reset(flown.env, seed), None)
        while made < STEPS and not wrong:
            found = drawn.step(flown.env, rng)
            wrong = _bad(found.observations, found.rewards)
            rows = max(1, len(found.rewards))
            made += max(1, rows // 8)  # a wide vector is no reason to fly it for minutes
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
    steps = made // max(1, rows // 8) * rows
    return Found(steps, (f"{flown.what}: {wrong}",) if wrong else (), max(0.0, growth) / 1e6)


def _bad(observations: drawn.Array, rewards: drawn.Array | None) -> str:
    if not np.isfinite(observations).all():
        return "an observation is not finite"
    if rewards is not None and not ((rewards >= 0.0) & (rewards <= 1.0)).all():
        return f"a reward is {rewards.min()} to {rewards.max()}"
    return ""
