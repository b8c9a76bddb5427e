"""Several processes at one results folder, on machines that share its disk: each claims what nobody is at.

A claim is a lock that the operating system holds on an open file, and drops with its process: what a worker
that died was at is claimed again, unless several have died at it. Who begins the sweep (`quad-envs benchmark
... --engine folder`) takes part as all others do (`quad-envs worker FOLDER`), and alone checks the folder
before and writes the tables after.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from ..files import claimed, read_json, write_json

CLAIMS = "claims"  # folder
_MOST_DEATHS = 3  # of processes at one task, before it is given up
_POLL = 0.5  # s between two looks at what others have finished


class Task(NamedTuple):
    """Something to do once, by whomever."""

    number: int
    name: str  # of its claim
    stored: Callable[[], Any]  # what it gave; None if nobody has done it
    do: Callable[[], Any]  # do it, and store what it gives
    give_up: Callable[[str], Any]  # store why it is not done, and give what then stands for it


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
                        found = _done(task, folder) if found is None else found
            if found is None:
                left.append(task)
            else:
                yield task.number, found
        if len(left) == len(waiting):
            time.sleep(_POLL)
        waiting = left


def _done(task: Task, folder: Path) -> Any:
    """What a task that is ours gives; it is given up where process after process died at it."""
    path = folder / CLAIMS / f"{task.name}.begun"
    begun = read_json(path) if path.exists() else 0
    with _counted(path, begun + 1 if isinstance(begun, int) else 1) as count:
        if count <= _MOST_DEATHS:
            return task.do()
        return task.give_up(
            f"{_MOST_DEATHS} processes died at it, as of too little memory or by what it runs; the next "
            "quad-envs benchmark of this folder tries it anew"
        )


@contextmanager
def _counted(path: Path, count: int) -> Iterator[int]:
    """A file that says how often something was begun, and is there after its process has died alone."""
    write_json(path, count)
    try:
        yield count
    finally:
        path.unlink(missing_ok=True)
