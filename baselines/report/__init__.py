"""The report of a results folder: one self-contained page with the leaderboard and the flights to look at."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .build import Choice, build_report, render_report
    from .page import render_page

_PUBLIC = {
    "Choice": "build",
    "build_report": "build",
    "render_page": "page",
    "render_report": "build",
}

__all__ = ["Choice", "build_report", "render_page", "render_report"]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(f".{_PUBLIC[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
