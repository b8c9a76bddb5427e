"""Several processes at one results folder, on machines that share its disk: each claims what nobody is at.

A claim is a lock that the operating system holds on an open file, and drops with its process: what a worker
that died was at is claimed again. Who begins the sweep (`quad-envs benchmark ... --engine folder`) takes part
as all others do (`quad-envs worker FOLDER`), and alone checks the folder before and writes the tables after.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..files import claimed

CLAIMS = "claims"  # folder
_POLL = 0.5  # s between two looks at what others have finished


class Task(NamedTuple):
    """Something to do once, by whomever."""

    number: int
    name: str  # of its claim
    stored: Callable[[], Any]  # what it gave; None if nobody has done it
    do: Callable[[], Any]  # do it, and store what it gives


def share(tasks: Sequence[Task], folder: Path) -> Iterator[tuple[int, Any]]:
    """Do the tasks that nobody else is at, and yield (number, what it gave) of all, as they are finished.

    Args:
        tasks: All that there are.
        folder: The results folder, on a disk that keeps locks.
    """
    waiting = list(tasks)
    while waiting:
        left = []
        for task in waiting:
            found = task.stored()
            if found is None:
                with claimed(folder / CLAIMS / f"{task.name}.lock") as ours:
                    if ours:
                        found = task.stored()  # it may have been finished just before
                        found = task.do() if found is None else found
            if found is None:
                left.append(task)
            else:
                yield task.number, found
        if len(left) == len(waiting):
            time.sleep(_POLL)
        waiting = left
