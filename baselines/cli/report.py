"""What the commands `report` and `replay` do."""

from __future__ import annotations

import os
import sys
import tempfile
import webbrowser
from pathlib import Path

from baselines.cli.commands import say
from baselines.cli.options import ReplayOptions, ReportOptions
from baselines.errors import ResultsError
from baselines.files import write_atomic

from ..report.build import Choice, render_report
from ..sweeps.folder import read_run


def make_page(options: ReportOptions) -> int:
    """Write the report of a results folder, and print its path."""
    page = options.out or options.run / "report.html"
    _write(page, render_report(read_run(options.run)))
    print(page)
    return 0


def replay(options: ReplayOptions) -> int:
    """Write a page that holds one start of one environment, open it in the browser, and print its path.

    Where the results folder cannot be written, the page goes to the folder for temporary files.
    """
    choice = Choice(options.env, options.policy, options.seed)
    text = render_report(read_run(options.run), choice)
    page = options.out or options.run / "replay.html"
    try:
        _write(page, text)
    except ResultsError:
        if options.out is not None:
            raise
        page = Path(tempfile.mkdtemp(prefix="quad-envs-")) / "replay.html"
        _write(page, text)
    if not _opened(page):
        say("no browser to open it with; this is the page:")
    print(page)
    return 0


def _write(page: Path, text: str) -> None:
    try:
        write_atomic(page, text.encode())
    except ResultsError as error:
        reason = error.__cause__.strerror if isinstance(error.__cause__, OSError) else None
        raise ResultsError(
            f"cannot write {str(page)!r}: {reason or error}; name another file with --out FILE"
        ) from error


def _opened(page: Path) -> bool:
    """Whether a browser has taken the page; one without a display would take the terminal."""
    desktop = (
        sys.platform in ("win32", "darwin") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )
    try:
        return bool(desktop) and webbrowser.open(page.resolve().as_uri())
    except (webbrowser.Error, OSError):
        return False
