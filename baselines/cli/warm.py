"""`quad-envs warm`: compile every kernel now, with all cores."""

from __future__ import annotations

import os

from quad_envs.arguments.checks import require_whole
from quad_envs.compilation.portable import settings

from .options import WarmOptions


def compile_all(options: WarmOptions) -> int:
    """Compile, and say where the kernels are kept; 1 if they cannot be."""
    if options.jobs is not None:
        require_whole("jobs", options.jobs, 1)
    if options.portable is not None:
        chosen = settings(options.portable.absolute())
        if chosen is None:
            print("kernels for other processors are made on x86-64 alone; elsewhere a wheel compiles its own")
            return 0
        os.environ |= chosen
    from ..sweeps.compiling import compile_everything

    place = compile_everything(options.jobs)
    if place is None:
        return 1  # a warning has said that no folder can be written
    print(f"kernels of all environments and policies are kept in {place}")
    return 0
