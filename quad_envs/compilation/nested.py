"""Kernels that become part of the kernels that call them: numba's pipeline, stopped before machine code.

Numba by itself emits machine code, wrappers for Python and a cache file for every kernel at every level of
nesting, which doubles the time of the first decision of an MPC. Here a kernel that is called from another one
hands over plain LLVM code and no more. This needs names that numba does not promise to keep; without them
importing this module fails, and `decorators` compiles in numba's plain way.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from numba.core.codegen import CPUCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.cpu import CPUContext
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import NativeLowering

for _owner, _name in (
    (CPUCodeLibrary, "_finalize_final_module"),
    (CPUCodeLibrary, "_optimize_final_module"),
    (CPUCodeLibrary, "_finalize_dynamic_globals"),
    (CPUContext, "get_executable"),
    (DefaultPassBuilder, "define_nopython_pipeline"),
):
    if not hasattr(_owner, _name):
        raise ImportError(f"this version of numba has no {_owner.__name__}.{_name}")


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


def replace_pass(state: Any, step: type, own: type) -> Any:
    """Numba's pipeline with one step exchanged."""
    manager = DefaultPassBuilder.define_nopython_pipeline(state)
    manager.passes = [(own if each is step else each, why) for each, why in manager.passes]
    manager._finalized = False
    manager.finalize()
    return manager


class _InnerCompiler(CompilerBase):
    """Numba's pipeline with `_InnerLowering` in place of native lowering."""

    def define_pipelines(self) -> list[Any]:
        """The one pipeline."""
        return [replace_pass(self.state, NativeLowering, _InnerLowering)]


class NestedKernel(CPUDispatcher):
    """A function compiled into the kernels that call it, and on its own when Python calls it."""

    def __init__(
        self, function: Callable[..., Any], entry: Any, inline: bool, options: Mapping[str, Any]
    ) -> None:
        own = {
            **options,
            "nopython": True,
            "boundscheck": None,
            "forceinline": inline,
            "no_cpython_wrapper": True,
            "no_cfunc_wrapper": True,
        }
        super().__init__(py_func=function, targetoptions=own, pipeline_class=_InnerCompiler)
        self.entry = entry  # what a call from Python runs; hot paths call it without the detour below

    def __call__(self, *args: Any) -> Any:
        """Call from Python, with every argument given."""
        return self.entry(*args)
