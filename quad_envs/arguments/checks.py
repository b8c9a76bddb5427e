"""Checks of arguments that everything shares: numbers within bounds that have a reason, sizes that fit."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, get_args

from .kinds import is_number, is_whole
from .names import shown

_GIB = 2.0**30
_SHARE = 0.75  # of the machine's memory, that one thing may plan with
_MEMORY = 16 * _GIB  # of a machine that does not say


class Bound(NamedTuple):
    """What a number may be, and why."""

    least: float = 0.0
    most: float = math.inf  # infinite: any finite number
    unit: str = ""
    why: str = ""  # a clause, for the message
    open: bool = False  # whether `least` itself is not allowed

    def __str__(self) -> str:
        if self.most == math.inf:
            return f"a finite number {'>' if self.open else '>='} {self.least:g} {self.unit}".rstrip()
        low = f"a finite number > {self.least:g} and <=" if self.open else f"a number from {self.least:g} to"
        return f"{low} {self.most:g} {self.unit}".rstrip()


def require_number(what: str, value: Any, bound: Bound) -> None:
    """Check that a value is a number within a bound; True and False are none.

    Raises:
        ValueError: If it is not; the message has the bound and its reason.
    """
    if is_number(value) and bound.least <= value <= bound.most and not (bound.open and value == bound.least):
        return
    reason = f"; {bound.why}" if bound.why and is_number(value) else ""
    raise ValueError(f"{what} must be {bound}, got {shown(value)}{reason}")


def require_choice(name: str, value: object, kind: Any) -> None:
    """Check that `value` is one of the strings of a Literal type.

    Raises:
        ValueError: If it is not; names what is allowed.
    """
    if value not in get_args(kind):
        raise ValueError(f"{name} must be one of {', '.join(map(repr, get_args(kind)))}, got {shown(value)}")


def require_whole(
    what: str,
    value: Any,
    least: int,
    most: int | None = None,
    memory: Callable[[int], float] | None = None,
) -> None:
    """Check that a value is a whole number within bounds.

    Args:
        what: What it is, for the message.
        value: It.
        least: The smallest that is allowed.
        most: The largest that is allowed; None for any.
        memory: Bytes that a value takes, for the message about one that is too large.

    Raises:
        ValueError: If it is not.
    """
    whole = is_whole(value)
    if whole and value >= least and (most is None or value <= most):
        return
    allowed, taken = f">= {least}", ""
    if whole and most is not None and value > most:
        allowed = f"from {least} to {most}"
        taken = f", which would take about {memory_text(memory(int(value)))}" if memory else ""
    raise ValueError(f"{what} must be a whole number {allowed}, got {shown(value)}{taken}")


def require_path(what: str, value: Any) -> None:
    """Check that a value is a path, as text or an object.

    Raises:
        ValueError: If it is not.
    """
    if not isinstance(value, str | os.PathLike):
        raise ValueError(f"{what} must be a path, got {shown(value)}")


def require_paths(**given: Any) -> None:
    """Check that arguments are paths or None.

    Raises:
        ValueError: If one is neither; it names the argument.
    """
    for name, value in given.items():
        if value is not None:
            require_path(name, value)


def require_words(**given: Any) -> None:
    """Check that arguments are texts.

    Raises:
        ValueError: If one is not; it names the argument.
    """
    for name, value in given.items():
        if not isinstance(value, str):
            raise ValueError(f"{name} must be a text, got {shown(value)}")


def require_mappings(**given: Any) -> None:
    """Check that arguments are mappings or None.

    Raises:
        ValueError: If one is neither; it names the argument.
    """
    for name, value in given.items():
        if not isinstance(value, Mapping | None):
            raise ValueError(f"{name} must be a mapping of names to values, got {shown(value)}")


def require_memory(what: str, size: float, remedy: str) -> None:
    """Check that this machine has the memory for something, before it is taken.

    Args:
        what: Takes it, for the message.
        size: Bytes, at least.
        remedy: What to do if they are too many.

    Raises:
        ValueError: If they are.
    """
    has = _machine_memory()
    if size > _SHARE * has:
        raise ValueError(
            f"{what} would take {memory_text(size)}, more than {_SHARE:.0%} of this machine's "
            f"{has / _GIB:.3g} GiB: {remedy}"
        )


def memory_text(size: float) -> str:
    """Bytes as GiB, whatever their number."""
    try:
        return f"{float(size) / _GIB:.3g} GiB of memory"
    except OverflowError:  # an integer beyond all floats
        return "more memory than any machine has"


def array_bytes(*shapes: tuple[int, ...]) -> int:
    """Bytes of float64 arrays of these shapes."""
    return 8 * sum(math.prod(map(int, shape)) for shape in shapes)


def _machine_memory() -> float:
    try:
        return float(os.sysconf("SC_PAGE_SIZE")) * float(os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, OSError, ValueError):  # no POSIX system
        return _MEMORY
