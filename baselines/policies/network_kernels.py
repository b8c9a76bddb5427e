"""A network for rows of observations, compiled: what a row gets does not depend on the rows beside it.

Sums run over the inputs in their order, in the tiles of `quad_envs.compilation.tiles`, for one row as for a
thousand. The tests have the same in numpy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from quad_envs.compilation.decorators import inline_kernel, kernel
from quad_envs.compilation.tiles import (
    STRIP,
    TILE_ROWS,
    WIDE,
    multiply_row,
    multiply_row_wide,
    multiply_rows,
)
from quad_envs.parameters import Array

from .rows import first_not_finite
from .tanh import tanh_in_place

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]

BLOCK = 64  # rows that go through all layers together, a multiple of a tile's


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


@inline_kernel
def multiply(x: Floats, rows: int, width: int, n: int, weights: Floats, at: int, m: int, out: Floats) -> None:
    """A linear layer.

    Args:
        x: Inputs of rows, flat.
        rows: Their number.
        width: From row to row, of x and of out.
        n: Number of inputs.
        weights: Of all layers.
        at: Where those of this one begin, as `tiles.packed` gives them.
        m: Number of outputs, a multiple of STRIP.
        out: Result, flat.
    """
    tiled = rows - rows % TILE_ROWS
    for j in range(0, m, STRIP):  # whose weights stay in the cache
        for r in range(0, tiled, TILE_ROWS):
            multiply_rows(x, r * width, width, n, weights, at + j * (n + 1), out, r * width + j)
    wide = m - m % WIDE
    for r in range(tiled, rows):
        for j in range(0, wide, WIDE):
            multiply_row_wide(x, r * width, width, n, weights, at + j * (n + 1), out, r * width + j)
        for j in range(wide, m, STRIP):
            multiply_row(x, r * width, width, n, weights, at + j * (n + 1), out, r * width + j)


@inline_kernel
def activate(y: Floats, relu: bool) -> None:
    """Relu or tanh of outputs in their place; what is not a number stays so."""
    if not relu:
        tanh_in_place(y)
        return
    for j in range(y.size):
        y[j] = np.float32(0.0) if y[j] < 0.0 else y[j]


@inline_kernel
def act(y: Floats, gains: Floats, out: Floats) -> bool:
    """Write the action of a network's outputs; False if one of them is no number."""
    for j in range(out.size):
        if y[j] != y[j]:
            return False
        answer = min(max(y[j], np.float32(-1.0)), np.float32(1.0))
        if j < 4:
            answer = min(answer * gains[0 if answer < 0.0 else 1, j], np.float32(1.0))
        out[j] = answer
    return True


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
        weights: `tiles.packed` of each layer, layer after layer.
        kinds: Whether layers but the last are relu and not tanh; whether the outputs pass a tanh before they
            are clipped to [-1, 1], (2,).
        gains: Slopes of the actions by the first four outputs, below zero and above, `hover_gains`, (2, 4).
        work: Scratch, (2, min(n, BLOCK), width), the width a multiple of STRIP no smaller than a size.
        out: Result, (n, sizes[-1]).

    Returns:
        -1; the flat index of the first entry that is not finite, seen or not; -2 - r if row r has no answer.
    """
    count, d = observations.shape
    for r in range(count):
        bad = first_not_finite(observations[r])
        if bad >= 0:
            return int(r * d + bad)
    layers, width = sizes.size - 1, work.shape[2]
    for begin in range(0, count, BLOCK):
        rows = min(BLOCK, count - begin)
        for r in range(rows):
            see(observations[begin + r], columns, scaling, work[0, r])
        at = 0
        for layer in range(layers):
            x, y = work[layer % 2].reshape(-1), work[(layer + 1) % 2].reshape(-1)
            n, m = sizes[layer], -(-sizes[layer + 1] // STRIP) * STRIP
            multiply(x, rows, width, n, weights, at, m, y)
            if layer + 1 < layers or kinds[1]:
                for r in range(rows):
                    activate(y[r * width : r * width + m], kinds[0] and layer + 1 < layers)
            at += (n + 1) * m
        for r in range(rows):
            if not act(work[layers % 2, r], gains, out[begin + r]):
                return -2 - (begin + r)
    return -1
