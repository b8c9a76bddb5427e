"""Other processes: commands that a test can interrupt, and code with and without compilation."""

import os
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


def printed_compiled_and_plain(code):
    """What the code prints with compiled kernels, and with kernels that run as plain Python."""
    return [
        subprocess.run(
            [sys.executable, "-W", "ignore", "-c", code],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "NUMBA_DISABLE_JIT": flag},
        ).stdout
        for flag in "01"
    ]


def printed_with_kernels_in(folder, script, *arguments):
    """What a script prints that finds and leaves its compiled kernels in a folder."""
    command = [sys.executable, str(script), *arguments]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder)}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
