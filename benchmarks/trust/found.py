"""What a figure finds: so much was tried, and this went wrong."""

from __future__ import annotations

import signal
import traceback
from collections.abc import Callable, Iterator
from types import FrameType
from typing import NamedTuple

_SECONDS = 60.0  # after which a try hangs


class Found(NamedTuple):
    """Some tries."""

    tried: int
    wrong: tuple[str, ...] = ()  # what failed, a line each
    worst: float = 0.0  # of a number that the figure watches, where it has one


class Figure(NamedTuple):
    """Something that is tried many times."""

    title: str
    asked: int  # tries that the table asks for
    unit: str  # of which the tries are
    tries: Callable[[int], Iterator[Found]]  # seed -> tries without end
    worst: str = ""  # what the watched number is


def tried(what: str, run: Callable[[], str | None]) -> Found:
    """One try; `run` says what is wrong, or nothing. What it raises is wrong, too, and so is to hang."""
    before = signal.signal(signal.SIGALRM, _hangs)
    signal.setitimer(signal.ITIMER_REAL, _SECONDS)
    try:
        said = run() or ""
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # SystemExit, too
        said = f"{type(error).__name__}: {error}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    return Found(1, (f"{what}: {' '.join(said.split())[:400]}",) if said else ())


class Hangs(BaseException):
    """A try takes far longer than any should; nobody is to catch this."""


def _hangs(number: int, frame: FrameType | None) -> None:
    where = traceback.extract_stack(frame)[-1]
    raise Hangs(f"for {_SECONDS:.0f} s, in {where.name} of {where.filename}")
