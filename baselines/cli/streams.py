"""Standard streams as a command finds them: closed, or with a reader that leaves."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

BROKEN_PIPE = 141  # as the shell names the signal


def take_streams() -> bool:
    """Make sure that what is printed goes nowhere else; whether there is a standard output at all.

    A closed stream leaves its number to the next file that is opened, which would then be printed into.
    """
    has_output = sys.stdout is not None
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            _onto_null(number)
            setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))
    return has_output


def _onto_null(number: int) -> None:
    """Let a file descriptor read and write nothing."""
    null = os.open(os.devnull, os.O_RDWR)
    if null != number:
        os.dup2(null, number)
        os.close(null)


def give_up_output() -> None:
    """Forget what is printed and cannot be written, as on a full disk, so that nothing tries it again."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError:
        _onto_null(sys.stdout.fileno())


@contextmanager
def quiet_pipe() -> Iterator[None]:
    """End without a word when the reader of a pipe, as `head`, has gone; with one where a disk is full."""
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        _onto_null(sys.stdout.fileno())
        raise SystemExit(BROKEN_PIPE) from None
    except OSError as error:
        if os.environ.get("QUAD_ENVS_TRACEBACK"):
            raise
        _onto_null(sys.stdout.fileno())
        print(f"quad-envs: error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
