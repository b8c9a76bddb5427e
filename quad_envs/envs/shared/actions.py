"""What is asked of actions before anything moves."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...arguments.names import shown
from ...compilation.decorators import kernel

FLOAT32 = np.dtype(np.float32)  # of actions and observations; numpy takes longer to read `np.float32`


def real_numbers(given: Any, what: str, shape: tuple[int, ...] | None = None) -> NDArray[np.float32]:
    """Actions as float32, contiguous; `what` names them and says what they must be.

    Args:
        given: They, as somebody gave them.
        what: Of them, for the message.
        shape: That they should have, for the message too, which is made only where it is said.

    Raises:
        ValueError: If they are no real numbers: text, complex, objects, or lists of several lengths.
    """
    try:
        return np.asarray(given).astype(FLOAT32, "C", "same_kind", copy=False)
    except (TypeError, ValueError):
        wanted = what if shape is None else f"{what} of shape {shape}"
        raise ValueError(f"{wanted}, got {shown(given)}") from None


@kernel
def first_unsound(actions: NDArray[np.float32]) -> int:
    """Index of the first action that is not a finite number; -1 if all are."""
    sound = True
    for a in range(actions.size):
        sound &= abs(actions[a]) < np.inf
    if not sound:
        for a in range(actions.size):
            if not np.isfinite(actions[a]):
                return a
    return -1
