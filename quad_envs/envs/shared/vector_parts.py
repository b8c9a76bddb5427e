"""What the native vector environments share: a generator per flight or team, and infos of rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

from ...parameters import Array
from ..tracking.kernel import CAUSE, CLIPPED, COST, CRASHED, EPISODE_COST, STAGE_COST, VALUES, VIOLATED

Generators = list[np.random.Generator]


def seeded(
    generators: Generators, seed: int | Sequence[int | None] | None, mask: NDArray[np.bool_]
) -> Generators:
    """The generators after a reset.

    Args:
        generators: Those before it; empty before the first.
        seed: One number s (unit i gets s + i), one per unit, or None to draw on.
        mask: (n,), units that the reset begins anew: the others draw on, whatever the seed.

    Raises:
        ValueError: If there are more or fewer seeds than units.
    """
    if seed is None and generators:
        return generators
    n = len(mask)
    if seed is None or isinstance(seed, int | np.integer):
        seeds: Sequence[int | None] = [None if seed is None else int(seed) + i for i in range(n)]
    else:
        seeds = seed
    if len(seeds) != n:
        raise ValueError(f"seed must be one number or {n} of them, got {len(seeds)}")
    fresh = [seeding.np_random(value)[0] for value in seeds]
    if not generators:
        return fresh
    anew = [begins and value is not None for begins, value in zip(mask.tolist(), seeds, strict=True)]
    return [new if take else old for take, new, old in zip(anew, fresh, generators, strict=True)]


def score_infos(rows: Array, n_values: int) -> dict[str, Any]:
    """What `info` says of every row, copied.

    Args:
        rows: Vehicles, (n, ...), see `kernel`.
        n_values: Number of constraints.
    """
    return {
        "cost": rows[:, COST].copy(),
        "episode_cost": rows[:, EPISODE_COST].copy(),
        "constraint_violation": rows[:, VIOLATED] > 0.0,
        "constraint_values": rows[:, VALUES : VALUES + n_values].copy(),
        "stage_cost": rows[:, STAGE_COST].copy(),
        "crashed": rows[:, CRASHED] > 0.0,
        "crash_cause": rows[:, CAUSE].astype(np.int64),
        "clipped_actions": rows[:, CLIPPED].astype(np.int64),
    }


def with_presence(info: dict[str, Any], n: int) -> dict[str, Any]:
    """The info of n rows, and beside each key the mask `_key` that Gymnasium's vectors have: all have it."""
    return info | {f"_{key}": np.ones(n, dtype=np.bool_) for key in info}
