"""Compiled kernels on disk, found again by what they are made of; never a reason not to start.

A kernel's file is named after a digest of its own code and of all that it reaches: the kernels it calls, the
constants it reads, the fields of the tuples it takes. So a comment, a moved file or another kernel of the
same module leaves it valid, and a changed constant in another module does not. Files need no index and no
lock: each is written whole under its final name, and one that cannot be read is deleted and made anew.
Locks only spare work: of two processes that need the same separate kernel, one compiles it.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
import numpy as np
from numba.core import config, types

from .digest import digest
from .kernel_file import pack, publish, published, unpack
from .portable import CPU, NEEDED, SHIPPED

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

PACKAGES = ("quad_envs", "controllers", "baselines")
_HEADER = hashlib.sha256().digest_size  # bytes before the kernel: its checksum
_WAY = 2  # of compiling, in `nested` and `separate`: raised where it changes, so that no older file is loaded
_OUTDATED = 7 * 86400.0  # s, after which another version of the same kernel is swept


def _versions() -> tuple[str, ...]:
    """Of what compiled kernels hold parts of; within a minor version of numpy nothing of it changes."""
    return numba.__version__, *np.__version__.split(".")[:2], str(sys.implementation.cache_tag)


def _settings() -> list[str]:
    """What settings of numba change in compiled kernels."""
    return [str(getattr(config, name, None)) for name in ("OPT", "BOUNDSCHECK")]


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


@cache
def runs_shipped() -> bool:
    """Whether kernels that came with a wheel are there and run on this processor.

    Who chose another one (NUMBA_CPU_NAME) wants kernels for that.
    """
    if getattr(config, "CPU_NAME", None) is not None or not SHIPPED.is_dir():
        return False
    features = llvm.get_host_cpu_features()
    return all(features.get(name) for name in NEEDED)


def _places() -> Iterator[Path]:
    if chosen := getattr(config, "CACHE_DIR", ""):
        yield Path(chosen) / "quad-envs"
    yield Path(__file__).parent.parent / "__pycache__" / "kernels"
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
    """What numba's dispatcher asks to load and to save the compiled forms of one kernel.

    Args:
        kernel: The dispatcher.
    """

    def __init__(self, kernel: Any) -> None:
        function, self._kernel = kernel.py_func, kernel
        self._name = f"{function.__module__}.{function.__qualname__}".replace("<locals>", "locals")
        self._digest: str | None = None  # made at the first use, when all modules are complete

    @property
    def cache_path(self) -> str | None:
        """The folder, as numba's `stats` names it."""
        place = folder()
        return None if place is None else str(place)

    def load_overload(self, signature: Any, target: Any) -> Any:
        """The compiled form for these argument types, the user's or the wheel's; None if there is none."""
        processor = target.codegen().magic_tuple()
        name = self.name(signature, processor)
        files = [(place, name) for place in folders()]
        if runs_shipped():
            files.append((SHIPPED, self.name(signature, (processor[0], CPU, ""))))
        for place, name in files:
            with contextlib.suppress(FileNotFoundError):
                compiled = published(name) or _read(place / f"{name}.nbc", target)
                if compiled is not None:
                    return compiled
        return None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Keep a compiled form; where that cannot be done, the next process compiles again."""
        place = folder()
        if place is None or compiled.library.has_dynamic_globals or compiled.lifted or compiled.reload_init:
            return
        with contextlib.suppress(OSError):
            raw = pack(compiled)
            name = self.name(signature, compiled.codegen.magic_tuple())
            unfinished = place / f"{name}.{os.getpid()}.tmp"
            unfinished.write_bytes(hashlib.sha256(raw).digest() + raw)
            os.replace(unfinished, place / f"{name}.nbc")
            self._sweep(place)

    @contextlib.contextmanager
    def turn(self, signature: Any, target: Any) -> Iterator[None]:
        """Keep other processes from compiling the same at the same time; they load it after this one.

        Where locks are not to be had, each compiles for itself.
        """
        place = folder()
        if fcntl is None or place is None:
            yield
            return
        path = place / f"{self.name(signature, target.codegen().magic_tuple())}.lock"
        with contextlib.ExitStack() as held:
            with contextlib.suppress(OSError):
                file = held.enter_context(path.open("w"))
                fcntl.flock(file, fcntl.LOCK_EX)
            yield
            with contextlib.suppress(OSError):
                path.unlink()

    def name(self, signature: Any, processor: tuple[str, ...]) -> str:
        """Of the file, without its suffix, for these argument types."""
        if self._digest is None:
            self._digest = digest(self._kernel)[:16]
        made_for = (_describe_signature(signature), _versions(), _settings(), _WAY, processor)
        key = hashlib.sha256(repr(made_for).encode()).hexdigest()[:16]
        return f"{self._name}-{self._digest}-{key}"

    def _sweep(self, place: Path) -> None:
        """Delete what older versions of this kernel, and writers that died, left a while ago."""
        since = time.time() - _OUTDATED
        for path in [*place.glob(f"{self._name}-*.nbc"), *place.glob("*.tmp"), *place.glob("*.lock")]:
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
        return unpack(raw[_HEADER:], target, partial(_load_separate, target))
    except FileNotFoundError:
        raise
    except Exception:  # whatever is wrong with it, compiling is the remedy
        with contextlib.suppress(OSError):
            path.unlink()
        return None


def _load_separate(target: Any, name: str) -> None:
    """Publish the separate kernel of that name, if there is a file of it."""
    for place in (*folders(), SHIPPED):
        with contextlib.suppress(FileNotFoundError):
            compiled = _read(place / f"{name}.nbc", target)
            if compiled is not None:
                publish(compiled)
                return
