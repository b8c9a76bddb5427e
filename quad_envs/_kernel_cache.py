"""Compiled kernels on disk, found again by what they are made of; never a reason not to start.

A kernel's file is named after a digest of its own code and of all that it reaches: the kernels it calls, the
constants it reads, the fields of the tuples it takes. So a comment, a moved file or another kernel of the
same module leaves it valid, and a changed constant in another module does not. Files need no index and no
lock: each is written whole under its final name, and one that cannot be read is deleted and made anew.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import platform
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numba
import numpy as np
from numba.core import compiler, config, serialize, types

for _owner, _needed in ((compiler.CompileResult, "_rebuild"), (compiler.CompileResult, "_reduce")):
    if not hasattr(_owner, _needed):
        raise ImportError(f"this version of numba has no {_owner.__name__}.{_needed}")

PACKAGES = ("quad_envs", "controllers", "baselines")
_FOREIGN = {*sys.stdlib_module_names, "numba", "numpy", "scipy"}  # their versions stand for their code
_HEADER = hashlib.sha256().digest_size  # bytes before the pickle: its checksum
_OUTDATED = 7 * 86400.0  # s, after which another version of the same kernel is swept
_PLAIN = (int, float, complex, str, bytes, bool, type(None), type(Ellipsis), np.generic)


def digest(function: Callable[..., Any]) -> str:
    """Hex digest of a function and of everything of ours that its code can reach.

    Line numbers, comments and docstrings do not count. Call it when the modules are complete: kernels may
    use names that are defined below them.
    """
    met: dict[str, str] = {}
    waiting = [function]
    while waiting:
        here = waiting.pop()
        name = f"{here.__module__}.{here.__qualname__}"
        if name not in met:
            met[name] = "".join(_describe_code(here.__code__, here.__doc__))
            for what, value in _reached(here):
                met[f"{name}: {what}"] = _describe(value, waiting)
    return hashlib.sha256(repr(sorted(met.items())).encode()).hexdigest()


def _root(module: str) -> str:
    """The package of a module."""
    return module.partition(".")[0]


def _describe_code(code: CodeType, docstring: str | None = None) -> Iterator[str]:
    """What makes a code object behave as it does."""
    yield repr((code.co_code, code.co_names, code.co_varnames, code.co_freevars, code.co_flags))
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _describe_code(constant)
        elif constant != docstring:
            yield repr(sorted(constant, key=repr) if isinstance(constant, frozenset) else constant)


def _names(code: CodeType) -> set[str]:
    """Names that a code object reads from its module or from other objects."""
    inner = (constant for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*map(_names, inner))


def _reached(function: Callable[..., Any]) -> Iterator[tuple[str, Any]]:
    """What the code of a function can reach: globals, attributes of our modules, closure, defaults."""
    assert isinstance(function, FunctionType)
    names = _names(function.__code__)
    for name in sorted(names & function.__globals__.keys()):
        value = function.__globals__[name]
        yield name, value
        if isinstance(value, ModuleType) and _root(value.__name__) in PACKAGES:
            yield from ((f"{name}.{part}", vars(value)[part]) for part in sorted(names & vars(value).keys()))
    yield "defaults", function.__defaults__
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        yield name, cell.cell_contents


def _describe(value: Any, waiting: list[Any]) -> str:
    """One reached value as text; functions are named here and wait to be described."""
    function = getattr(value, "py_func", None) or getattr(value, "_defn", value)  # of kernels, of intrinsics
    if isinstance(function, FunctionType):
        if _root(function.__module__) not in _FOREIGN:
            waiting.append(function)
        return f"{function.__module__}.{function.__qualname__}"
    if isinstance(value, type):
        return f"{value.__module__}.{value.__qualname__}{getattr(value, '_fields', '')}"
    if isinstance(value, np.ndarray):
        return repr((value.dtype.str, value.shape, value.tobytes()))
    if isinstance(value, tuple | list | dict | slice) or isinstance(value, _PLAIN):
        return repr(value)
    return str(getattr(value, "__qualname__", getattr(value, "__name__", type(value).__qualname__)))


def _describe_signature(signature: tuple[types.Type, ...]) -> str:
    """Argument types with the names of the fields of tuples, which numba's own names leave out."""
    parts = []
    for kind in signature:
        parts.append(repr(kind))
        if isinstance(kind, types.NamedTuple | types.NamedUniTuple):
            parts.append(f"{kind.instance_class.__module__}{kind.fields}")
            parts.append(_describe_signature(tuple(kind.types)))
    return "; ".join(parts)


@cache
def folders() -> tuple[Path, ...]:
    """Where compiled kernels may lie already, in the order of looking; nobody else can put files there.

    `NUMBA_CACHE_DIR`, `__pycache__` of this package (also a read-only one: an image may bring it filled), the
    user's cache, the user's own corner of the directory for temporary files.
    """
    found = []
    for place in _places():
        with contextlib.suppress(OSError):
            place.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(OSError):
            if place.is_dir() and _is_ours(place):
                found.append(place)
    return tuple(found)


@cache
def folder() -> Path | None:
    """Where new files go, the first of `folders` that can be written; None, and a warning, if none can."""
    for place in folders():
        with contextlib.suppress(OSError):
            tempfile.TemporaryFile(dir=place).close()
            return place
    warnings.warn(
        "compiled kernels cannot be kept, so that every process compiles anew: no folder can be written; "
        "set NUMBA_CACHE_DIR to one that can",
        RuntimeWarning,
        stacklevel=2,
    )
    return None


def _places() -> Iterator[Path]:
    if chosen := getattr(config, "CACHE_DIR", ""):
        yield Path(chosen) / "quad-envs"
    yield Path(__file__).parent / "__pycache__" / "kernels"
    home = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or "~/.cache"
    with contextlib.suppress(RuntimeError):  # there is no home directory
        yield Path(home).expanduser() / "quad-envs"
    user = os.getuid() if hasattr(os, "getuid") else os.environ.get("USERNAME", "user")
    yield Path(tempfile.gettempdir()) / f"quad-envs-{user}"


def _is_ours(place: Path) -> bool:
    """Whether only this user and the administrator can put files there: what is loaded from it is run."""
    if not hasattr(os, "getuid"):
        return True
    status = place.stat()
    return status.st_uid in (os.getuid(), 0) and not status.st_mode & 0o002


class KernelCache:
    """What numba's dispatcher asks to load and to save the compiled forms of one kernel."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self._name = f"{function.__module__}.{function.__qualname__}".replace("<locals>", "locals")
        self._digest: str | None = None  # made at the first use, when all modules are complete

    @property
    def cache_path(self) -> str | None:
        """The folder, as numba's `stats` names it."""
        place = folder()
        return None if place is None else str(place)

    def load_overload(self, signature: Any, target: Any) -> Any:
        """The compiled form for these argument types; None if there is none that can be read."""
        target.refresh()
        name = self._file_name(signature, target.codegen())
        for place in folders():
            with contextlib.suppress(FileNotFoundError):
                compiled = _read(place / name, target)
                if compiled is not None:
                    return compiled
        return None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Keep a compiled form; where that cannot be done, the next process compiles again."""
        place = folder()
        if place is None or compiled.library.has_dynamic_globals or compiled.lifted:
            return
        with contextlib.suppress(OSError):
            raw = serialize.dumps(compiled._reduce())
            path = place / self._file_name(signature, compiled.codegen)
            unfinished = place / f"{path.stem}.{os.getpid()}.tmp"
            unfinished.write_bytes(hashlib.sha256(raw).digest() + raw)
            os.replace(unfinished, path)
            self._sweep(place)

    def _file_name(self, signature: Any, codegen: Any) -> str:
        if self._digest is None:
            self._digest = digest(self._function)[:16]
        machine = (numba.__version__, platform.python_version(), codegen.magic_tuple())
        key = hashlib.sha256(repr((_describe_signature(signature), machine)).encode()).hexdigest()[:16]
        return f"{self._name}-{self._digest}-{key}.nbc"

    def _sweep(self, place: Path) -> None:
        """Delete what older versions of this kernel, and writers that died, left a while ago."""
        since = time.time() - _OUTDATED
        for path in [*place.glob(f"{self._name}-*.nbc"), *place.glob("*.tmp")]:
            if f"-{self._digest}-" not in path.name:
                with contextlib.suppress(OSError):
                    if path.stat().st_mtime < since:
                        path.unlink()

    def enable(self) -> None:
        """Numba's interface: always on."""

    def disable(self) -> None:
        """Numba's interface: always on."""

    def flush(self) -> None:
        """Numba's interface, of `recompile`: nothing is out of date under a name made of the content."""


def _read(path: Path, target: Any) -> Any:
    """The compiled form in a file; None, and the file is deleted, if it is cut, changed or does not load.

    Raises:
        FileNotFoundError: If there is no such file.
    """
    try:
        raw = path.read_bytes()
        if hashlib.sha256(raw[_HEADER:]).digest() != raw[:_HEADER]:
            raise ValueError("cut or changed")
        return compiler.CompileResult._rebuild(target, *pickle.loads(raw[_HEADER:]))
    except FileNotFoundError:
        raise
    except Exception:  # whatever is wrong with it, compiling is the remedy
        with contextlib.suppress(OSError):
            path.unlink()
        return None
