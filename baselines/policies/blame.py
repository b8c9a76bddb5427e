"""Whose line it was: the place in a user's file at which an error arose, or at which something is defined."""

from __future__ import annotations

import inspect
import sysconfig
import traceback
from functools import cache
from pathlib import Path
from typing import Any

_HOME = Path(__file__).resolve().parents[2]
_OURS = tuple(str(_HOME / package) for package in ("quad_envs", "controllers", "baselines"))
_INSTALLED = ("site-packages", "dist-packages")  # folders of other people's packages


@cache
def _library() -> tuple[str, ...]:
    """Folders of Python itself."""
    return tuple(str(Path(sysconfig.get_path(name)).resolve()) for name in ("stdlib", "platstdlib"))


def told(error: BaseException) -> str:
    """Kind and words of an error, on one line."""
    words = " ".join(str(error).split())
    return f"{type(error).__name__}: {words}" if words else type(error).__name__


def place_of(error: BaseException) -> str:
    """File and line of the user's code that raised an error, as "mypolicy.py, line 12"; "" if none did.

    The innermost line that belongs neither to this suite nor to an installed package counts. If there is
    none, the outermost one of an installed package, which is what the suite called.
    """
    if isinstance(error, SyntaxError) and error.filename:
        return _place(error.filename, error.lineno)
    calls = [call for call in traceback.extract_tb(error.__traceback__) if not _is_library(call.filename)]
    own = [call for call in calls if not any(part in Path(call.filename).parts for part in _INSTALLED)]
    if not calls:
        return ""
    call = own[-1] if own else calls[0]
    return _place(call.filename, call.lineno)


def place_where_defined(found: Any) -> str:
    """File and line where a function, a class or the `predict` of a policy is defined; "" if unknown."""
    code = found if inspect.isroutine(found) or inspect.isclass(found) else type(found)
    try:
        code = inspect.unwrap(code)
        file, (_, line) = inspect.getsourcefile(code), inspect.getsourcelines(code)
    except (OSError, TypeError, ValueError):
        return ""
    return _place(file, max(line, 1)) if file else ""


def _is_library(filename: str) -> bool:
    """Whether a file is of this suite or of Python itself."""
    if filename.startswith("<frozen"):
        return True
    path = Path(filename)
    text = str(path.resolve())
    if any(part in path.parts for part in _INSTALLED):
        return False
    return text.startswith(_OURS) or text.startswith(_library())


def _place(filename: str, line: int | None) -> str:
    """Words for a place; the file as seen from the current folder."""
    path = Path(filename)
    shown = path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
    return str(shown) if line is None else f"{shown}, line {line}"
