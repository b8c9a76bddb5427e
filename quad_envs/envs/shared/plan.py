"""The arrays of a batch behind a single one, their plan: a call from Python pays for every array it passes.

A plan holds address and shape of each array. Whoever makes one keeps the arrays, and makes another one
for a copy.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import carray  # type: ignore[attr-defined]
from numpy.typing import NDArray

from ..._intrinsics import floats_at, integers_at
from ..._numba import Int, inline_kernel
from ...plant import Array

IntArray = NDArray[np.int64]
_SIZES = 4  # of a shape
_ENTRY = 1 + _SIZES


def make_plan(arrays: tuple[NDArray[Any], ...]) -> IntArray:
    """Addresses and shapes of C-contiguous arrays of float64 or int64 with at most four axes."""
    plan = np.zeros((len(arrays), _ENTRY), dtype=np.int64)
    for entry, array in zip(plan, arrays, strict=True):
        assert array.flags.c_contiguous and array.ndim <= _SIZES and array.dtype.itemsize == 8
        entry[0], entry[1 : 1 + array.ndim] = array.ctypes.data, array.shape
    return plan


# Array k of a plan, by its kind and number of axes.
@inline_kernel
def floats_1(plan: IntArray, k: Int) -> Array:
    """A float64 array with one axis."""
    return carray(floats_at(plan[k, 0]), (plan[k, 1],))


@inline_kernel
def floats_2(plan: IntArray, k: Int) -> Array:
    """A float64 array with two axes."""
    return carray(floats_at(plan[k, 0]), (plan[k, 1], plan[k, 2]))


@inline_kernel
def floats_3(plan: IntArray, k: Int) -> Array:
    """A float64 array with three axes."""
    return carray(floats_at(plan[k, 0]), (plan[k, 1], plan[k, 2], plan[k, 3]))


@inline_kernel
def floats_4(plan: IntArray, k: Int) -> Array:
    """A float64 array with four axes."""
    return carray(floats_at(plan[k, 0]), (plan[k, 1], plan[k, 2], plan[k, 3], plan[k, 4]))


@inline_kernel
def integers_1(plan: IntArray, k: Int) -> IntArray:
    """An int64 array with one axis."""
    return carray(integers_at(plan[k, 0]), (plan[k, 1],))


@inline_kernel
def integers_2(plan: IntArray, k: Int) -> IntArray:
    """An int64 array with two axes."""
    return carray(integers_at(plan[k, 0]), (plan[k, 1], plan[k, 2]))
