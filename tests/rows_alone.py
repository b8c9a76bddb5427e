"""A batch of vehicles decides as its vehicles do alone, to the last bit."""

import numpy as np
from flights import HOVER, decide_once, helix, window


def require_equal_alone(mpc, plants):
    """Plants (n, 16) at the start of the helix are commanded the same alone as with the others."""
    n = len(plants)
    rows = np.repeat(window(helix, 0, mpc.horizon)[None], n, axis=0)
    last, zero = np.full((n, 4), HOVER), np.zeros((n, 6))
    memory = mpc.decide(plants, rows, last, zero, np.zeros((n, mpc.memory_size))).memory
    together = mpc.decide(plants, rows, last, zero, memory)
    for j in range(n):
        alone = decide_once(mpc, plants[j], rows[j], memory=memory[j])
        np.testing.assert_array_equal(alone.command[0], together.command[j])
        np.testing.assert_array_equal(alone.memory[0], together.memory[j])
