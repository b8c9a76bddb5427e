"""Kernels with machine code of their own, which other kernels call by a name and do not contain.

What several controllers share is compiled once for all of them, and once for all processes: its file in the
cache has the same name as its symbol. Whoever calls it holds the symbol alone; `cache` loads the file first.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import llvmlite.binding as llvm
from numba.core import itanium_mangler
from numba.core.base import BaseContext
from numba.core.codegen import CPUCodeLibrary
from numba.core.compiler_lock import global_compiler_lock
from numba.core.compiler_machinery import register_pass
from numba.core.funcdesc import qualifying_prefix
from numba.core.sigutils import normalize_signature

from .cache import KernelCache
from .kernel_file import publish
from .nested import Kernel, KernelCompiler, KernelLowering

for _owner, _name in (
    (BaseContext, "mangler"),
    (CPUCodeLibrary, "_get_module_for_linking"),
):
    if not hasattr(_owner, _name):
        raise ImportError(f"this version of numba has no {_owner.__name__}.{_name}")


@register_pass(mutates_CFG=True, analysis_only=False)
class _SeparateLowering(KernelLowering):
    """Native lowering, in which the function gets the name of its file in the cache."""

    _name = "separate_lowering"

    def run_pass(self, state: Any) -> bool:
        """Lower under the name that every process gives it."""
        context, function = state.targetctx, state.func_id
        name = _CACHES[function.func].name(state.args, context.codegen().magic_tuple())
        state.library = context.codegen().create_library(name)
        state.library.enable_object_caching()
        own = qualifying_prefix(function.modname, function.func_qualname)
        context.mangler = partial(_mangle, own, name)
        try:
            return super().run_pass(state)
        finally:
            del context.mangler


_CACHES: dict[Callable[..., Any], KernelCache] = {}  # of separate kernels


def _mangle(own: str, name: str, what: str, types: Any, **tags: Any) -> str:
    """A symbol: of this function or of its environment by its name; of any other as numba makes it."""
    if what == own or what == f".NumbaEnv.{own}":
        return str(itanium_mangler.mangle(what.replace(own, name), ()))
    return str(itanium_mangler.mangle(what, types, **tags))


class _SeparateCompiler(KernelCompiler):
    """That of separate kernels."""

    lowering = _SeparateLowering


class SeparateKernel(Kernel):
    """A function that is compiled once, for Python and for all kernels that call it."""

    compiler = _SeparateCompiler

    def __init__(self, function: Callable[..., Any], options: Mapping[str, Any]) -> None:
        super().__init__(function, options)
        self._cache = _CACHES[function] = KernelCache(self)

    def compile(self, signature: Any) -> Any:
        """The compiled form for these argument types, by whichever process comes first."""
        arguments, _ = normalize_signature(signature)
        if tuple(arguments) in self.overloads:
            return super().compile(signature)
        # The compiler's lock first: a thread that holds it may come here, too.
        with global_compiler_lock, self._cache.turn(arguments, self.targetctx):
            return super().compile(signature)

    def add_overload(self, compiled: Any) -> None:
        """A compiled form is there; kernels that call it find its symbol and link no code."""
        compiled.library._shared_module = llvm.parse_assembly("")
        publish(compiled)
        super().add_overload(compiled)
