"""`quad-envs worker`: take part in a sweep whose results folder several machines share."""

from __future__ import annotations

from ..interruptions import exit_code
from .commands import plain_warnings, say
from .options import WorkerOptions


def join(options: WorkerOptions) -> int:
    """Fly what nobody else is at, until nothing is left; 1 if something was not to be had."""
    from ..report.benchmark import join_sweep
    from ..sweeps.stages import SweepProgress

    watcher = SweepProgress()
    with plain_warnings():
        try:
            flown, failures = join_sweep(options.folder, watcher)
        except KeyboardInterrupt as interruption:
            say("interrupted; what this worker was at is free for others")
            return exit_code(interruption)
        finally:
            watcher.close()
    say(f"nothing is left in {options.folder}: {flown} units are flown, {len(failures)} are not to be had")
    return 1 if failures else 0
