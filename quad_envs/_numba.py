"""Compilation of kernels: decorators with the project's options, and one line when it takes time."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core import event

Int = int | np.int64  # an argument that a kernel may be given as a constant, see quad_envs.dynamics
Function = TypeVar("Function", bound=Callable[..., Any])

_PACKAGES = ("quad_envs", "controllers", "baselines", "benchmarks")


def kernel(function: Function) -> Function:
    """Compile on first call, cached on disk; division follows IEEE 754. Call it with every argument given."""
    return cast(Function, numba.njit(cache=True, error_model="numpy")(function))


def inline_kernel(function: Function) -> Function:
    """As `kernel`, but LLVM always inlines it into its caller, so that loops around it vectorise."""
    return cast(Function, numba.njit(cache=True, error_model="numpy", forceinline=True)(function))


class _Announcer(event.Listener):
    """Says once per process that kernels are being compiled, since the first call then takes seconds."""

    def __init__(self) -> None:
        self.said = False

    def on_start(self, event: Any) -> None:
        """A kernel was not in the cache: say so, once."""
        module = event.data["dispatcher"].py_func.__module__
        if not self.said and module.split(".")[0] in _PACKAGES:
            self.said = True
            print(
                "quad_envs: compiling kernels, once per installation (a few seconds) ...",
                file=sys.stderr,
                flush=True,
            )

    def on_end(self, event: Any) -> None:
        """Nothing to say when it ends."""


_ANNOUNCER = _Announcer()
event.register("numba:compile", _ANNOUNCER)
