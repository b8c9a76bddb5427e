"""Four neighbouring numbers as one value of compiled code, a quad, which lives in a vector register.

Numba runs LLVM without the pass that puts straight code side by side, and a short loop is unrolled before the
pass for loops sees it: of small matrices nothing is left for vectors. Here kernels say themselves what goes
side by side. Sums keep their order; where the processor can, a product and a sum round once.

Arrays are C-contiguous float64, and no index counts from the end. Each function has a plain form for kernels
that run as Python (NUMBA_DISABLE_JIT).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils, config
from numba.extending import intrinsic, models, register_model

from quad_envs.parameters import Array

WIDTH = 4  # numbers in a quad
_REGISTER = ir.VectorType(ir.DoubleType(), WIDTH)
_LANES = ir.VectorType(ir.IntType(32), WIDTH)


class _Quad(types.Type):
    """Numba's type of a quad."""

    def __init__(self) -> None:
        super().__init__(name="Quad")


@register_model(_Quad)
class _QuadModel(models.PrimitiveModel):
    """A quad is a vector register."""

    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _REGISTER)  # type: ignore[no-untyped-call]


_QUAD = _Quad()


def _plain_entry(matrix: Array, i: int, j: int) -> float:
    """matrix[i, j]."""
    return float(matrix[i, j])


def _plain_load(matrix: Array, i: int, j: int) -> Any:
    """matrix[i, j : j + 4]."""
    return matrix[i, j : j + WIDTH].copy()


def _plain_load_part(vector: Array, j: int) -> Any:
    """vector[j : j + 4]."""
    return vector[j : j + WIDTH].copy()


def _plain_store(quad: Any, matrix: Array, i: int, j: int) -> None:
    """matrix[i, j : j + 4] = quad."""
    matrix[i, j : j + WIDTH] = quad


def _plain_store_part(quad: Any, vector: Array, j: int) -> None:
    """vector[j : j + 4] = quad."""
    vector[j : j + WIDTH] = quad


def _plain_zero() -> Any:
    """Four zeros."""
    return np.zeros(WIDTH)


def _plain_add_scaled(total: Any, factor: float, quad: Any) -> Any:
    """Total + factor * quad, for a number factor."""
    return total + factor * quad


def _plain_transposed(a: Any, b: Any, c: Any, d: Any) -> Any:
    """The four columns of the block with rows a, b, c, d."""
    return tuple(np.stack((a, b, c, d), axis=1))


def _address(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    """Pointer to an entry of an array."""
    view = context.make_array(kind)(context, builder, array)
    return cgutils.get_item_pointer(context, builder, kind, view, index, wraparound=False)


def _generate_load(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Of arguments array, *index."""
    place = _address(context, builder, signature.args[0], arguments[0], arguments[1:])
    return builder.load(builder.bitcast(place, _REGISTER.as_pointer()), align=8)


def _generate_store(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Of arguments quad, array, *index."""
    place = _address(context, builder, signature.args[1], arguments[1], arguments[2:])
    builder.store(arguments[0], builder.bitcast(place, _REGISTER.as_pointer()), align=8)
    return context.get_dummy_value()


def _entry(typing: Any, matrix: Any, i: Any, j: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_address(context, builder, signature.args[0], arguments[0], arguments[1:]))

    return types.float64(matrix, types.intp, types.intp), generate


def _load(typing: Any, matrix: Any, i: Any, j: Any) -> Any:
    return _QUAD(matrix, types.intp, types.intp), _generate_load


def _load_part(typing: Any, vector: Any, j: Any) -> Any:
    return _QUAD(vector, types.intp), _generate_load


def _store(typing: Any, quad: Any, matrix: Any, i: Any, j: Any) -> Any:
    return types.void(_QUAD, matrix, types.intp, types.intp), _generate_store


def _store_part(typing: Any, quad: Any, vector: Any, j: Any) -> Any:
    return types.void(_QUAD, vector, types.intp), _generate_store


def _zero(typing: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return ir.Constant(_REGISTER, [0.0] * WIDTH)

    return _QUAD(), generate


def _add_scaled(typing: Any, total: Any, factor: Any, quad: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        total, factor, quad = arguments
        nothing, first = ir.Constant(_REGISTER, ir.Undefined), ir.Constant(ir.IntType(32), 0)
        one = builder.insert_element(nothing, factor, first)
        factors = builder.shuffle_vector(one, nothing, ir.Constant(_LANES, [0] * WIDTH))
        return builder.fadd(total, builder.fmul(factors, quad, flags=["contract"]), flags=["contract"])

    return _QUAD(_QUAD, types.float64, _QUAD), generate


def _transposed(typing: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def mixed(left: Any, right: Any, lanes: list[int]) -> Any:
            return builder.shuffle_vector(left, right, ir.Constant(_LANES, lanes))

        a, b, c, d = arguments
        even, odd, low, high = [0, 4, 2, 6], [1, 5, 3, 7], [0, 1, 4, 5], [2, 3, 6, 7]
        evens, odds = (mixed(a, b, even), mixed(c, d, even)), (mixed(a, b, odd), mixed(c, d, odd))
        columns = [mixed(*pair, half) for half in (low, high) for pair in (evens, odds)]
        return context.make_tuple(builder, signature.return_type, columns)

    return types.UniTuple(_QUAD, WIDTH)(_QUAD, _QUAD, _QUAD, _QUAD), generate


def _compiled(generator: Any, plain: Any) -> Any:
    """What kernels call: the generator of code, or the plain form where kernels run as Python."""
    return plain if getattr(config, "DISABLE_JIT", False) else intrinsic(generator)


entry = _compiled(_entry, _plain_entry)
load = _compiled(_load, _plain_load)
load_part = _compiled(_load_part, _plain_load_part)
store = _compiled(_store, _plain_store)
store_part = _compiled(_store_part, _plain_store_part)
zero = _compiled(_zero, _plain_zero)
add_scaled = _compiled(_add_scaled, _plain_add_scaled)
transposed = _compiled(_transposed, _plain_transposed)
