"""The results folder: written atomically, locked while a sweep runs, and resumable.

config.json        suite, its protocol if it is one, versions, git revision, command
cells/*.json       up to 500 flights of one unit (environment x policy) each; the name ends with a digest of
                   all that they depend on, the seed of the first start, and how many there are
episodes/*.npz     the first flights of each unit, or all if asked for; a team in one file, vehicles first
report.html        the leaderboard and these flights to look at, see `baselines.report`
results.csv        one row per environment x policy x flight (x vehicle), when all units are finished
summary.csv        one row per environment x policy
failures.json      policies that could not be made or broke off, where, and why
frontier-*.svg     score against quadratic cost, where the suite traces the family of an MPC
contenders.csv     one row per table x environment x contender, where policies have seeds: all of them are one
claims/            who is at what, where several processes share the folder
networks/          folders of networks, see training/run_folder.py, and of tuned controllers
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import os
import platform
import socket
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

import quad_envs

from .errors import ResultsError

_LOCK = ".lock"
_UNFINISHED = 600.0  # s after which a file that is being written belongs to nobody
FAILURES = "failures.json"
_RESULTS = (
    "results.csv",
    "summary.csv",
    "contenders.csv",
    FAILURES,
    "report.html",
    "replay.html",
    "frontier-*.svg",
    "cells/*.json",
    "cells/*.failed",
    "claims/*",
    "episodes/*.npz",
)
RESULTS_FORMAT = 3  # of the folder; 2 had one cell per unit, 1 neither this number nor tasks in cells
_SOURCES = (".py", ".toml", ".json", ".safetensors")
_DISTRIBUTIONS = ("gymnasium", "pettingzoo", "numpy", "scipy", "numba", "osqp", "joblib")


def write_atomic(path: Path, data: bytes) -> None:
    """Write a file so that it is either complete or not there.

    Raises:
        ResultsError: If it cannot be written; nothing half-written stays behind.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise ResultsError(
            f"cannot write {str(path)!r}: {error.strerror or error}; choose another folder, or "
            "free it and start again: finished units are kept"
        ) from error
    finally:
        with suppress(OSError):  # the folder itself is not usable, which the error above says
            temporary.unlink(missing_ok=True)


def plain_json(value: Any) -> Any:
    """Nested values as JSON knows them: numpy scalars become numbers, nan and infinity None."""
    if isinstance(value, Mapping):
        return {str(key): plain_json(entry) for key, entry in value.items()}
    if isinstance(value, str) or value is None:
        return value
    if isinstance(value, np.ndarray | np.generic):
        return plain_json(value.tolist())
    if isinstance(value, Sequence | Iterable):
        return [plain_json(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def is_plain(value: Any) -> bool:
    """Whether a value, from `plain_json`, is one that JSON has."""
    if isinstance(value, dict):
        return all(map(is_plain, value.values()))
    if isinstance(value, list):
        return all(map(is_plain, value))
    return value is None or isinstance(value, str | int | float)


def write_json(path: Path, value: Any) -> None:
    """Write a value as JSON."""
    write_atomic(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> Any:
    """Read a JSON file of the folder.

    Raises:
        ResultsError: If it cannot be read.
    """
    try:
        return _parsed(path)
    except (OSError, ValueError, RecursionError) as error:
        remedy = "choose another folder" if path.name == "config.json" else "delete it to fly this unit again"
        raise ResultsError(f"cannot read {str(path)!r}: {error}; {remedy}") from error


def _parsed(path: Path) -> Any:
    """What a JSON file says; a pipe or a device is none, and would never end."""
    if path.exists() and not path.is_file():
        raise ValueError("it is not a regular file")
    return json.loads(path.read_text())


def write_csv(path: Path, rows: Iterable[Mapping[str, Any]], columns: Iterable[str] = ()) -> None:
    """Write rows; what is absent or nan stays empty.

    Args:
        path: Of the file.
        rows: One after another, if the columns are given.
        columns: Their names; the union of those of all rows, if not given.
    """
    columns = list(columns)
    if not columns:
        rows = list(rows)
        columns = list(dict.fromkeys(key for row in rows for key in row))
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, restval="")
    writer.writeheader()
    for row in rows:
        writer.writerow({key: "" if value is None or value != value else value for key, value in row.items()})
    write_atomic(path, text.getvalue().encode())


def discard(folder: Path) -> None:
    """Delete the results of an earlier run, and nothing else.

    Raises:
        ResultsError: If the folder holds files of these names that no run of ours has written.
    """
    refuse_foreign(folder)
    for pattern in (*_RESULTS, "config.json"):  # config.json last: it says whose the others are
        for path in folder.glob(pattern):
            path.unlink()


def refuse_foreign(folder: Path) -> None:
    """Check that what a run would overwrite in a folder is from an earlier run.

    Raises:
        ResultsError: If config.json is not ours, or there are results without one.
    """
    config = folder / "config.json"
    if config.exists():
        found = read_json(config)
        if isinstance(found, dict) and isinstance(found.get("suite"), dict) and "source" in found:
            return
        what = "config.json"
    else:
        names = [path.relative_to(folder) for pattern in _RESULTS for path in folder.glob(pattern)]
        if not names:
            return
        what = str(min(names))
    raise ResultsError(
        f"{str(folder)!r} holds a {what} that no benchmark has written; choose another folder, "
        "or move it away"
    )


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the folder for one sweep; makes it if need be.

    The operating system holds the lock on the open file and drops it when the process ends, however it ends.
    The file stays: were it removed, one process could hold the old file and another the new one. Its text is
    there for the message only.

    Raises:
        ResultsError: If another process holds it, or it cannot be made.
    """
    path = folder / _LOCK
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = open(path, "a+", encoding="utf-8")
    except FileExistsError as error:
        raise ResultsError(f"{str(folder)!r} is a file, not a folder; choose another one") from error
    except OSError as error:
        raise ResultsError(
            f"cannot write into {str(folder)!r}: {error.strerror or error}; choose another folder"
        ) from error
    with file:
        if not _acquired(file.fileno(), path):
            held = _owner(path)
            raise ResultsError(
                f"{str(folder)!r} is in use by process {held.get('pid', '?')} on {held.get('host', '?')}; "
                "wait for it, or choose another folder"
            )
        file.truncate(0)
        json.dump({"pid": os.getpid(), "host": socket.gethostname()}, file)
        file.flush()
        _sweep(folder)
        try:
            yield
        finally:
            with suppress(OSError):
                file.truncate(0)


def _sweep(folder: Path) -> None:
    """Delete what writers that died left unfinished; another that is at work has a young file."""
    since = time.time() - _UNFINISHED
    for path in folder.rglob(".*.tmp"):
        with suppress(OSError):
            if path.stat().st_mtime < since:
                path.unlink()


@contextmanager
def claimed(path: Path) -> Iterator[bool]:
    """Hold a lock file, which is made if need be; gives whether it is ours, or another process has it.

    Raises:
        ResultsError: If it cannot be made or locked.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = open(path, "a+", encoding="utf-8")
    except OSError as error:
        raise ResultsError(
            f"cannot write {str(path)!r}: {error.strerror or error}; choose another folder"
        ) from error
    with file:
        yield _acquired(file.fileno(), path)


def _acquired(descriptor: int, path: Path) -> bool:
    """Lock an open file at once; whether it is ours, or another process has it.

    Raises:
        ResultsError: If files cannot be locked there.
    """
    try:
        _acquire(descriptor)
    except (BlockingIOError, PermissionError):
        return False
    except OSError as error:
        raise ResultsError(
            f"cannot lock {str(path)!r}: {error.strerror or error}; choose a folder on another disk"
        ) from error
    return True


def _acquire(descriptor: int) -> None:
    """Lock an open file at once, or raise."""
    if sys.platform == "win32":
        import msvcrt

        os.lseek(descriptor, 1 << 30, os.SEEK_SET)  # a byte far behind the text, which others may read
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _owner(path: Path) -> dict[str, Any]:
    try:
        found = _parsed(path)
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def provenance() -> dict[str, Any]:
    """Versions, revision and machine, for config.json."""
    return {
        "versions": {
            "quad-envs": quad_envs.__version__,
            "python": platform.python_version(),
            **{name: metadata.version(name) for name in _DISTRIBUTIONS},
        },
        "git_revision": git_revision(),
        "source": source_digest(),
        "platform": platform.platform(),
        "command": sys.argv,
    }


def source_digest() -> str:
    """Digest of the three packages and what they bring, so that results of different code are not mixed."""
    home, digest = Path(quad_envs.__file__).resolve().parents[1], hashlib.sha256()
    for package in ("quad_envs", "controllers", "baselines"):
        for path in sorted((home / package).rglob("*")):
            if path.suffix in _SOURCES:
                digest.update(str(path.relative_to(home)).encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def git_revision() -> str | None:
    """Revision of the checkout that quad_envs comes from, with '+' if it has changes; None without one."""
    package = Path(quad_envs.__file__).resolve().parent

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(package), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        if Path(git("rev-parse", "--show-toplevel")).resolve() != package.parent:
            return None  # installed somewhere below another project's checkout
        changes = git("status", "--porcelain", "--untracked-files=no")
        return git("rev-parse", "HEAD") + ("+" if changes else "")
    except (OSError, subprocess.SubprocessError):
        return None
