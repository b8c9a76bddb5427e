"""Products of rows with a matrix in vector registers: sums in the order of inputs, rounded once a term.

A sum has the same bits in every tile, however many rows and outputs stand beside it: fused multiply-adds
are exact but for one rounding, and nothing may reorder them. Each tile has a twin for kernels that run as
plain Python (NUMBA_DISABLE_JIT).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils, config
from numba.extending import intrinsic
from numpy.typing import NDArray

Floats = NDArray[np.float32]

TILE_ROWS = 4  # of `multiply_rows`
STRIP = 16  # outputs whose weights stand together, and of a tile
_LANES = 8  # numbers of a vector register


def packed(weights: Floats, bias: Floats) -> Floats:
    """Weights (n, m) and bias (m,) as the tiles read them, flat: strips of outputs, the last one padded.

    Of each strip there are the weights of the first input, of the second, ..., and the bias.
    """
    n, m = weights.shape
    rows = np.zeros((n + 1, -(-m // STRIP) * STRIP), dtype=np.float32)
    rows[:n, :m], rows[n, :m] = weights, bias
    return np.ascontiguousarray(rows.reshape(n + 1, -1, STRIP).swapaxes(0, 1)).ravel()


def _plain(rows: int, strips: int) -> Any:
    """A function that writes bias + weights x for so many rows and strips of outputs, in readable numpy."""

    def multiply(
        x: Floats, x_at: int, width: int, n: int, weights: Floats, at: int, out: Floats, out_at: int
    ) -> None:
        """Write the outputs of one tile; arrays are flat.

        Args:
            x: Inputs.
            x_at: Where the first row begins.
            width: From row to row, of x and of out.
            n: Number of inputs.
            weights: As `packed` gives them.
            at: Where the first strip begins.
            out: Result.
            out_at: Where the first output of the first row goes.
        """
        for r in range(rows):
            for strip in range(strips):
                begin = at + strip * (n + 1) * STRIP
                terms = weights[begin : begin + (n + 1) * STRIP].reshape(n + 1, STRIP)
                total = terms[n]
                for i in range(n):  # the product of two floats is exact in doubles
                    total = (np.float64(x[x_at + r * width + i]) * terms[i] + total).astype(np.float32)
                start = out_at + r * width + strip * STRIP
                out[start : start + STRIP] = total

    return multiply


def _tile(rows: int, strips: int) -> Any:
    """What `_plain` makes, for compiled kernels: sums in registers."""
    vector, lane, word = ir.VectorType(ir.FloatType(), _LANES), ir.IntType(32), ir.IntType(64)
    first, mask = ir.Constant(lane, 0), ir.Constant(ir.VectorType(lane, _LANES), [0] * _LANES)
    parts = STRIP // _LANES  # registers of a strip

    @intrinsic
    def multiply(
        typing: Any, x: Any, x_at: Any, width: Any, n: Any, weights: Any, at: Any, out: Any, out_at: Any
    ) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            x_at, width, n, at, out_at = (arguments[k] for k in (1, 2, 3, 5, 7))
            x, weights, out = (
                context.make_array(signature.args[k])(context, builder, arguments[k]).data for k in (0, 4, 6)
            )
            kind = ir.FunctionType(vector, [vector] * 3)
            fma = cgutils.get_or_insert_function(builder.module, kind, f"llvm.fma.v{_LANES}f32")

            def place(array: Any, start: Any, *steps: tuple[Any, int]) -> Any:
                for step, times in steps:
                    start = builder.add(start, builder.mul(step, ir.Constant(word, times)))
                return builder.bitcast(builder.gep(array, [start]), vector.as_pointer())

            one = ir.Constant(word, 1)
            strip = builder.mul(builder.add(n, one), ir.Constant(word, STRIP))  # its length
            columns = [((strip, k // parts), (one, k % parts * _LANES)) for k in range(strips * parts)]
            bias = builder.add(at, builder.mul(n, ir.Constant(word, STRIP)))
            sums = [[cgutils.alloca_once(builder, vector) for _ in columns] for _ in range(rows)]
            for k, column in enumerate(columns):
                begin = builder.load(place(weights, bias, *column), align=4)
                for row in sums:
                    builder.store(begin, row[k])
            with cgutils.for_range(builder, n) as loop:
                here = builder.add(at, builder.mul(loop.index, ir.Constant(word, STRIP)))
                factors = [builder.load(place(weights, here, *column), align=4) for column in columns]
                for r, row in enumerate(sums):
                    entry = builder.add(
                        builder.add(x_at, builder.mul(width, ir.Constant(word, r))), loop.index
                    )
                    value = builder.load(builder.gep(x, [entry]), align=4)
                    alone = builder.insert_element(ir.Constant(vector, ir.Undefined), value, first)
                    lanes = builder.shuffle_vector(alone, alone, mask)
                    for factor, total in zip(factors, row, strict=True):
                        builder.store(builder.call(fma, [lanes, factor, builder.load(total)]), total)
            for r, row in enumerate(sums):
                for k, total in enumerate(row):
                    target = place(out, out_at, (width, r), (one, k * _LANES))
                    builder.store(builder.load(total), target, align=4)
            return context.get_dummy_value()

        whole = types.intp
        return types.void(x, whole, whole, whole, weights, whole, out, whole), generate

    return multiply


_made = _plain if getattr(config, "DISABLE_JIT", False) else _tile
multiply_rows = _made(TILE_ROWS, 1)  # as many sums as hide the time of a multiply-add
multiply_row = _made(1, 1)
multiply_row_wide = _made(1, 4)  # the same for one row
WIDE = 4 * STRIP
