"""Commands as processes that a test can interrupt."""

import signal
import subprocess
import sys


def start_command(*arguments):
    """`quad-envs` with the arguments, as a process that hears Ctrl-C.

    A shell starts what runs in its background with SIGINT ignored, which children inherit: tests that run
    there would send their Ctrl-C to the deaf.
    """
    return subprocess.Popen(
        [sys.executable, "-m", "baselines", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
