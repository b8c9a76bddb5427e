"""What a figure finds: so much was tried, and this went wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple


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


def tried(what: str, run: Callable[[], str]) -> Found:
    """One try; `run` says what is wrong, or nothing. An exception that it lets through is wrong, too."""
    try:
        said = run()
    except Exception as error:
        said = f"{type(error).__name__}: {error}"
    return Found(1, (f"{what}: {' '.join(said.split())[:300]}",) if said else ())
