"""Threads that step blocks of a batch side by side; rows do not depend on their number."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any


class Workers:
    """Runs a kernel over blocks 0..n-1 in equal shares, one of them in the calling thread.

    Args:
        threads: How many take part.
    """

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._pool: ThreadPoolExecutor | None = None
        self._process = 0  # to which the pool belongs: a fork has none of its threads

    def __getstate__(self) -> dict[str, Any]:
        return {"threads": self.threads, "_pool": None, "_process": 0}

    def run(self, kernel: Callable[..., int], n: int, *arguments: Any) -> int:
        """The sum of what kernel(*arguments, begin, end) returns of each share, or the first negative one."""
        if self._pool is None or self._process != os.getpid():
            self._pool, self._process = ThreadPoolExecutor(self.threads - 1, "quad_envs"), os.getpid()
        cuts = [n * k // self.threads for k in range(self.threads + 1)]
        rest = [self._pool.submit(kernel, *arguments, *cuts[k : k + 2]) for k in range(1, self.threads)]
        found = [kernel(*arguments, *cuts[:2]), *(share.result() for share in rest)]
        return min(found) if min(found) < 0 else sum(found)
