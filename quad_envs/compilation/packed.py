"""Named values of many arrays behind one array of int64: a call from Python pays for each array it passes.

The fields of a NamedTuple say what they are: `A: Annotated[Array, "1 or N, 12, 12"]` has three axes, of
which the compiler knows the last two. `pack` writes a value as words, an `unpacker` gives it back to a
kernel. A NamedTuple within it stays a `View` there: the address of its words, which kernels pass on as one
number where they would pass on seven for each array, and from which a field is read where it is used.
Nobody counts references to its arrays: whoever packs a value keeps it for as long as the words are in use,
and packs anew after a copy.
"""

from __future__ import annotations

import ctypes
import hashlib
from functools import cache
from typing import Any, NamedTuple, get_args, get_type_hints

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import config
from numba.core.imputils import lower_getattr_generic
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, intrinsic, models, register_model
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

    @property
    def size(self) -> int:
        """How many words it takes."""
        return 1 + sum(size is None for size in self.shape or ())


class _Group(NamedTuple):
    """The fields of a NamedTuple."""

    kind: type
    fields: tuple[Any, ...]  # of _Field and _Group

    @property
    def numba_type(self) -> Any:
        """Of the NamedTuple where it is part of another one."""
        return View(self)

    @property
    def size(self) -> int:
        """How many words it takes."""
        return sum(part.size for part in self.fields)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the fields."""
        return self.kind._fields  # type: ignore[attr-defined, no-any-return]

    def find(self, name: str) -> tuple[Any, int]:
        """A field, and the place of its first word."""
        k = self.names.index(name)
        return self.fields[k], sum(part.size for part in self.fields[:k])


class View(types.Type):
    """The type of a packed NamedTuple in kernels, whose fields are its attributes."""

    def __init__(self, layout: _Group) -> None:
        self.layout = layout
        said = hashlib.sha256(repr((layout.names, layout)).encode()).hexdigest()[:16]
        super().__init__(name=f"View({layout.kind.__module__}.{layout.kind.__qualname__}, {said})")


@register_model(View)
class _ViewModel(models.PrimitiveModel):
    """The address of the first word."""

    def __init__(self, manager: Any, kind: View) -> None:
        super().__init__(manager, kind, _WORD.as_pointer())  # type: ignore[no-untyped-call]


@infer_getattr
class _ViewFields(AttributeTemplate):
    """Fields of views for numba's typing."""

    key = View

    def generic_resolve(self, view: View, name: str) -> Any:  # type: ignore[override]
        """The type of a field; None if there is none of that name."""
        return view.layout.find(name)[0].numba_type if name in view.layout.names else None


@lower_getattr_generic(View)  # type: ignore[untyped-decorator]
def _read_field(context: Any, builder: Any, view: View, first: Any, name: str) -> Any:
    """The compiled value of a field."""
    return _read(context, builder, *view.layout.find(name), first)


@cache  # reading hints takes longer than packing what they describe
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
    kind: type = type(named)
    words: list[int] = []
    for name, part, value in zip(named._fields, _layout(kind).fields, named, strict=True):
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
    whole = types.NamedTuple([part.numba_type for part in layout.fields], kind)
    return _from_words(layout, whole, _rebuild)


def viewer(kind: type) -> Any:
    """As `unpacker`, but what it returns is itself a `View`."""
    layout = _layout(kind)
    return _from_words(layout, View(layout), lambda context, builder, layout, first: first)


def _from_words(layout: _Group, kind: Any, make: Any) -> Any:
    """A function of kernels that makes a value of a numba type from words."""

    def unpack(typing: Any, words: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            first = context.make_array(signature.args[0])(context, builder, arguments[0]).data
            return make(context, builder, layout, first)

        return kind(words), generate

    def unpack_plain(words: IntArray) -> Any:
        return _rebuild_plain(layout, words.tolist())[0]

    return unpack_plain if getattr(config, "DISABLE_JIT", False) else intrinsic(unpack)


def _rebuild(context: Any, builder: Any, group: _Group, first: Any) -> Any:
    """The compiled value of a NamedTuple from its words."""
    kind = types.NamedTuple([part.numba_type for part in group.fields], group.kind)
    values = [_read(context, builder, *group.find(name), first) for name in group.names]
    return context.make_tuple(builder, kind, values)


def _read(context: Any, builder: Any, part: Any, at: int, first: Any) -> Any:
    """The compiled value of one field, whose words begin at a place."""

    def word(k: int) -> Any:
        found = builder.load(builder.gep(first, [ir.Constant(_WORD, at + k)]))
        found.set_metadata("invariant.load", builder.module.add_metadata([]))  # so that loops need it once
        return found

    if isinstance(part, _Group):
        return builder.gep(first, [ir.Constant(_WORD, at)])
    if part.shape is None:
        cast = {types.float64: builder.bitcast, types.boolean: builder.trunc}.get(part.dtype)
        return word(0) if cast is None else cast(word(0), context.get_value_type(part.dtype))
    item = context.get_abi_sizeof(context.get_data_type(part.dtype))
    data = builder.inttoptr(word(0), context.get_data_type(part.dtype).as_pointer())
    unknown = iter(range(1, part.size))
    shape = [word(next(unknown)) if size is None else ir.Constant(_WORD, size) for size in part.shape]
    strides = [ir.Constant(_WORD, item)]
    for size in shape[:0:-1]:
        strides.insert(0, builder.mul(strides[0], size))
    array = context.make_array(part.numba_type)(context, builder)
    arrayobj.populate_array(array, data, shape, strides, ir.Constant(_WORD, item), None)
    return array._getvalue()


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
