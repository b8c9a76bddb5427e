"""Ctrl-C, SIGTERM and SIGHUP that are not lost.

Python raises KeyboardInterrupt wherever it happens to be. In a finaliser, or in a callback from compiled code
(llvmlite while a kernel compiles, torch), nobody can catch it: Python writes it off, and the program goes on
as if nobody had pressed anything. Here a signal is also remembered, and loops ask for it.
"""

from __future__ import annotations

import errno
import os
import signal
import stat
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from types import FrameType
from typing import Any

HUNG_UP, INTERRUPTED, TERMINATED = 129, 130, 143  # exit codes, as the shell names the signals


class Terminated(KeyboardInterrupt):
    """SIGTERM, which ends a program as Ctrl-C does: what was reached is saved."""


class HungUp(KeyboardInterrupt):
    """SIGHUP, from a terminal that is closed: nobody reads what is said from then on."""


class _Memory:
    """What was signalled and has not been dealt with."""

    def __init__(self) -> None:
        self.pending: type[KeyboardInterrupt] | None = None
        self.held = 0  # blocks that are not to be interrupted
        self.late: type[KeyboardInterrupt] | None = None  # signalled in such a block


_memory = _Memory()
_KINDS = {signal.SIGINT: KeyboardInterrupt, signal.SIGTERM: Terminated}
_ENDING = [signal.SIGTERM]  # signals that end a program, beside Ctrl-C
if hasattr(signal, "SIGHUP"):  # which Windows does not have
    _KINDS[signal.SIGHUP] = HungUp
    _ENDING.append(signal.SIGHUP)


def exit_code(interruption: KeyboardInterrupt) -> int:
    """The exit code of a program that was interrupted."""
    if isinstance(interruption, HungUp):
        return HUNG_UP
    return TERMINATED if isinstance(interruption, Terminated) else INTERRUPTED


@contextmanager
def remembered(*, terminate: bool = False) -> Iterator[None]:
    """Remember Ctrl-C, and SIGTERM and SIGHUP too if asked to; blocks may be inside each other.

    Handlers that are not Python's own are left alone, as a signal that is ignored; so are other threads,
    which hear no signals.
    """
    usual: dict[signal.Signals, Any] = {signal.SIGINT: signal.default_int_handler}
    if terminate:
        usual |= dict.fromkeys(_ENDING, signal.SIG_DFL)
    ours = [number for number, handler in usual.items() if signal.getsignal(number) is handler]
    if threading.current_thread() is not threading.main_thread() or not ours:
        yield
        return
    hook = sys.unraisablehook
    sys.unraisablehook = _quiet(hook)
    for number in ours:
        signal.signal(number, _on_signal)
    try:
        yield
    finally:
        for number in ours:
            signal.signal(number, usual[number])
        sys.unraisablehook = hook
        _memory.pending = None


def submit_to(pool: Executor, *call: Any) -> Future[Any]:
    """`submit` of a pool of loky whose processes hear no Ctrl-C: who begins them hears it, and ends them.

    A terminal sends it to all of them at once, also to one that is still importing and can only print where.
    """
    from multiprocessing import resource_tracker

    from joblib.externals.loky.backend import resource_tracker as of_loky

    if not hasattr(signal, "pthread_sigmask"):  # Windows has none
        return pool.submit(*call)
    for tracker in (resource_tracker, of_loky):  # which let the signal through again when they begin
        tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        return pool.submit(*call)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def raise_lost() -> None:
    """Raise an interruption that was signalled, if it has not ended what it was to end.

    Raises:
        KeyboardInterrupt: If there is one.
    """
    pending, _memory.pending = _memory.pending, None
    if pending is not None:
        raise pending


@contextmanager
def held() -> Iterator[None]:
    """A block that is done as a whole: an interruption in it is raised at its end.

    Raises:
        KeyboardInterrupt: At the end, if there was one.
    """
    _memory.held += 1
    try:
        yield
    finally:
        _memory.held -= 1
        if _memory.held == 0 and _memory.late is not None:
            late, _memory.late = _memory.late, None
            raise late


def _on_signal(number: int, frame: FrameType | None) -> None:
    kind = _KINDS[signal.Signals(number)]
    if kind is HungUp:
        _leave_terminal()
    if _memory.held:
        _memory.late = kind
        return
    _memory.pending = kind
    raise kind


def _leave_terminal() -> None:
    """Say nothing to a terminal that is gone: writing to it would be another error."""
    import termios

    for number in (1, 2):
        try:
            if stat.S_ISCHR(os.fstat(number).st_mode):
                termios.tcgetattr(number)
        except (OSError, termios.error) as error:
            if error.args[0] != errno.EIO:
                continue  # no terminal, as /dev/null
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, number)
            os.close(null)


def _quiet(hook: Any) -> Any:
    """A hook that says nothing of interruptions that nobody could catch: they are remembered."""

    def unraisable(found: Any) -> None:
        if not issubclass(found.exc_type, KeyboardInterrupt):
            hook(found)

    return unraisable
