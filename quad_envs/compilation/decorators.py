"""Compilation of kernels with numba: one option set, fast cold starts, and one line when it takes time.

A kernel may be called from other kernels and from Python. Only the kernel that Python calls is optimised, as
a whole with all that it calls (`nested`), becomes machine code and is kept on disk (`cache`). Both
rest on names that numba does not promise to keep. Where a version of numba lacks them, kernels are compiled
in its plain way, which takes longer and gives the same results, and one warning says so.
"""

from __future__ import annotations

import gc
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core import config, event

try:
    from .cache import PACKAGES, KernelCache, folder
    from .nested import Kernel, NestedKernel
    from .separate import SeparateKernel
except (ImportError, AttributeError) as error:  # a test hides the names in a process of its own
    warnings.warn(
        f"numba {numba.__version__} lacks what quad_envs uses to compile fast ({error}): kernels are "
        "compiled in numba's plain way, and anew in every process; install a version that pip chooses for "
        "quad-envs",
        RuntimeWarning,
        stacklevel=2,
    )
    PACKAGES = ("quad_envs", "controllers", "baselines")
    KernelCache = Kernel = NestedKernel = SeparateKernel = None  # type: ignore[assignment, misc]

Int = int | np.int64  # an argument that a kernel may be given as a constant, see quad_envs.dynamics
Function = TypeVar("Function", bound=Callable[..., Any])


def _compile(
    function: Function, inline: bool, fused: bool = False, nogil: bool = False, separate: bool = False
) -> Function:
    if getattr(config, "DISABLE_JIT", False):
        return function
    options: Any = {"error_model": "numpy", "fastmath": {"contract"} if fused else False}
    if separate and SeparateKernel is not None:
        return cast(Function, SeparateKernel(function, {**options, "nogil": nogil}))
    if NestedKernel is None:
        return cast(Function, numba.njit(forceinline=inline, nogil=nogil, **options)(function))
    entry: Any = Kernel(function, {**options, "nogil": nogil})
    entry._cache = KernelCache(entry)
    return cast(Function, NestedKernel(function, entry, inline, options))


def kernel(function: Function) -> Function:
    """Compile on first call; division follows IEEE 754. Call it with every argument given."""
    return _compile(function, inline=False)


def inline_kernel(function: Function) -> Function:
    """As `kernel`, but LLVM always inlines it into its caller, so that loops around it vectorise."""
    return _compile(function, inline=True)


def separate_kernel(function: Function) -> Function:
    """As `kernel`, but compiled once for all that call it: they hold its name, and no code of it.

    For large ones that several others call. Sizes that a caller knows are not known in it.
    """
    return _compile(function, inline=False, nogil=True, separate=True)


def threaded_kernel(function: Function) -> Function:
    """As `kernel`, but threads may run it side by side."""
    return _compile(function, inline=False, nogil=True)


def lane_kernel(function: Function) -> Function:
    """As `kernel`, for loops over lanes: multiply-adds round once, and threads may run it side by side."""
    return _compile(function, inline=False, fused=True, nogil=True)


def inline_lane_kernel(function: Function) -> Function:
    """As `inline_kernel`, for loops over lanes: multiply-adds round once."""
    return _compile(function, inline=True, fused=True)


def fused(compiled: Function) -> Function:
    """The same inline kernel for loops over lanes: multiply-adds round once."""
    return inline_lane_kernel(getattr(compiled, "py_func", compiled))


def entry_of(compiled: Function) -> Function:
    """The function that Python calls of a kernel, for callers to whom 0.2 us matter."""
    return cast(Function, getattr(compiled, "entry", compiled))


class DirectEntry:
    """A kernel of which `call` goes straight to machine code, for callers to whom 0.1 us matter.

    Numba asks for the types of arguments at the first call alone. From then on the caller answers for them:
    C-contiguous arrays of the same dtypes and axes. Whether they are writeable does not matter.

    Args:
        compiled: The kernel.
    """

    __slots__ = ("_entry", "call")

    def __init__(self, compiled: Callable[..., Any]) -> None:
        self._entry: Any = entry_of(compiled)
        self.call: Callable[..., Any] = self._first

    def _first(self, *arguments: Any) -> Any:
        """The first call, which compiles or loads."""
        entry = self._entry
        if hasattr(entry, "compile"):
            entry = entry.compile(tuple(_writeable(entry.typeof_pyval(argument)) for argument in arguments))
        self.call = entry
        return entry(*arguments)


def _writeable(kind: Any) -> Any:
    """Numba's type of an argument, whether or not it may be written to."""
    return kind.copy(readonly=False) if isinstance(kind, numba.types.Array) else kind


def kept_in() -> Path | None:
    """The folder in which compiled kernels are kept; None if they are not."""
    return None if KernelCache is None else folder()


def announce_no_more() -> None:
    """Let nothing be said of compilation in this process, where another one speaks of it."""
    _ANNOUNCER.said = True


def _kept() -> str:
    """What one compiles and how long it is good for, as the first call finds it."""
    what = "for the first use of this environment or policy, 5 to 20 s of one core each"
    if kept_in() is None:
        return f"{what}; nothing can be kept, so that each process compiles anew"
    return f"{what}; kept until their code changes"


class _Announcer(event.Listener):
    """Says once per process that kernels are being compiled, since the first call then takes seconds.

    While one is, Python's collector of cycles rests: it would look for garbage among all that numba has
    built so far, again and again, which takes a fifth of the time.
    """

    def __init__(self) -> None:
        self.said = False
        self._depth = 0
        self._collects = False  # outside

    def on_start(self, event: Any) -> None:
        """A kernel was not in the cache: say so, once."""
        if self._depth == 0:
            self._collects = gc.isenabled()
            gc.disable()
        self._depth += 1
        module = event.data["dispatcher"].py_func.__module__ or ""
        if not self.said and module.split(".")[0] in PACKAGES:
            self.said = True
            print(f"quad_envs: compiling {_kept()}", file=sys.stderr, flush=True)

    def on_end(self, event: Any) -> None:
        """A kernel is compiled; the one whose compilation asked for it may still be at it."""
        self._depth -= 1
        if self._depth == 0 and self._collects:
            gc.enable()


_ANNOUNCER = _Announcer()
event.register("numba:compile", _ANNOUNCER)
