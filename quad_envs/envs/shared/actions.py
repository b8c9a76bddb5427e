"""What is asked of actions before anything moves, compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compilation.decorators import kernel

FLOAT32 = np.dtype(np.float32)  # of actions and observations; numpy takes longer to read `np.float32`


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
