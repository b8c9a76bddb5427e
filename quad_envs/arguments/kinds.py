"""Plain forms of what is flown: a mapping {"kind": name, field: value, ...} for a frozen dataclass.

The kinds of a table are names -> a value with defaults, or a dataclass some of whose fields must be given.
The fields and what they may be follow from these: nothing is listed twice.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass, replace
from typing import Any, TypeAlias, TypeGuard

import numpy as np

from .names import shown, unknown_name

Kinds: TypeAlias = Mapping[str, Any]
Parts: TypeAlias = Mapping[str, Callable[[Any], Any]]
DEEPEST = 20  # lists and mappings in each other
_NUMBERS = (int, float, np.integer, np.floating)


def as_tuple(value: Any, depth: int = 0) -> Any:
    """Lists and arrays from configuration files and the command line become tuples.

    Raises:
        ValueError: If they are nested deeper than anything that is asked for.
    """
    if depth > DEEPEST:
        raise ValueError(f"a value has lists in each other, more than {DEEPEST} deep")
    if isinstance(value, np.ndarray):
        value = value.tolist()
    return tuple(as_tuple(entry, depth + 1) for entry in value) if isinstance(value, list | tuple) else value


def make_kind(what: str, given: Mapping[str, Any], kinds: Kinds, parts: Parts | None = None) -> Any:
    """The value of a mapping.

    Args:
        what: It is, for messages: "reference", "target", ...
        given: "kind" and fields.
        kinds: Name -> kind.
        parts: Field -> what makes its value, of fields that hold another such value.

    Raises:
        ValueError: If the kind or a field is unknown or missing, or a value is not allowed.
    """
    if "kind" not in given:
        raise ValueError(
            f"a {what} as a mapping needs 'kind', one of {', '.join(kinds)}; got {shown(dict(given))}"
        )
    name = given["kind"]
    if not isinstance(name, str) or name not in kinds:
        raise ValueError(unknown_name(f"kind of {what}", name, kinds))
    entry, known = kinds[name], _init_fields(kinds[name])
    values: dict[str, Any] = {}
    for key, value in given.items():
        if key == "kind":
            continue
        if key not in known:
            raise ValueError(unknown_name(f"field of the {what} {name!r}:", key, known))
        values[key] = parts[key](value) if parts and key in parts else as_tuple(value)
        _require_alike(f"{key} of the {what} {name!r}", values[key], _default(entry, known[key]))
    try:
        return without_booleans(what, _made(what, name, entry, values), kinds)
    except TypeError as error:
        raise ValueError(f"the {what} {name!r} cannot be made of {shown(values)}: {error}") from None


def _made(what: str, name: str, entry: Any, values: Mapping[str, Any]) -> Any:
    """The value of a kind with these fields."""
    if not isinstance(entry, type):
        return replace(entry, **values)
    known = _init_fields(entry)
    missing = [key for key in known if key not in values and _default(entry, known[key]) is MISSING]
    if missing:
        raise ValueError(
            f"the {what} {name!r} needs {', '.join(missing)}, as {{'kind': {name!r}, {missing[0]!r}: ...}}"
        )
    return entry(**values)


def without_booleans(what: str, value: Any, kinds: Kinds) -> Any:
    """The value, of one of the kinds or not, in which no True or False stands for a number.

    Raises:
        ValueError: If one does.
    """
    known = [entry if isinstance(entry, type) else type(entry) for entry in kinds.values()]
    if type(value) in known:
        for one in _init_fields(value).values():
            if not isinstance(one.default, bool) and holds_booleans(getattr(value, one.name)):
                raise ValueError(
                    f"{one.name} of the {what} {type(value).__name__} must be numbers, "
                    f"got {shown(getattr(value, one.name))}"
                )
    return value


def refuse_class(what: str, value: Any) -> None:
    """Say that a value is wanted where its class is given.

    Raises:
        ValueError: If it is a class.
    """
    if isinstance(value, type):
        name = value.__name__
        raise ValueError(f"{what} must be a value, got the class {name}: write {name}(...)")


def mapping_of(value: Any, kinds: Kinds, plain: Callable[[Any], Any]) -> dict[str, Any] | None:
    """The mapping of a value, only of what differs from the kind's defaults; None if it is of no kind.

    Args:
        value: Any value.
        kinds: Name -> kind.
        plain: What makes the value of a field plain.
    """
    if not is_dataclass(value) or isinstance(value, type):
        return None
    for name, entry in kinds.items():
        if (entry if isinstance(entry, type) else type(entry)) is not type(value):
            continue
        out: dict[str, Any] = {"kind": name}
        for key, one in _init_fields(entry).items():
            found, default = getattr(value, key), _default(entry, one)
            if found is not default and not (type(found) is type(default) and found == default):
                out[key] = plain(found)
        return out
    return None


def _init_fields(entry: Any) -> dict[str, Field[Any]]:
    return {one.name: one for one in fields(entry) if one.init}


def _default(entry: Any, one: Field[Any]) -> Any:
    return one.default if isinstance(entry, type) else getattr(entry, one.name)


def _require_alike(what: str, value: Any, default: Any) -> None:
    """Refuse a value that is no number where the default is one, no three numbers where it has three."""
    if isinstance(default, bool):
        fits, wanted = isinstance(value, bool), "true or false"
    elif isinstance(default, int):
        fits, wanted = is_whole(value), "a whole number"
    elif isinstance(default, float):
        fits, wanted = is_number(value), f"a finite number, as {default!r}"
    elif isinstance(default, tuple) and all(map(is_number, default)):
        fits = isinstance(value, tuple) and len(value) == len(default) and all(map(is_number, value))
        wanted = f"{len(default)} finite numbers, as {list(default)}"
    else:
        return  # its own check says more
    if not fits:
        raise ValueError(f"{what} must be {wanted}, got {shown(value)}")


_KINDS_OF_TYPES: tuple[tuple[str, str, Callable[[Any], bool]], ...] = (  # how an annotation begins
    ("float", "a number", lambda x: isinstance(x, _NUMBERS)),
    ("int", "a number", lambda x: isinstance(x, _NUMBERS)),
    ("None", "None", lambda x: x is None),
    ("Literal", "a word", lambda x: isinstance(x, str)),
    ("tuple[float", "several numbers", lambda x: is_sequence(x) and all(isinstance(y, _NUMBERS) for y in x)),
    ("_Vector", "three numbers", lambda x: is_sequence(x) and all(isinstance(y, _NUMBERS) for y in x)),
    ("_Triple", "three numbers", lambda x: is_sequence(x) and all(isinstance(y, _NUMBERS) for y in x)),
    ("Sequence", "a sequence", lambda x: is_sequence(x) or isinstance(x, str)),
)


def require_kinds(value: Any) -> None:
    """Check that numbers stand in the fields of a frozen dataclass whose annotations say numbers.

    Which numbers they may be is left to their own checks, as is every field of another kind.

    Raises:
        ValueError: If not; it names the field.
    """
    for one in fields(value):
        parts = [
            next((kind for kind in _KINDS_OF_TYPES if part.strip().startswith(kind[0])), None)
            for part in str(one.type).split("|")
        ]
        known = [part for part in parts if part is not None]
        given = getattr(value, one.name)
        if len(known) < len(parts) or any(fits(given) for _, _, fits in known):
            continue
        wanted = " or ".join(dict.fromkeys(words for _, words, _ in known))
        raise ValueError(f"{one.name} must be {wanted}, got {shown(given)}")


def is_sequence(value: Any) -> bool:
    """Whether it is a list, a tuple or an array of at least one axis."""
    return isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim > 0)


def is_number(value: Any) -> TypeGuard[float]:
    """Whether it is a finite number."""
    if not isinstance(value, _NUMBERS) or isinstance(value, bool):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond all floats
        return False


def is_whole(value: Any) -> TypeGuard[int]:
    """Whether it is an integer; True and False are none."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def is_limit(value: Any) -> TypeGuard[float]:
    """Whether it is a number, or infinite for no limit."""
    return is_number(value) or (isinstance(value, float | np.floating) and math.isinf(value))


def holds_booleans(value: Any) -> bool:
    """Whether True or False stands where numbers are asked, in an array or in nested lists of them."""
    if isinstance(value, list | tuple):
        return any(map(holds_booleans, value))
    return isinstance(value, bool | np.bool_) or getattr(value, "dtype", None) == np.bool_
