"""What a kernel is made of, as one number: its code and all that this code can reach.

Comments, docstrings, line numbers and what other kernels of the same module do leave the number as it is. A
changed constant does not, in whatever module it stands, nor does another option of compilation.
"""

from __future__ import annotations

import dataclasses
import enum
import hashlib
import sys
from collections.abc import Callable, Iterator
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types

_FOREIGN = {*sys.stdlib_module_names, "llvmlite", "numba", "numpy", "scipy"}  # their versions stand for them
_PLAIN = (int, float, complex, str, bytes, bool, slice, type(None), type(Ellipsis), np.generic, np.dtype)
_NUMBERED = (types.Type, ir.Type)  # whose text says all of them


def digest(function: Callable[..., Any]) -> str:
    """Hex digest of a function or kernel and of everything of ours that its code can reach.

    Call it when the modules are complete: kernels may use names that are defined below them.
    """
    walk = _Walk()
    return hashlib.sha256("\n".join([walk.describe(function), *walk.finish()]).encode()).hexdigest()


class _Walk:
    """Goes from a function to what it reaches. Functions are numbered as they are met, since names repeat."""

    def __init__(self) -> None:
        self._numbers: dict[int, int] = {}
        self._functions: list[FunctionType] = []

    def finish(self) -> Iterator[str]:
        """The text of every function met, and of those that are met on the way."""
        k = 0
        while k < len(self._functions):
            function = self._functions[k]
            yield f"{k}: {function.__module__}.{function.__qualname__}"
            yield from _code(function.__code__, function.__doc__)
            for name, value in _reached(function):
                yield f"{name} = {self.describe(value)}"
            k += 1

    def describe(self, value: Any) -> str:
        """One value as text; a function as its number, and it waits for its turn."""
        function = getattr(value, "py_func", None) or getattr(
            value, "_defn", value
        )  # of kernels, of intrinsics
        if isinstance(function, FunctionType):
            return self._describe_function(function, getattr(value, "targetoptions", {}))
        if isinstance(value, type):
            return self._describe_type(value)
        if isinstance(value, np.ndarray) and value.dtype != object:
            return repr((value.dtype.str, value.shape, value.tobytes()))
        if isinstance(value, _PLAIN) or isinstance(value, _NUMBERED):
            return f"{type(value).__qualname__} {value!r}"
        return f"{self.describe(type(value))} of {self._parts(value)}"

    def _parts(self, value: Any) -> str:
        """What a value that is made of others consists of; the name of whatever else it is."""
        if isinstance(value, tuple | list):
            return repr([self.describe(part) for part in value])
        if isinstance(value, set | frozenset):
            return repr(sorted(self.describe(part) for part in value))
        if isinstance(value, dict):
            return repr([(self.describe(key), self.describe(part)) for key, part in value.items()])
        if dataclasses.is_dataclass(value):
            return repr(
                [
                    (field.name, self.describe(getattr(value, field.name)))
                    for field in dataclasses.fields(value)
                ]
            )
        return str(getattr(value, "__qualname__", getattr(value, "__name__", "")))

    def _describe_function(self, function: FunctionType, options: dict[str, Any]) -> str:
        name = f"{function.__module__}.{function.__qualname__}"
        if _root(function.__module__) in _FOREIGN:
            return name
        if id(function) not in self._numbers:
            self._numbers[id(function)] = len(self._functions)
            self._functions.append(function)
        chosen = sorted((option, self.describe(value)) for option, value in options.items())
        return f"{name} #{self._numbers[id(function)]} {chosen}"

    def _describe_type(self, kind: type) -> str:
        text = f"{kind.__module__}.{kind.__qualname__}"
        if issubclass(kind, enum.Enum):
            return f"{text} {[(member.name, self.describe(member.value)) for member in kind]}"
        if issubclass(kind, tuple) and hasattr(kind, "_fields"):
            return f"{text} {kind._fields} {self.describe(getattr(kind, '_field_defaults', {}))}"
        return text


def _root(module: str | None) -> str:
    """The package of a module."""
    return (module or "").partition(".")[0]


def _code(code: CodeType, docstring: str | None = None) -> Iterator[str]:
    """What makes a code object behave as it does. Its flags are left out: profilers change them."""
    counts = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount
    yield repr((code.co_code, code.co_names, code.co_varnames, code.co_freevars, counts))
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _code(constant)
        elif constant != docstring:
            yield repr(sorted(constant, key=repr) if isinstance(constant, frozenset) else constant)


def _names(code: CodeType) -> set[str]:
    """Names that a code object reads from its module or from other objects."""
    inner = (constant for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*map(_names, inner))


def _reached(function: FunctionType) -> Iterator[tuple[str, Any]]:
    """What the code of a function can reach: globals, attributes of modules, closure, defaults."""
    names = _names(function.__code__)
    yield from _read_from(function.__globals__, names, "", {id(function.__globals__)})
    yield "defaults", (function.__defaults__, function.__kwdefaults__)
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        yield name, cell.cell_contents
        if isinstance(cell.cell_contents, ModuleType):
            yield from _read_from(vars(cell.cell_contents), names, f"{name}.", set())


def _read_from(
    namespace: dict[str, Any], names: set[str], prefix: str, met: set[int]
) -> Iterator[tuple[str, Any]]:
    """Values of these names in a module, and in modules of ours that it names."""
    for name in sorted(names & namespace.keys()):
        value = namespace[name]
        yield f"{prefix}{name}", value
        if (
            isinstance(value, ModuleType)
            and _root(value.__name__) not in _FOREIGN
            and id(vars(value)) not in met
        ):
            yield from _read_from(vars(value), names, f"{prefix}{name}.", met | {id(vars(value))})
