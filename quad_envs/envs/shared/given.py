"""Plants that a person gives in `reset(options={"state": ...})`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...arguments.kinds import holds_booleans
from ...arguments.names import shown
from ...formations import FARTHEST
from ...parameters import N_INPUT, N_STATE, Array
from .vehicle_options import CRASH_TILT

MOST_STATE = FARTHEST  # SI; faster than that nothing flies, either


def as_numbers(state: Any) -> Array:
    """An array of what was given; (0,) where it is ragged or no numbers."""
    if holds_booleans(state):
        return np.empty(0)
    try:
        return np.asarray(state, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.empty(0)


def given_plants(state: Any, rows: tuple[int, ...], hover: float) -> Array:
    """Plants (*rows, 16) from a reset option; rotors without a force hover.

    Args:
        state: What was given, (*rows, 12) or (*rows, 16).
        rows: () for one vehicle, (N,) for a team.
        hover: Force of each rotor where the state has 12 numbers, N.

    Raises:
        ValueError: If it has another shape, is not finite or beyond MOST_STATE, or is a crash.
    """
    found = as_numbers(state)
    wanted = "12 or 16 finite numbers" if not rows else f"finite plants {(*rows, 12)} or {(*rows, 16)}"
    if found.shape[:-1] != rows or found.shape[-1] not in (N_STATE, N_STATE + N_INPUT):
        raise ValueError(f"reset option 'state' must be {wanted}, got {shown(state)} of shape {found.shape}")
    if not (np.abs(found) <= MOST_STATE).all():
        raise ValueError(
            f"reset option 'state' must be {wanted}, each at most {MOST_STATE:g} in size, got {shown(state)}"
        )
    if (np.abs(found[..., 6:8]) >= CRASH_TILT).any():
        raise ValueError(
            f"reset option 'state': roll and pitch must be below {math.degrees(CRASH_TILT):.0f} deg, "
            f"got {np.abs(found[..., 6:8]).max():g} rad"
        )
    forces = np.full((*rows, N_INPUT), hover)
    return found if found.shape[-1] > N_STATE else np.concatenate([found, forces], axis=-1)
