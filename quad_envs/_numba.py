"""Compilation of kernels with numba: one option set, fast cold starts, and one line when it takes time.

A kernel may be called from other kernels and from Python. Numba by itself emits machine code, wrappers
for Python and a cache file for every kernel at every level of nesting, which doubles the time of the first
decision of an MPC. Here a kernel that is called from another one hands over plain LLVM code and no more; only
the kernel that Python calls is optimised, as a whole, becomes machine code and is cached on disk. The cache
is void as soon as any source file that may matter to a kernel changes, since numba itself would not notice a
change in a kernel of another file.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core import config, event
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import NativeLowering

Int = int | np.int64  # an argument that a kernel may be given as a constant, see quad_envs.dynamics
Function = TypeVar("Function", bound=Callable[..., Any])

_PACKAGES = ("quad_envs", "controllers", "baselines")


@register_pass(mutates_CFG=True, analysis_only=False)
class _InnerLowering(NativeLowering):
    """Lower to LLVM code and stop there: it is optimised and becomes machine code as a part of its caller."""

    _name = "inner_lowering"

    def run_pass(self, state: Any) -> bool:
        """Lower without optimisation or machine code."""
        context = state.targetctx
        library = context.codegen().create_library(state.func_id.func_qualname)
        library._finalize_final_module = partial(_hand_over, library)
        library._optimize_final_module = lambda: None
        state.library = library
        # Numba wants a callable of its own to register the kernel under. This one is never called.
        context.get_executable = lambda library, descriptor, env: {}.popitem
        try:
            return bool(super().run_pass(state))  # type: ignore[no-untyped-call]
        finally:
            del context.get_executable


def _hand_over(library: Any) -> None:
    """End the library's construction without machine code."""
    library._finalize_dynamic_globals()
    library._finalized = True


class _InnerCompiler(CompilerBase):
    """Numba's pipeline with `_InnerLowering` in place of native lowering."""

    def define_pipelines(self) -> list[Any]:
        """The one pipeline."""
        manager = DefaultPassBuilder.define_nopython_pipeline(self.state)
        manager.passes = [
            (_InnerLowering if step is NativeLowering else step, why) for step, why in manager.passes
        ]
        manager._finalized = False
        manager.finalize()
        return [manager]


class _Kernel(CPUDispatcher):
    """A function compiled into the kernels that call it, and on its own when Python calls it."""

    def __init__(self, function: Callable[..., Any], inline: bool) -> None:
        options = {"nopython": True, "boundscheck": None, "error_model": "numpy", "forceinline": inline}
        inner = {**options, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
        super().__init__(py_func=function, targetoptions=inner, pipeline_class=_InnerCompiler)
        outer: Any = numba.njit(cache=True, error_model="numpy")(function)
        self.entry = outer  # what a call from Python runs; hot paths call it without the detour below
        file = getattr(outer._cache, "_cache_file", None)
        if file is not None and function.__module__.split(".")[0] in _PACKAGES:
            file._source_stamp = _source_stamp()

    def __call__(self, *args: Any) -> Any:
        """Call from Python, with every argument given."""
        return self.entry(*args)


@cache
def _source_stamp() -> tuple[tuple[str, float, int], ...]:
    """Changes with every source file on which a kernel can depend.

    That is every file but those in the subpackages of `baselines`, which hold no kernels: a test says so.
    """
    root = Path(__file__).parent.parent
    files = [*sorted((root / "baselines").glob("*.py"))]
    files += [
        path for package in ("quad_envs", "controllers") for path in sorted((root / package).rglob("*.py"))
    ]
    return tuple((str(path), path.stat().st_mtime, path.stat().st_size) for path in files)


def entry_of(compiled: Function) -> Function:
    """The function that Python calls of a kernel, for callers to whom 0.2 us matter."""
    return cast(Function, getattr(compiled, "entry", compiled))


def kernel(function: Function) -> Function:
    """Compile on first call; division follows IEEE 754. Call it with every argument given."""
    if getattr(config, "DISABLE_JIT", False):
        return function
    return cast(Function, _Kernel(function, inline=False))


def inline_kernel(function: Function) -> Function:
    """As `kernel`, but LLVM always inlines it into its caller, so that loops around it vectorise."""
    if getattr(config, "DISABLE_JIT", False):
        return function
    return cast(Function, _Kernel(function, inline=True))


class _Announcer(event.Listener):
    """Says once per process that kernels are being compiled, since the first call then takes seconds."""

    def __init__(self) -> None:
        self.said = False

    def on_start(self, event: Any) -> None:
        """A kernel was not in the cache: say so, once."""
        module = event.data["dispatcher"].py_func.__module__ or ""
        if not self.said and module.split(".")[0] in _PACKAGES:
            self.said = True
            message = "quad_envs: compiling kernels, once per installation (up to half a minute) ..."
            print(message, file=sys.stderr, flush=True)

    def on_end(self, event: Any) -> None:
        """Nothing to say when it ends."""


_ANNOUNCER = _Announcer()
event.register("numba:compile", _ANNOUNCER)
