"""The processor for which a wheel's kernels are compiled: any x86-64 of the last decade."""

from __future__ import annotations

import platform
import sys
from pathlib import Path

CPU = "x86-64-v3"  # as LLVM names it: AVX2 and FMA, from Haswell and Zen on
NEEDED = ("avx", "avx2", "bmi", "bmi2", "cx16", "f16c", "fma", "lzcnt", "movbe", "popcnt", "sse4.2")
SHIPPED = Path(__file__).parent.parent / "kernels"  # where `make wheel` puts them; a clone has none


def settings(folder: Path) -> dict[str, str] | None:
    """Environment variables with which numba compiles for `CPU` into a folder; None on other machines.

    They count before numba is imported.
    """
    if platform.machine().lower() not in ("x86_64", "amd64") or sys.maxsize < 2**32:
        return None
    return {"NUMBA_CPU_NAME": CPU, "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(folder)}
