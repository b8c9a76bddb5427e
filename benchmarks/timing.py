"""How we measure: interleaved repetitions, the best of each counts, one thread."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Mapping
from time import perf_counter

import numpy as np

_TURN = 0.001  # s, about as long as a turn of a candidate takes: less than a scheduler gives
_FEWEST = 7  # turns, however long they take


def one_thread() -> None:
    """Keep numerical libraries to one thread and this process to one core; call before importing them."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def rates(candidates: Mapping[str, tuple[Callable[[], object], int]], seconds: float) -> dict[str, float]:
    """Units of work per second of each candidate.

    Args:
        candidates: Name -> (call, units of work it does).
        seconds: Time for each candidate, spread over short turns that alternate between the candidates: a
            shared core is free for some of them.
    """
    best, spent = dict.fromkeys(candidates, 0.0), dict.fromkeys(candidates, 0.0)
    calls = {}
    for name, (call, _) in candidates.items():
        call()  # compile and warm up
        begin = perf_counter()
        call()
        calls[name] = max(1, int(_TURN / max(perf_counter() - begin, 1e-9)))
    for turn in range(max(_FEWEST, int(seconds / _TURN))):
        for name, (call, units) in candidates.items():
            if turn >= _FEWEST and spent[name] >= seconds:
                continue
            begin = perf_counter()
            for _ in range(calls[name]):
                call()
            taken = perf_counter() - begin
            spent[name] += taken
            best[name] = max(best[name], units * calls[name] / taken)
    return best


def quantiles(seconds: list[float]) -> tuple[float, float, float]:
    """Median, 99th percentile and maximum, ms."""
    p50, p99 = np.percentile(seconds, [50.0, 99.0])
    return 1e3 * float(p50), 1e3 * float(p99), 1e3 * max(seconds)


def machine() -> str:
    """One line on where the numbers come from."""
    return f"{platform.processor() or platform.machine()}, Python {platform.python_version()}, one core"
