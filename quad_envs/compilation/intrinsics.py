"""What numba does not offer: vector registers where loops are too short, and views that nobody counts.

Numba runs LLVM without the pass that puts neighbouring assignments together. Each function has a twin for
kernels that run as plain Python (NUMBA_DISABLE_JIT).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils, config
from numba.extending import intrinsic
from numpy.typing import NDArray

from ..plant import Array

_LINE = 64  # bytes of the cache


def _write_stage(
    out: NDArray[np.float32],
    start: int,
    previews: NDArray[np.float32],
    row: int,
    p: tuple[float, float, float],
) -> None:
    """Write a stage of a preview, eight numbers out[start:]: position - p, velocity, sine, cosine.

    A row of previews, see `table_row`, has the position in doubles. Both arrays are C-contiguous.
    """
    out[start : start + 3] = previews[row, :6].view(np.float64) - np.array(p)
    out[start + 3 : start + 8] = previews[row, 6:11]


def _take_nearer(places: Array, at: int, x: float, y: float, z: float) -> None:
    """Take the squared distances of four places to (x, y, z) into the smallest ones so far.

    From places[at] on stand four x, four y, four z and the four squared distances.
    """
    four = places[at : at + 16].reshape(4, 4)
    square = (four[0] - x) ** 2 + (four[1] - y) ** 2 + (four[2] - z) ** 2
    four[3] = np.minimum(square, four[3])


def _fetch(table: Array | NDArray[np.float32], row: int, rows: int) -> None:
    """Ask for rows row..row+rows-1 of a C-contiguous table, that they be in the cache when they are read."""


def _borrowed(array: Any) -> Any:
    """The same array, of which references are not counted: whoever called the kernel keeps it."""
    return array


def _without_count(typing: Any, array: Any) -> Any:
    """`_borrowed` as an array that nobody owns."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        found = context.make_array(array)(context, builder, arguments[0])
        found.meminfo = cgutils.get_null_value(found.meminfo.type)
        found.parent = cgutils.get_null_value(found.parent.type)
        return found._getvalue()

    return array(array), generate


def _bits_of(x: float) -> np.uint64:
    """The 64 bits of a double."""
    return np.float64(x).view(np.uint64)


def _number_of(bits: np.uint64) -> float:
    """The double of 64 bits."""
    return float(np.uint64(bits).view(np.float64))


def _cast_to_bits(typing: Any, x: Any) -> Any:
    """`_bits_of` without an instruction."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.IntType(64))

    return types.uint64(types.float64), generate


def _cast_to_number(typing: Any, bits: Any) -> Any:
    """`_number_of` without an instruction."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.DoubleType())

    return types.float64(types.uint64), generate


def _ask_for_lines(typing: Any, table: Any, row: Any, rows: Any) -> Any:
    """`_fetch` as one instruction for each line of the cache."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(table)(context, builder, arguments[0])
        width = cgutils.unpack_tuple(builder, array.shape)[1]
        first = builder.gep(array.data, [builder.mul(arguments[1], width)])
        size = context.get_abi_sizeof(context.get_data_type(table.dtype))
        count, per_line = builder.mul(arguments[2], width), ir.Constant(ir.IntType(64), _LINE // size)
        flag, place = ir.IntType(32), ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [place, flag, flag, flag])
        ask = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        to_read, keep, data = (ir.Constant(flag, k) for k in (0, 3, 1))
        with cgutils.for_range_slice(builder, ir.Constant(ir.IntType(64), 0), count, per_line) as (at, _):
            line = builder.bitcast(builder.gep(first, [at]), place)
            builder.call(ask, [line, to_read, keep, data])
        return context.get_dummy_value()

    return types.void(table, types.intp, types.intp), generate


def _in_registers(typing: Any, out: Any, start: Any, previews: Any, row: Any, p: Any) -> Any:
    """`_write_stage` as four doubles that become floats, three of which go before five that lie ready."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        out_array = context.make_array(out)(context, builder, arguments[0])
        previews_array = context.make_array(previews)(context, builder, arguments[2])
        width = cgutils.unpack_tuple(builder, previews_array.shape)[1]
        target = builder.gep(out_array.data, [arguments[1]])
        source = builder.gep(previews_array.data, [builder.mul(arguments[3], width)])
        doubles, floats = ir.VectorType(ir.DoubleType(), 4), ir.VectorType(ir.FloatType(), 4)
        whole, lane = ir.VectorType(ir.FloatType(), 8), ir.IntType(32)
        position = builder.load(builder.bitcast(source, doubles.as_pointer()), align=8)
        shift = ir.Constant(doubles, [0.0] * 4)
        for i, value in enumerate(cgutils.unpack_tuple(builder, arguments[4])):
            shift = builder.insert_element(shift, value, ir.Constant(lane, i))
        near = builder.fptrunc(builder.fsub(position, shift), floats)
        near = builder.shuffle_vector(near, near, ir.Constant(ir.VectorType(lane, 8), [0, 1, 2, *[0] * 5]))
        behind = builder.gep(source, [ir.Constant(ir.IntType(64), 3)])  # that 6 words behind comes to place 3
        far = builder.load(builder.bitcast(behind, whole.as_pointer()), align=4)
        places = ir.Constant(ir.VectorType(lane, 8), [0, 1, 2, *range(8 + 3, 8 + 8)])
        builder.store(
            builder.shuffle_vector(near, far, places), builder.bitcast(target, whole.as_pointer()), align=4
        )
        return context.get_dummy_value()

    return types.void(out, types.intp, previews, types.intp, p), generate


def _nearer_in_registers(typing: Any, places: Any, at: Any, x: Any, y: Any, z: Any) -> Any:
    """`_take_nearer` on four doubles at once."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(places)(context, builder, arguments[0]).data
        doubles, lane = ir.VectorType(ir.DoubleType(), 4), ir.IntType(32)

        def row(k: int) -> Any:
            start = builder.add(arguments[1], ir.Constant(ir.IntType(64), 4 * k))
            return builder.bitcast(builder.gep(data, [start]), doubles.as_pointer())

        square = None
        for k, place in enumerate(arguments[2:]):
            first = builder.insert_element(ir.Constant(doubles, ir.Undefined), place, ir.Constant(lane, 0))
            broadcast = builder.shuffle_vector(first, first, ir.Constant(ir.VectorType(lane, 4), [0] * 4))
            apart = builder.fsub(builder.load(row(k), align=8), broadcast)
            part = builder.fmul(apart, apart)
            square = part if square is None else builder.fadd(square, part)
        nearest = builder.load(row(3), align=8)
        nearer = builder.fcmp_ordered("<", square, nearest)
        builder.store(builder.select(nearer, square, nearest), row(3), align=8)
        return context.get_dummy_value()

    return types.void(places, types.intp, types.float64, types.float64, types.float64), generate


write_stage: Any
take_nearer: Any
borrowed: Any
fetch: Any
bits_of: Any
number_of: Any
if getattr(config, "DISABLE_JIT", False):
    take_nearer = _take_nearer
    write_stage, borrowed = _write_stage, _borrowed
    bits_of, number_of, fetch = _bits_of, _number_of, _fetch
else:
    write_stage, borrowed = intrinsic(_in_registers), intrinsic(_without_count)
    take_nearer = intrinsic(_nearer_in_registers)
    bits_of, number_of = intrinsic(_cast_to_bits), intrinsic(_cast_to_number)
    fetch = intrinsic(_ask_for_lines)
