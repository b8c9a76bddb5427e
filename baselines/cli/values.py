"""Values on the command line: JSON, a Python literal, or a mapping without quotes, {kind: helix, radius: 2}.

The last is what YAML calls a flow mapping and TOML an inline table: `{key: value, ...}` or `{key = value}`
and `[value, ...]`, nested, with bare or quoted words. A bare value ends at a comma or bracket, and is itself
JSON, a Python literal or text; so paths need no quotes unless they hold one of these signs.
"""

from __future__ import annotations

import ast
import json
from typing import Any

_DEEPEST = 20  # brackets in brackets
_MOST = 1_000_000  # characters
_NOT_FINITE = ("inf", "+inf", "-inf", "nan")


def read_value(text: str) -> Any:
    """The value of a text.

    Raises:
        ValueError: If it begins with a bracket and is no mapping or list; the message names the place.
    """
    if len(text) > _MOST:
        raise ValueError(f"a value is longer than {_MOST} characters: put it into a file")
    _require_shallow(text)
    try:
        return _scalar(text)
    except ValueError:
        if not text.lstrip().startswith(("{", "[")):
            return text
    value, end = _value(text, 0)
    end = _skip(text, end)
    if end < len(text):
        raise _mistake(text, end, "nothing more")
    return value


def _scalar(text: str) -> Any:
    """A JSON value, a Python literal, as .5 or (1, 2), or inf.

    Raises:
        ValueError: If it is neither.
    """
    if text.strip() in _NOT_FINITE:  # as `quad-envs list` shows them
        return float(text)
    for read in (json.loads, ast.literal_eval):
        try:
            return read(text)
        except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
            continue
    raise ValueError(text)


def _value(text: str, at: int) -> tuple[Any, int]:
    """The value that begins at a place, and where it ends."""
    at = _skip(text, at)
    sign = text[at : at + 1]
    if sign == "{":
        return _mapping(text, at + 1)
    if sign == "[":
        return _list(text, at + 1)
    if sign in ("'", '"') and sign:
        return _quoted(text, at)
    word, end = _word(text, at, ",]}")
    if not word:
        raise _mistake(text, at, "a value")
    try:
        return _scalar(word), end
    except ValueError:
        return word, end


def _mapping(text: str, at: int) -> tuple[dict[str, Any], int]:
    out: dict[str, Any] = {}
    while True:
        at = _skip(text, at)
        if text[at : at + 1] == "}":
            return out, at + 1
        start = at
        quoted = text[at : at + 1] in ("'", '"') and at < len(text)
        key, at = _quoted(text, at) if quoted else _word(text, at, ":=,]}")
        at = _skip(text, at)
        if not key or text[at : at + 1] not in (":", "="):
            raise _mistake(text, at, "a key and ':'")
        if key in out:
            raise _mistake(text, start, f"another key, {key!r} is there twice")
        out[key], at = _value(text, at + 1)
        at = _next(text, at, "}")


def _list(text: str, at: int) -> tuple[list[Any], int]:
    out: list[Any] = []
    while True:
        at = _skip(text, at)
        if text[at : at + 1] == "]":
            return out, at + 1
        value, at = _value(text, at)
        out.append(value)
        at = _next(text, at, "]")


def _next(text: str, at: int, closing: str) -> int:
    """Behind the comma after an entry, or at the closing bracket."""
    at = _skip(text, at)
    sign = text[at : at + 1]
    if sign == ",":
        return at + 1
    if sign != closing:
        raise _mistake(text, at, f"',' or {closing!r}")
    return at


def _word(text: str, at: int, until: str) -> tuple[str, int]:
    end = at
    while end < len(text) and text[end] not in until:
        end += 1
    return text[at:end].strip(), end


def _quoted(text: str, at: int) -> tuple[str, int]:
    end = text.find(text[at], at + 1)
    if end < 0:
        raise _mistake(text, len(text), f"a closing {text[at]}")
    return text[at + 1 : end], end + 1


def _skip(text: str, at: int) -> int:
    while at < len(text) and text[at].isspace():
        at += 1
    return at


def _require_shallow(text: str) -> None:
    """Refuse brackets so deep that no reader would get to their ground."""
    depth = 0
    for sign in text:
        depth += (sign in "{[(") - (sign in "}])")
        if depth > _DEEPEST:
            raise ValueError(f"a value has more than {_DEEPEST} brackets in each other")


def _mistake(text: str, at: int, wanted: str) -> ValueError:
    """What is wrong at a place."""
    near = text[max(0, at - 20) : at + 20]
    found = "the end" if at >= len(text) else repr(text[at])
    return ValueError(f"expected {wanted} at character {at + 1}, got {found}, near {near!r}")
