"""A network for a few rows at a time, compiled: one decision in a control loop takes a few microseconds.

For many rows numpy's matrix products are faster; `NetworkPolicy` has them, and the tests compare both.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from quad_envs.compilation.decorators import inline_kernel, kernel
from quad_envs.parameters import Array

from .rows import first_not_finite

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]


@inline_kernel
def see(observation: Floats, columns: Ints, scaling: Array, out: Floats) -> None:
    """Write what the first layer sees of an observation; see `forward_rows`."""
    if scaling.size == 0:
        for k in range(columns.size):
            out[k] = observation[columns[k]]
        return
    for k in range(columns.size):
        value = (observation[columns[k]] - scaling[0, k]) / scaling[1, k]
        out[k] = min(max(value, -scaling[2, k]), scaling[2, k])


@kernel
def forward_rows(
    observations: Floats,
    columns: Ints,
    scaling: Array,
    sizes: Ints,
    weights: Floats,
    kinds: NDArray[np.bool_],
    gains: Floats,
    work: Floats,
    out: Floats,
) -> int:
    """Actions of a network.

    Args:
        observations: (n, d).
        columns: Entries that the network sees, (sizes[0],).
        scaling: Rows mean, scale, clip, (3, sizes[0]): an entry is (value - mean) / scale, within +-clip; or
            (0, 0), where the first layer scales.
        sizes: Inputs and outputs of each layer, (layers + 1,).
        weights: Row by row the weights of a layer, then its biases, layer after layer.
        kinds: Whether layers but the last are relu and not tanh; whether the outputs pass a tanh before they
            are clipped to [-1, 1], (2,).
        gains: Slopes of the actions by the first four outputs, below zero and above, `hover_gains`, (2, 4).
        work: Scratch, (2, max(sizes)).
        out: Result, (n, sizes[-1]).

    Returns:
        -1; the flat index of the first entry that is not finite, seen or not; -2 - r if row r has no answer.
    """
    layers = sizes.size - 1
    relu, tanh_last = kinds[0], kinds[1]
    for r in range(observations.shape[0]):
        bad = first_not_finite(observations[r])
        if bad >= 0:
            return int(r * observations.shape[1] + bad)
        see(observations[r], columns, scaling, work[0])
        at = 0
        for layer in range(layers):
            n, m = sizes[layer], sizes[layer + 1]
            x, y = work[layer % 2], work[(layer + 1) % 2]
            for j in range(m):
                y[j] = weights[at + n * m + j]
            for i in range(n):
                for j in range(m):
                    y[j] += x[i] * weights[at + i * m + j]
            if layer + 1 < layers and relu:
                for j in range(m):
                    y[j] = max(y[j], np.float32(0.0))
            elif layer + 1 < layers or tanh_last:
                for j in range(m):
                    y[j] = math.tanh(y[j])
            at += (n + 1) * m
        for j in range(sizes[layers]):
            if work[layers % 2, j] != work[layers % 2, j]:
                return -2 - r
            answer = min(max(work[layers % 2, j], np.float32(-1.0)), np.float32(1.0))
            if j < 4:
                answer = min(answer * gains[0 if answer < 0.0 else 1, j], np.float32(1.0))
            out[r, j] = answer
    return -1
