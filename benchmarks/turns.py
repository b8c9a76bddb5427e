"""Processes of two checkouts that do the same thing in turns, so that both meet the same minutes."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent.parent


class Process:
    """A process that answers each line of JSON with another one.

    Args:
        process: It, started by `at_work`.
    """

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def ask(self, *what: Any) -> Any:
        """The answer to one question."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(what) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())


@contextmanager
def at_work(checkout: Path, code: str, *arguments: str) -> Iterator[Process]:
    """A process that runs this code, with the packages of a checkout, until the block ends."""
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        cwd=checkout,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    with process:
        yield Process(process)
        assert process.stdin is not None
        process.stdin.close()
