"""What to say about a name that does not exist, and about values that may be long."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def shown(value: object, most: int = 80) -> str:
    """The repr of a value, cut where it is longer than a message should be."""
    text = repr(value[: 2 * most] if isinstance(value, str | bytes | tuple | list) else value)
    return text if len(text) <= most else f"{text[: most - 3]}..."


def nearest_name(name: object, known: Iterable[str]) -> str | None:
    """The known name that this one is a slip of, if there is one."""
    near = difflib.get_close_matches(str(name)[:100], list(known), n=1, cutoff=0.5)
    return near[0] if near else None


def unknown_name(kind: str, name: object, known: Iterable[str]) -> str:
    """An error message with the nearest known name, if there is one, and all of them."""
    return f"unknown {kind} {shown(name)}; {suggestion(name, known)}"


def suggestion(name: object, known: Iterable[str]) -> str:
    """The nearest known name, if there is one, and all of them."""
    names = list(known)
    near = nearest_name(name, names)
    hint = "" if near is None else f"did you mean {near!r}? "
    return f"{hint}known: {', '.join(names) if names else 'none'}"
