"""A network for a few rows at a time, compiled: one decision in a control loop takes a few microseconds.

For many rows numpy's matrix products are faster; `NetworkPolicy` has them, and the tests compare both.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from quad_envs._numba import kernel

from .rows import first_not_finite

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]


@kernel
def forward_rows(
    observations: Floats,
    columns: Ints,
    sizes: Ints,
    weights: Floats,
    tanh_last: bool,
    gain: Floats,
    work: Floats,
    out: Floats,
) -> int:
    """Actions of a tanh network.

    Args:
        observations: (n, d).
        columns: Entries that the network sees, (sizes[0],).
        sizes: Inputs and outputs of each layer, (layers + 1,).
        weights: Row by row the weights of a layer, then its biases, layer after layer.
        tanh_last: Whether the outputs pass a tanh, too, before they are clipped to [-1, 1].
        gain: By which positive outputs of the first four are scaled, (4,), see `networks.hover_actions`.
        work: Scratch, (2, max(sizes)).
        out: Result, (n, sizes[-1]).

    Returns:
        -1, or the flat index of the first entry of the observations that is not finite, seen or not.
    """
    layers = sizes.size - 1
    for r in range(observations.shape[0]):
        bad = first_not_finite(observations[r])
        if bad >= 0:
            return int(r * observations.shape[1] + bad)
        for k in range(columns.size):
            work[0, k] = observations[r, columns[k]]
        at = 0
        for layer in range(layers):
            n, m = sizes[layer], sizes[layer + 1]
            x, y = work[layer % 2], work[(layer + 1) % 2]
            for j in range(m):
                y[j] = weights[at + n * m + j]
            for i in range(n):
                for j in range(m):
                    y[j] += x[i] * weights[at + i * m + j]
            if layer + 1 < layers or tanh_last:
                for j in range(m):
                    y[j] = math.tanh(y[j])
            at += (n + 1) * m
        for j in range(sizes[layers]):
            value = min(max(work[layers % 2, j], np.float32(-1.0)), np.float32(1.0))
            if j < 4 and value > 0.0:
                value = min(value * gain[j], np.float32(1.0))
            out[r, j] = value
    return -1
