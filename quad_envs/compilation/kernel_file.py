"""One compiled kernel as bytes that become a kernel again without numba's compiler.

Numba itself loads a kernel as if it were about to compile: it imports every function it can translate (with
SciPy, for linear algebra) and prepares its runtime, which takes most of a warm start. Machine code needs none
of it, only the C functions that it calls. They are listed with it; where one is not there, numba is prepared
in full, and where it is still not there, the bytes are of no use here. Separate kernels that it calls (see
`separate`) are listed with the names of their files.
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable
from functools import cache
from typing import Any

import llvmlite.binding as llvm
from numba.core import compiler, environment, serialize
from numba.core.runtime import _nrt_python  # type: ignore[attr-defined]

for _owner, _needed in (
    (compiler.CompileResult, "_rebuild"),
    (compiler.CompileResult, "_reduce"),
    (environment, "_rebuild_env"),
    (_nrt_python, "c_helpers"),
):
    if not hasattr(_owner, _needed):
        raise ImportError(f"this version of numba has no {_owner.__name__}.{_needed}")


_SEPARATE: dict[str, Any] = {}  # separate kernels of this process, by the names of their files
_NAMES: dict[str, str] = {}  # of their symbols


def publish(compiled: Any) -> None:
    """Let kernels of this process be linked with a separate one, whose library is named as its file."""
    name, symbol = compiled.library.name, compiled.fndesc.llvm_func_name
    if name not in _SEPARATE:
        llvm.add_symbol(symbol, compiled.library.get_pointer_to_function(symbol))
        _SEPARATE[name], _NAMES[symbol] = compiled._replace(metadata=None), name


def published(name: str) -> Any:
    """The separate kernel of that name; None if it is not in this process."""
    return _SEPARATE.get(name)


def pack(compiled: Any) -> bytes:
    """A compiled kernel, numba's `CompileResult`, as bytes."""
    (name, kind, (code, _)), descriptor, *rest = compiled._reduce()
    module = compiled.library._final_module
    needed = [
        (symbol.name, _NAMES[symbol.name]) if symbol.name in _NAMES else symbol.name
        for symbols in (module.functions, module.global_variables)
        for symbol in symbols
        if symbol.is_declaration and not symbol.name.startswith("llvm.")
    ]
    library = name, kind, (code, _names_alone(descriptor))
    return bytes(serialize.dumps((needed, library, descriptor, *rest)))


def unpack(raw: bytes, target: Any, load: Callable[[str], None]) -> Any:
    """The compiled kernel in the bytes of `pack`.

    Args:
        raw: What `pack` returned; it is trusted, as unpickling runs code.
        target: Numba's target context.
        load: Publishes the separate kernel of a name, if it can.

    Raises:
        ValueError: If the kernel calls what is not there.
    """
    calls, library, *rest = _Unpickler(io.BytesIO(raw)).load()
    _publish_runtime()
    separate: dict[str, str] = dict(call for call in calls if isinstance(call, tuple))
    for name in separate.values():
        if name not in _SEPARATE:
            load(name)
    needed = [*separate, *(call for call in calls if isinstance(call, str))]
    if _missing(needed):
        target.refresh()
        if _missing(needed):
            raise ValueError(f"needs {', '.join(_missing(needed))}")
    return compiler.CompileResult._rebuild(target, library, *rest)


def _missing(symbols: list[str]) -> list[str]:
    """Those that machine code could not be linked with; LLVM would end the process at such a one."""
    return [symbol for symbol in symbols if not llvm.address_of_symbol(symbol)]


def _names_alone(descriptor: Any) -> bytes:
    """LLVM code that stands for a kernel's own, from which numba reads which functions there are.

    Its own is for kernels that would call this one. They compile theirs, see `nested`.
    """
    names = (
        descriptor.llvm_func_name,
        descriptor.llvm_cpython_wrapper_name,
        descriptor.llvm_cfunc_wrapper_name,
    )
    code = "\n".join(f'define void @"{name}"() {{ ret void }}' for name in names)
    return bytes(llvm.parse_assembly(code).as_bitcode())


@cache
def _publish_runtime() -> None:
    """Name the C functions of numba's runtime to LLVM, as its initialisation does before it compiles more."""
    for name, address in _nrt_python.c_helpers.items():
        llvm.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


class _Unpickler(pickle.Unpickler):
    """Gives environments no module: code that is compiled whole reads constants from them, never globals."""

    def find_class(self, module: str, name: str) -> Any:
        """The class or function of that name, but for the one that would import numba's compiler."""
        if (module, name) == (environment.__name__, environment._rebuild_env.__name__):
            return _environment
        return super().find_class(module, name)


def _environment(module: str, constants: list[Any], name: str) -> Any:
    """Numba's environment of a function, with its constants alone."""
    found = environment.lookup_environment(name)
    if found is None:
        found = environment.Environment({"__name__": module})
        found.consts[:] = constants
        found.env_name = name
        environment.Environment._memo[name] = found
    return found
