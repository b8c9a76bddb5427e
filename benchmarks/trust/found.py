"""What a figure finds: so much was tried, and this went wrong."""

from __future__ import annotations

import signal
import traceback
from collections.abc import Callable, Iterator
from types import FrameType
from typing import NamedTuple


class Limit(NamedTuple):
    """When a try hangs."""

    timer: int  # of `signal.setitimer`
    number: int  # signal that it sends
    seconds: float
    unit: str


# By its CPU time, since the clock runs on where others share the machine; by the clock, since it may wait.
LIMITS = (
    Limit(signal.ITIMER_PROF, signal.SIGPROF, 60.0, "CPU-s"),
    Limit(signal.ITIMER_REAL, signal.SIGALRM, 600.0, "s by the clock"),
)


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
    before = {limit.number: signal.signal(limit.number, _hangs) for limit in LIMITS}
    for limit in LIMITS:
        signal.setitimer(limit.timer, limit.seconds)
    try:
        said = run() or ""
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # SystemExit, too
        said = f"{type(error).__name__}: {error}"
    finally:
        for limit in LIMITS:
            signal.setitimer(limit.timer, 0.0)
            signal.signal(limit.number, before[limit.number])
    return Found(1, (f"{what}: {' '.join(said.split())[:400]}",) if said else ())


class Hangs(BaseException):
    """A try takes far longer than any should; nobody is to catch this."""


def _hangs(number: int, frame: FrameType | None) -> None:
    where = traceback.extract_stack(frame)[-1]
    limit = next(one for one in LIMITS if one.number == number)
    raise Hangs(f"for {limit.seconds:g} {limit.unit}, in {where.name} of {where.filename}")
