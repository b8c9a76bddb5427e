"""Kernels that become part of the kernels that call them: numba's pipeline, stopped before machine code.

Numba by itself emits machine code, wrappers for Python and a cache file for every kernel at every level of
nesting, which doubles the time of the first decision of an MPC. Here a kernel that is called from another one
hands over plain LLVM code and no more. This needs names that numba does not promise to keep; without them
importing this module fails, and `decorators` compiles in numba's plain way.

Kernels allocate nothing, so that nobody counts references to their arrays, and numba's code for that is
neither made nor removed again: whoever calls from Python keeps what it passes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, ClassVar

from llvmlite import binding as llvm
from numba.core import typed_passes, types, untyped_passes
from numba.core.codegen import CPUCodegen, CPUCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.cpu import CPUContext
from numba.core.errors import TypingError
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import NativeLowering

for _owner, _name in (
    (CPUCodeLibrary, "_finalize_final_module"),
    (CPUCodeLibrary, "_optimize_final_module"),
    (CPUCodeLibrary, "_optimize_functions"),
    (CPUCodeLibrary, "_finalize_dynamic_globals"),
    (CPUCodegen, "_pass_builder"),
    (CPUContext, "enable_nrt"),
    (CPUContext, "get_executable"),
    (DefaultPassBuilder, "define_nopython_pipeline"),
):
    if not hasattr(_owner, _name):
        raise ImportError(f"this version of numba has no {_owner.__name__}.{_name}")

# What serves closures, functions that are inlined before they are typed, and expressions of whole arrays.
# Kernels have none of these: where one has, numba refuses to compile it.
_NEEDLESS = (
    untyped_passes.WithLifting,
    untyped_passes.InlineClosureLikes,
    untyped_passes.MakeFunctionToJitFunction,
    untyped_passes.InlineInlinables,
    untyped_passes.LiteralUnroll,
    typed_passes.InlineOverloads,
    typed_passes.NopythonRewrites,
)


class KernelLowering(NativeLowering):
    """Lowering to LLVM code in which no references are counted."""

    _name: Any = None

    def run_pass(self, state: Any) -> bool:
        """Lower into the library of the state, or into a new one."""
        if state.library is None:
            state.library = state.targetctx.codegen().create_library(state.func_id.func_qualname)
            state.library.enable_object_caching()
        if not state.flags.fastmath:  # which multiplications and additions are fused depends on the passes
            state.library._optimize_functions = partial(_simplify, state.library)
        state.targetctx.enable_nrt = False
        return bool(super().run_pass(state))  # type: ignore[no-untyped-call]


def _simplify(library: Any, module: Any) -> None:
    """A few passes in place of all that numba runs over each function: its caller is optimised as a whole."""
    module.data_layout = library._codegen._data_layout
    passes = llvm.create_new_module_pass_manager()
    passes.add_sroa_pass()
    passes.add_simplify_cfg_pass()
    passes.add_instruction_combine_pass()
    passes.add_simplify_cfg_pass()
    passes.add_dead_code_elimination_pass()
    passes.run(module, library._codegen._pass_builder())


@register_pass(mutates_CFG=True, analysis_only=False)
class _InnerLowering(KernelLowering):
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
            return super().run_pass(state)
        finally:
            del context.get_executable


def _hand_over(library: Any) -> None:
    """End the library's construction without machine code."""
    library._finalize_dynamic_globals()
    library._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _EntryLowering(KernelLowering):
    """Lower what Python calls; it cannot return an array, since nobody would keep it."""

    _name = "entry_lowering"

    def run_pass(self, state: Any) -> bool:
        """Lower, or refuse."""
        if _holds_array(state.return_type):
            name = state.func_id.func_qualname
            raise TypingError(f"{name} returns an array to Python: let it fill one that it is given")
        return super().run_pass(state)


def _holds_array(kind: Any) -> bool:
    return isinstance(kind, types.Array) or any(map(_holds_array, getattr(kind, "types", ())))


class KernelCompiler(CompilerBase):
    """Numba's pipeline without needless passes, and with a lowering of its own."""

    lowering: ClassVar[type] = _EntryLowering

    def define_pipelines(self) -> list[Any]:
        """The one pipeline."""
        self.state.targetctx.enable_nrt = True  # until lowering: else kernels could not return a view
        manager = DefaultPassBuilder.define_nopython_pipeline(self.state)
        manager.passes = [
            (self.lowering if each is NativeLowering else each, why)
            for each, why in manager.passes
            if each not in _NEEDLESS
        ]
        manager._finalized = False
        manager.finalize()
        return [manager]


class _InnerCompiler(KernelCompiler):
    """That of kernels in other kernels."""

    lowering = _InnerLowering


class Kernel(CPUDispatcher):
    """What numba compiles for each set of argument types."""

    compiler: ClassVar[type] = KernelCompiler

    def __init__(self, function: Callable[..., Any], options: Mapping[str, Any]) -> None:
        own = {**options, "nopython": True, "boundscheck": None, "_nrt": False, "no_cfunc_wrapper": True}
        super().__init__(py_func=function, targetoptions=own, pipeline_class=self.compiler)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """What a call from another kernel compiles: the same for a constant as for any value of its type."""
        args = tuple(types.unliteral(kind) for kind in args)
        kws = {name: types.unliteral(kind) for name, kind in kws.items()}
        return super().get_call_template(args, kws)


class NestedKernel(Kernel):
    """A function compiled into the kernels that call it, and on its own when Python calls it."""

    compiler = _InnerCompiler

    def __init__(
        self, function: Callable[..., Any], entry: Any, inline: bool, options: Mapping[str, Any]
    ) -> None:
        super().__init__(function, {**options, "forceinline": inline, "no_cpython_wrapper": True})
        self.entry = entry  # what a call from Python runs; hot paths call it without the detour below

    def __call__(self, *args: Any) -> Any:
        """Call from Python, with every argument given."""
        return self.entry(*args)
