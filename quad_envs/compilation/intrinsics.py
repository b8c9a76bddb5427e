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

    A row of previews, see `references.table_row`, has the position in doubles. Both arrays are C-contiguous.
    """
    out[start : start + 3] = previews[row, :6].view(np.float64) - np.array(p)
    out[start + 3 : start + 8] = previews[row, 6:11]


def _take_nearest(places: Array, at: int, lanes: int) -> None:
    """Take squared distances of four places from each other and all later ones into the smallest so far.

    From places[at] on, and again behind them, stand four x, four y, four z and the four squared distances.

    Args:
        places: Of all, (16 blocks,).
        at: Where the four stand.
        lanes: Of how many of them the others of the four take the distance.
    """
    four, later = places[at : at + 16].reshape(4, 4), places[at + 16 :].reshape(-1, 4, 4)
    apart = later[:, :3, None, :] - four[:3, :, None]
    square = apart[:, 0] ** 2 + apart[:, 1] ** 2 + apart[:, 2] ** 2
    later[:, 3] = np.fmin(later[:, 3], np.fmin.reduce(square, axis=1))
    four[3] = np.fmin(four[3], np.fmin.reduce(square, axis=(0, 2), initial=np.inf))
    for j in range(lanes):
        x, y, z = four[:3] - four[:3, j : j + 1]
        square = x**2 + y**2 + z**2
        square[j] = np.inf
        four[3] = np.fmin(four[3], square)


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


_DOUBLES, _LANE, _WORD = ir.VectorType(ir.DoubleType(), 4), ir.IntType(32), ir.IntType(64)


def _four_from(builder: Any, data: Any, start: Any, k: int) -> Any:
    """The address of the k-th four doubles from a place on."""
    place = builder.add(start, ir.Constant(_WORD, 4 * k))
    return builder.bitcast(builder.gep(data, [place]), _DOUBLES.as_pointer())


def _squares(builder: Any, rows: list[Any], point: list[Any]) -> Any:
    """Squared distances of a point to four others."""
    square = None
    for row, place in zip(rows, point, strict=True):
        first = builder.insert_element(ir.Constant(_DOUBLES, ir.Undefined), place, ir.Constant(_LANE, 0))
        broadcast = builder.shuffle_vector(first, first, ir.Constant(ir.VectorType(_LANE, 4), [0] * 4))
        apart = builder.fsub(row, broadcast)
        part = builder.fmul(apart, apart)
        square = part if square is None else builder.fadd(square, part)
    return square


def _smaller(builder: Any, x: Any, y: Any) -> Any:
    """The smaller of each; y where x is no number."""
    return builder.select(builder.fcmp_ordered("<", x, y), x, y)


def _nearest_in_registers(typing: Any, places: Any, at: Any, lanes: Any) -> Any:
    """`_take_nearest` on four doubles at once; that of two places is computed once, for both ends."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(places)(context, builder, arguments[0])
        own = [_four_from(builder, array.data, arguments[1], k) for k in range(4)]
        *rows, nearest = (builder.load(place, align=8) for place in own)
        four = [[builder.extract_element(row, ir.Constant(_LANE, j)) for row in rows] for j in range(4)]
        infinite = ir.Constant(_DOUBLES, [float("inf")] * 4)
        for j, point in enumerate(four):
            far, itself = ir.Constant(ir.DoubleType(), float("inf")), ir.Constant(_LANE, j)
            square = builder.insert_element(_squares(builder, rows, point), far, itself)
            counts = builder.icmp_signed("<", ir.Constant(_WORD, j), arguments[2])
            nearest = _smaller(builder, builder.select(counts, square, infinite), nearest)
        back = [cgutils.alloca_once_value(builder, infinite) for _ in four]
        step = ir.Constant(_WORD, 16)
        start, stop = builder.add(arguments[1], step), cgutils.unpack_tuple(builder, array.shape)[0]
        with cgutils.for_range_slice(builder, start, stop, step) as (later, _):
            addresses = [_four_from(builder, array.data, later, k) for k in range(4)]
            *others, found = (builder.load(address, align=8) for address in addresses)
            for point, smallest in zip(four, back, strict=True):
                square = _squares(builder, others, point)
                builder.store(_smaller(builder, square, builder.load(smallest)), smallest)
                found = _smaller(builder, square, found)
            builder.store(found, addresses[3], align=8)
        across = _smallest_of_each(builder, [builder.load(smallest) for smallest in back])
        builder.store(_smaller(builder, across, nearest), own[3], align=8)
        return context.get_dummy_value()

    return types.void(places, types.intp, types.intp), generate


def _smallest_of_each(builder: Any, vectors: list[Any]) -> Any:
    """The smallest entry of each of four vectors."""

    def halves(x: Any, y: Any, *lanes: list[int]) -> Any:
        kind = ir.VectorType(_LANE, 4)
        return _smaller(builder, *(builder.shuffle_vector(x, y, ir.Constant(kind, each)) for each in lanes))

    pairs = [halves(*vectors[k : k + 2], [0, 4, 2, 6], [1, 5, 3, 7]) for k in (0, 2)]
    return halves(*pairs, [0, 1, 4, 5], [2, 3, 6, 7])


write_stage: Any
take_nearest: Any
borrowed: Any
fetch: Any
bits_of: Any
number_of: Any
if getattr(config, "DISABLE_JIT", False):
    take_nearest = _take_nearest
    write_stage, borrowed = _write_stage, _borrowed
    bits_of, number_of, fetch = _bits_of, _number_of, _fetch
else:
    write_stage, borrowed = intrinsic(_in_registers), intrinsic(_without_count)
    take_nearest = intrinsic(_nearest_in_registers)
    bits_of, number_of = intrinsic(_cast_to_bits), intrinsic(_cast_to_number)
    fetch = intrinsic(_ask_for_lines)
