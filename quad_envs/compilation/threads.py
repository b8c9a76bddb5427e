"""Threads that share the work on a batch; what is computed does not depend on their number."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any, TypeVar

_SHARE = 16  # rows at a time at most: a row with many active constraints takes longer than others
_Result = TypeVar("_Result")


class Threads:
    """The calling thread and others beside it, which begin when they are first needed.

    Args:
        count: How many take part.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self._pool: ThreadPoolExecutor | None = None
        self._process = 0  # to which the pool belongs: a fork has none of its threads

    def __getstate__(self) -> dict[str, Any]:
        return {"count": self.count, "_pool": None, "_process": 0}

    def each(self, work: Callable[[int], _Result], most: int | None = None) -> list[_Result]:
        """What work(thread) returns, or raises, in each thread at once; the calling one is number 0.

        Args:
            work: Called once in each thread.
            most: Of them at the most; None for all.
        """
        if self._pool is None or self._process != os.getpid():
            self._pool, self._process = ThreadPoolExecutor(self.count - 1, "quad_envs"), os.getpid()
        taking_part = self.count if most is None else min(self.count, most)
        others = [self._pool.submit(work, thread) for thread in range(1, taking_part)]
        try:
            own = work(0)
        finally:
            wait(others)  # nobody still writes when this returns
        return [own, *(other.result() for other in others)]

    def shares(self, units: int, work: Callable[[int, int, int], _Result]) -> list[_Result]:
        """What work(thread, begin, end) returns in each thread, which do an equal share of the units each."""
        cuts = [units * k // self.count for k in range(self.count + 1)]
        return self.each(lambda thread: work(thread, cuts[thread], cuts[thread + 1]))

    def run(self, rows: int, work: Callable[[int, int, int], int]) -> int:
        """Let the threads work until all rows are done; each takes the next few when it has done its last.

        Args:
            rows: How many there are.
            work: work(thread, begin, end) does these rows; -1, or a code >= 0 that ends it, larger for later
                rows. A thread of a number does one thing at a time.

        Returns:
            -1, or the smallest code.
        """
        share = max(1, min(_SHARE, rows // (2 * self.count)))
        begins = iter(range(0, rows, share))

        def go(thread: int) -> int:
            for begin in begins:
                code = work(thread, begin, min(begin + share, rows))
                if code >= 0:
                    return code
            return -1

        return min((code for code in self.each(go, rows) if code >= 0), default=-1)
