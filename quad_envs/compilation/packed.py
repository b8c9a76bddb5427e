"""Named values of many arrays behind one array of int64: a call from Python pays for each array it passes.

The fields of a NamedTuple say what they are: `A: Annotated[Array, "1 or N, 12, 12"]` has three axes, of
which the compiler knows the last two. `pack` writes a value as words, an `unpacker` gives it back to a
kernel. There nobody counts references to its arrays, which spares a call at each view: whoever packs a
value keeps it for as long as the words are in use, and packs anew after a copy.
"""

from __future__ import annotations

import ctypes
from typing import Any, NamedTuple, get_args, get_type_hints

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import config
from numba.extending import intrinsic
from numba.np import arrayobj
from numba.np.numpy_support import from_dtype
from numpy.typing import NDArray

IntArray = NDArray[np.int64]
_WORD = ir.IntType(64)
_SCALARS = {float: types.float64, int: types.int64, bool: types.boolean}


class _Field(NamedTuple):
    """One array or number of a packed value."""

    dtype: Any  # numba's type of the number or of the entries
    shape: tuple[int | None, ...] | None  # None in it: only the words know; None: a number

    @property
    def numba_type(self) -> Any:
        """Of the field."""
        return self.dtype if self.shape is None else types.Array(self.dtype, len(self.shape), "C")


class _Group(NamedTuple):
    """The fields of a NamedTuple."""

    kind: type
    fields: tuple[Any, ...]  # of _Field and _Group

    @property
    def numba_type(self) -> Any:
        """Of the NamedTuple."""
        return types.NamedTuple([field.numba_type for field in self.fields], self.kind)


def _layout(kind: type) -> _Group:
    """What the annotations of a NamedTuple say."""
    found: list[Any] = []
    for hint in get_type_hints(kind, include_extras=True).values():
        if hasattr(hint, "__metadata__"):
            dtype = np.dtype(get_args(get_args(hint.__origin__)[1])[0])
            sizes = [size.strip() for size in hint.__metadata__[0].split(",")]
            shape = tuple(int(size) if size.isdigit() else None for size in sizes)
            found.append(_Field(from_dtype(dtype), shape))
        else:
            found.append(_Field(_SCALARS[hint], None) if hint in _SCALARS else _layout(hint))
    return _Group(kind, tuple(found))


def pack(named: Any) -> IntArray:
    """A NamedTuple as words; valid for as long as its arrays live.

    Raises:
        TypeError: If a field is not what its annotation says.
    """
    words: list[int] = []
    for name, part, value in zip(named._fields, _layout(type(named)).fields, named, strict=True):
        if isinstance(part, _Group):
            words += pack(value).tolist()
        elif part.shape is None:
            dtype = np.float64 if part.dtype == types.float64 else np.int64
            words.append(int(np.array(value, dtype).view(np.int64)))
        else:
            if not _fits(value, part):
                got = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else repr(value)
                raise TypeError(
                    f"{type(named).__name__}.{name} must be a writeable C-contiguous array of {part.dtype}, "
                    f"shape {part.shape}, got {got}"
                )
            sizes = zip(part.shape, value.shape, strict=True)
            words += [value.ctypes.data, *(found for size, found in sizes if size is None)]
    return np.array(words, np.int64)


def _fits(value: Any, field: _Field) -> bool:
    """Whether a value is what the annotation of its field says."""
    return (
        isinstance(value, np.ndarray)
        and value.ndim == len(field.shape or ())
        and from_dtype(value.dtype) == field.dtype
        and value.flags.c_contiguous
        and value.flags.writeable
        and all(size in (None, found) for size, found in zip(field.shape or (), value.shape, strict=True))
    )


def unpacker(kind: type) -> Any:
    """The function of kernels that takes the words of a packed NamedTuple of this kind and returns it."""
    layout = _layout(kind)

    def unpack(typing: Any, words: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            first = context.make_array(signature.args[0])(context, builder, arguments[0]).data
            return _rebuild(context, builder, layout, first, 0)[0]

        return layout.numba_type(words), generate

    def unpack_plain(words: IntArray) -> Any:
        return _rebuild_plain(layout, words.tolist())[0]

    return unpack_plain if getattr(config, "DISABLE_JIT", False) else intrinsic(unpack)


def _rebuild(context: Any, builder: Any, group: _Group, first: Any, at: int) -> tuple[Any, int]:
    """The compiled value of a NamedTuple from its words, and the place of the next word."""
    values = []

    def next_word() -> Any:
        nonlocal at
        at += 1
        return builder.load(builder.gep(first, [ir.Constant(_WORD, at - 1)]))

    for part in group.fields:
        if isinstance(part, _Group):
            value, at = _rebuild(context, builder, part, first, at)
        elif part.shape is None:
            word, target = next_word(), context.get_value_type(part.dtype)
            cast = {types.float64: builder.bitcast, types.boolean: builder.trunc}.get(part.dtype)
            value = word if cast is None else cast(word, target)
        else:
            item = context.get_abi_sizeof(context.get_data_type(part.dtype))
            data = builder.inttoptr(next_word(), context.get_data_type(part.dtype).as_pointer())
            shape = [next_word() if size is None else ir.Constant(_WORD, size) for size in part.shape]
            strides = [ir.Constant(_WORD, item)]
            for size in shape[:0:-1]:
                strides.insert(0, builder.mul(strides[0], size))
            view = context.make_array(part.numba_type)(context, builder)
            arrayobj.populate_array(view, data, shape, strides, ir.Constant(_WORD, item), None)
            value = view._getvalue()
        values.append(value)
    return context.make_tuple(builder, group.numba_type, values), at


def _rebuild_plain(group: _Group, words: list[int]) -> tuple[Any, list[int]]:
    """As `_rebuild`, where kernels run as Python; returns the words that are left."""
    values: list[Any] = []
    for part in group.fields:
        if isinstance(part, _Group):
            value, words = _rebuild_plain(part, words)
        elif part.shape is None:
            word, words = words[0], words[1:]
            value = float(np.int64(word).view(np.float64)) if part.dtype == types.float64 else word
        else:
            address, words = words[0], words[1:]
            shape = []
            for size in part.shape:
                shape.append(words[0] if size is None else size)
                words = words[1:] if size is None else words
            dtype = np.dtype(part.dtype.name)
            memory = (ctypes.c_byte * (int(np.prod(shape)) * dtype.itemsize)).from_address(address)
            value = np.ndarray(shape, dtype, memory)
        values.append(value)
    return group.kind(*values), words
