"""What the native vector environments share: a generator per flight or team, and masks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from ...arguments.names import unknown_name

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


def presence(n: int, names: Iterable[str]) -> dict[str, NDArray[np.bool_]]:
    """The masks `_name` of Gymnasium's vectors beside each info: all rows have it; read-only."""
    mask = np.ones(n, dtype=np.bool_)
    mask.flags.writeable = False
    return {f"_{name}": mask for name in names}


def autoreset_of(mode: AutoresetMode | str) -> AutoresetMode:
    """When flights of a vector begin anew, of its name in Gymnasium.

    Raises:
        ValueError: If there is no such mode.
    """
    known = [one.value for one in AutoresetMode]
    if not isinstance(mode, AutoresetMode) and mode not in known:
        raise ValueError(unknown_name("autoreset_mode", mode, known))
    return AutoresetMode(mode)
