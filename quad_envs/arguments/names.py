"""What to say about a name that does not exist, and about values that may be long."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from reprlib import Repr

_MOST_DIGITS = 40
_LIKE = 0.5  # likeness, 0 to 1, from which a name is suggested
_PART = 4  # characters, from which a part of a name stands for it
_WORD, _LINE = 240, 2000  # characters


class _Short(Repr):
    """Reprs that are quick to make, whatever the value: of long or deep ones only the beginning is read."""

    def __init__(self, most: int) -> None:
        super().__init__()
        self.maxlevel = 6
        self.maxdict = self.maxlist = self.maxtuple = self.maxset = self.maxfrozenset = self.maxdeque = most
        self.maxstring = self.maxother = 4 * most

    def repr_str(self, x: str, level: int) -> str:
        return repr(x[: 2 * self.maxstring])

    def repr_int(self, x: int, level: int) -> str:
        digits = int(x.bit_length() * 0.30103) + 1
        return repr(x) if digits <= _MOST_DIGITS else f"an integer of about {digits} digits"


def shown(value: object, most: int = 80) -> str:
    """The repr of a value, cut where it is longer than a message should be, on one line."""
    try:
        text = " ".join(_Short(most).repr(value).split())
    except Exception:  # of somebody else's class
        text = f"a {type(value).__name__}"
    return text if len(text) <= most else f"{text[: most - 3]}..."


def shortened(text: str) -> str:
    """A message on one line: words as long as no path or name needs are cut, and so is what never ends."""
    words = (word if len(word) <= _WORD else f"{word[: _WORD // 2]}...{word[-20:]}" for word in text.split())
    line = " ".join(words)
    return line if len(line) <= _LINE else f"{line[: _LINE - 3]}..."


def nearest_name(name: object, known: Iterable[str], like: float = _LIKE) -> str | None:
    """The known name that this is in other capitals, a slip of, at least `like` it, or alone a part of."""
    text, names = str(name)[:100], list(known)
    near = [one for one in names if one.lower() == text.lower()]
    near = near or difflib.get_close_matches(text, names, n=1, cutoff=like)
    if not near and len(text) >= _PART:
        near = [one for one in names if text.lower() in one.lower()]
    return near[0] if len(near) == 1 else None


def unknown_name(kind: str, name: object, known: Iterable[str], like: float = _LIKE) -> str:
    """An error message with the nearest known name, if there is one, and all of them."""
    return f"unknown {kind} {shown(name)}; {suggestion(name, known, like)}"


def suggestion(name: object, known: Iterable[str], like: float = _LIKE) -> str:
    """The nearest known name, if there is one, and all of them."""
    names = list(known)
    near = nearest_name(name, names, like)
    hint = "" if near is None else f"did you mean {near!r}? "
    return f"{hint}known: {', '.join(names) if names else 'none'}"
