"""Formations and starts of a team: wanted positions p_i* and first positions p_i(0), rows (N, 3), NED, m.

A named formation is relative to its first slot, the leader's, with the leader heading north and all slots at
one height. Slots of your own may be relative to anything: only the differences delta_ij = p_i* - p_j* count,
or, where a target is followed, p_i* relative to the target.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from .arguments.checks import Bound, require_number, require_whole
from .arguments.kinds import holds_booleans
from .arguments.names import shown, unknown_name
from .parameters import Array

FORMATIONS = ("triangle", "hexagon", "lattice")
STARTS = ("line", "sorted", "random", "box")
MOST_VEHICLES = 200
FARTHEST = 1e6  # m, from the origin; float32 observations hold it
_SPACING = Bound(0.0, 1e4, "m", open=True)
START_GAP = 1.0  # m, between neighbours of a named start
_START_HEIGHT_NOISE = 0.02  # m, breaks the symmetry of a plane
_SAME_PLACE = 1e-6  # m, vehicles nearer than this have no direction in which to part
_MOST_DRAWS = 100_000  # of positions per start; a box with 1 m^3 a vehicle needs about one each
_TRIES, _TRIED_DRAWS = 5, 10_000  # with which a box has to be filled before the first episode
_JAMMED = 1000  # misses in a row after which the box is filled anew


def lattice_cells(n: int) -> list[tuple[int, int]]:
    """(row r, place j) of the first n slots of a triangular lattice: row r has r + 1 slots."""
    cells = []
    for i in range(n):
        row = (math.isqrt(8 * i + 1) - 1) // 2
        cells.append((row, i - row * (row + 1) // 2))
    return cells


def make_formation(
    what: str | ArrayLike, vehicles: int, spacing: float = 1.0, separation: float = 0.4
) -> Array:
    """Slots of a formation.

    Args:
        what: "triangle" (3, 6, 10, 15, ... vehicles), "hexagon" (6), "lattice" (any number), or the slots
            themselves, (N, 3).
        vehicles: N.
        spacing: Distance of neighbouring slots of a named formation, m.
        separation: Distance d_s that two slots must exceed, m.

    Returns:
        p_i*, (N, 3), m; those of a named formation relative to slot 0, given ones as they are.

    Raises:
        ValueError: If the name is unknown, the number of vehicles does not fit, slots are not finite, or two
            of them are too near each other.
    """
    require_whole("vehicles", vehicles, 1, MOST_VEHICLES)
    require_number("spacing of a formation", spacing, _SPACING)
    if isinstance(what, str):
        slots = spacing * _named_slots(what, int(vehicles))
        remedy = "choose a larger spacing"
    else:
        slots = _positions("formation", what, int(vehicles))
        remedy = "move them apart"
    i, j, least = nearest_pair(slots)
    if least <= separation:
        raise ValueError(
            f"slots {i} and {j} of the formation are {least:g} m apart, which must exceed the separation "
            f"{separation:g} m: {remedy}"
        )
    return slots


def _named_slots(name: str, n: int) -> Array:
    if name not in FORMATIONS:
        raise ValueError(f"{unknown_name('formation', name, FORMATIONS)}, or an (N, 3) array of slots")
    if name == "hexagon":
        if n != 6:
            raise ValueError(
                f"the formation 'hexagon' needs 6 vehicles, got {n}: 'lattice' takes any number, or give the "
                "slots as an (N, 3) array"
            )
        angle = np.arange(6) * (math.pi / 3.0)
        return np.stack([np.cos(angle) - 1.0, np.sin(angle), np.zeros(6)], axis=1)
    if name == "triangle":
        rows = (math.isqrt(8 * n + 1) - 1) // 2
        if n < 3 or rows * (rows + 1) != 2 * n:
            below, above = rows * (rows + 1) // 2, (rows + 1) * (rows + 2) // 2
            fitting = f"{below} or {above}" if below >= 3 else "3"
            raise ValueError(
                f"the formation 'triangle' needs 3, 6, 10, 15, ... vehicles, got {n}: take {fitting}, or the "
                "formation 'lattice', which takes any number"
            )
    cells = np.array(lattice_cells(n), dtype=np.float64)
    return np.stack([-cells[:, 0] * math.sqrt(0.75), cells[:, 1] - 0.5 * cells[:, 0], np.zeros(n)], axis=1)


def _positions(name: str, what: ArrayLike, n: int) -> Array:
    """Finite positions (n, 3) from what a user gave."""
    try:
        out = np.array(what, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        out = None
    if out is None or holds_booleans(what):
        raise ValueError(f"{name} must be a name or {n} rows of three numbers, got {shown(what)}") from None
    if out.shape != (n, 3):
        raise ValueError(
            f"{name} must be a name or an ({n}, 3) array, one row per vehicle, got shape {out.shape}"
        )
    near = np.abs(out) <= FARTHEST
    if not near.all():
        row = int(np.argmin(near.all(axis=1)))
        raise ValueError(
            f"{name} must be finite and within {FARTHEST:g} m, got {out[row].tolist()} for vehicle {row}"
        )
    return out


def nearest_pair(p: Array) -> tuple[int, int, float]:
    """The two nearest of the positions p (N, 3) and their distance, m; infinite for a single one."""
    distance = np.linalg.norm(p[:, None] - p, axis=2)
    np.fill_diagonal(distance, math.inf)
    i, j = divmod(int(distance.argmin()), len(p))
    return min(i, j), max(i, j), float(distance[i, j])


def start_positions(
    kind: str | ArrayLike,
    slots: Array,
    rng: np.random.Generator,
    separation: float = 0.4,
    draws: int = _MOST_DRAWS,
) -> Array:
    """First positions of a team, at rest.

    Args:
        kind: "line": y = 0 .. N-1 m in the order of the vehicles, so that paths cross; "sorted": a line in
            the order of the slots' y with the leader at 0; "random": a random permutation on a square grid of
            1 m; "box": uniform in a cube of 1 m^3 per vehicle around the origin; or positions (N, 3).
        slots: p_i*, (N, 3), m.
        rng: Read by "random" and "box" only.
        separation: Distance that two vehicles of a "box" must exceed, m.
        draws: After so many of a "box" it has no room.

    Returns:
        p_i(0), (N, 3), m.

    Raises:
        ValueError: If the kind is unknown, positions have another shape or are not finite, two vehicles
            start at one place, or the box has no room.
    """
    n = len(slots)
    out = np.zeros((n, 3))
    if not isinstance(kind, str):
        out = _positions("start", kind, n)
        i, j, least = nearest_pair(out)
        if least < _SAME_PLACE:
            raise ValueError(
                f"vehicles {i} and {j} start at the same place {out[i].tolist()}: move them apart"
            )
    elif kind == "line":
        out[:, 1] = START_GAP * np.arange(n)
    elif kind == "sorted":
        out[:, 1] = START_GAP * _ranks_from_leader(slots)
    elif kind == "random":
        out = _grid(n)[rng.permutation(n)]
        out[:, 2] = _START_HEIGHT_NOISE * rng.standard_normal(n)
    elif kind == "box":
        out = _box(n, rng, separation, draws)
    else:
        raise ValueError(f"{unknown_name('start', kind, STARTS)}, or an (N, 3) array of positions")
    return out


def tried_starts(kind: str | ArrayLike, slots: Array, separation: float) -> list[Array]:
    """Starts as `start_positions` draws them, with so few draws that no later one fails.

    Raises:
        ValueError: As there.
    """
    tries = _TRIES if isinstance(kind, str) and kind == "box" else 1
    return [
        start_positions(kind, slots, np.random.default_rng(seed), separation, _TRIED_DRAWS)
        for seed in range(tries)
    ]


def _ranks_from_leader(slots: Array) -> Array:
    """Rank of each slot's y minus the leader's rank, (N,).

    Of slots with equal y the front one stands nearer to the leader: the other then passes behind it.
    """
    y = np.round(slots[:, 1], 6)  # slots in one column differ by rounding
    outward = np.where(y < y[0], slots[:, 0], -slots[:, 0])
    rank = np.empty(len(slots))
    rank[np.lexsort((outward, y))] = np.arange(len(slots))
    return np.asarray(rank - rank[0])


def _grid(n: int) -> Array:
    """First n places of a square grid, row by row from north to south, centred in y, (n, 3)."""
    side = math.isqrt(n - 1) + 1
    row, column = np.divmod(np.arange(n), side)
    return START_GAP * np.stack([-row, column - 0.5 * (side - 1), np.zeros(n)], axis=1)


def _box(n: int, rng: np.random.Generator, separation: float, draws: int) -> Array:
    """Places in a cube, each drawn again until it is far enough from those before it, (n, 3)."""
    half = 0.5 * START_GAP * n ** (1.0 / 3.0)
    out = np.empty((n, 3))
    placed = missed = 0
    for _ in range(draws + n):
        out[placed] = rng.uniform(-half, half, 3)
        if (np.linalg.norm(out[:placed] - out[placed], axis=1) > separation).all():
            placed, missed = placed + 1, 0
            if placed == n:
                return out
        elif missed == _JAMMED:
            placed = missed = 0
        else:
            missed += 1
    raise ValueError(
        f"no room for {n} vehicles more than {separation:g} m apart in a box of {2.0 * half:.2f} m: lower "
        "the separation or start from 'random' or an (N, 3) array"
    )
