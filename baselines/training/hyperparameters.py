"""Hyperparameters: the defaults of an algorithm, its committed TOML file, and what the caller overrides.

hyperparameters/ALGORITHM.toml has a table [default] and one per id, each only with what differs from the
table before it; the first of them are the defaults of the options dataclass.
"""

from __future__ import annotations

import sys
from collections.abc import Collection, Mapping
from dataclasses import MISSING, asdict, fields
from importlib import resources
from typing import Any

import numpy as np

from quad_envs.arguments.kinds import is_number, is_whole
from quad_envs.arguments.names import shown, unknown_name

from .algorithms import ALGORITHMS, options_of
from .former_names import in_names_of_today, may_be_slip, name_of_today

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_BEFORE = {"command_range": 1.0}  # what was done before it could be chosen, where that is no default
_SLIP = 0.75  # likeness from which a name is taken for a slip: many names of learners are alike


def hyperparameter_file(algorithm: str) -> dict[str, dict[str, Any]]:
    """The tables of an algorithm's file; empty without one."""
    file = resources.files(__package__).joinpath("hyperparameters", f"{algorithm}.toml")
    if not file.is_file():
        return {}
    tables = tomllib.loads(file.read_text(encoding="utf-8"))
    return {name: dict(values) for name, values in tables.items()}


def hyperparameters(algorithm: str, env_id: str, overrides: Mapping[str, Any] | None = None) -> Any:
    """The options of an algorithm for a task.

    Args:
        algorithm: Its name.
        env_id: The task; one without a table of its own gets the defaults.
        overrides: What the caller chooses instead.

    Raises:
        ValueError: If a name or value is not allowed; the message suggests the nearest name.
    """
    kind, tables = options_of(algorithm), hyperparameter_file(algorithm)
    values: dict[str, Any] = {}
    sources = [(f"[{name}] of {algorithm}.toml", tables.get(name, {})) for name in ("default", env_id)]
    for source, table in (*sources, ("your choice", overrides or {})):
        values |= {name: _checked(kind, algorithm, name, value, source) for name, value in table.items()}
    try:
        return kind(**values)
    except TypeError as error:
        raise ValueError(f"hyperparameters of {algorithm!r}: {error}") from error


def plain_options(options: Any) -> dict[str, Any]:
    """Options as values of JSON."""
    return {
        name: list(value) if isinstance(value, tuple) else value for name, value in asdict(options).items()
    }


def recorded_hyperparameters(algorithm: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """What a run or a checkpoint recorded, under the names of today.

    Args:
        algorithm: Its name; of one that is not there, the record stays as it is.
        values: As they were recorded, maybe by an earlier version. What that did not say yet had its default.
    """
    if algorithm not in ALGORITHMS:
        return dict(values)
    defaults = plain_options(options_of(algorithm)())
    before = {name: value for name, value in _BEFORE.items() if name in defaults}
    return defaults | before | in_names_of_today(values, defaults)


def _unknown(algorithm: str, name: str, known: Collection[str]) -> str:
    """What to say of a hyperparameter that an algorithm has not."""
    today = name_of_today(name, known)
    if today is not None:
        return f"hyperparameter {shown(name)} of {algorithm!r} is called {today!r}"
    owners = [other for other in ALGORITHMS if name in {entry.name for entry in fields(options_of(other))}]
    if owners:
        have = f"{' and '.join(owners)} {'has' if len(owners) == 1 else 'have'} one"
        return f"{algorithm!r} has no hyperparameter {shown(name)}, {have}; known: {', '.join(known)}"
    near = _SLIP if may_be_slip(name) else 1.0
    return unknown_name(f"hyperparameter of {algorithm!r}", name, known, near)


def _checked(kind: type[Any], algorithm: str, name: str, value: Any, source: str) -> Any:
    """A value as its field wants it."""
    known = {entry.name: entry for entry in fields(kind)}
    if name not in known:
        shows = f"({source}; quad-envs list {algorithm} shows what each is)"
        raise ValueError(f"{_unknown(algorithm, name, known)} {shows}")
    default = known[name].default
    if "Mapping" in str(known[name].type):
        if not (value is None or isinstance(value, Mapping)):
            raise ValueError(
                f"hyperparameter {name} of {algorithm!r} must be a mapping from names to values, got "
                f"{shown(value)} ({source})"
            )
        return value
    if default is MISSING or default is None or value is None:
        if not (value is None or is_number(value) or isinstance(value, str | list | tuple)):
            raise ValueError(
                f"hyperparameter {name} of {algorithm!r} must be a number, text or a list, got {shown(value)}"
            )
        return tuple(value) if isinstance(value, list) else value
    if isinstance(default, tuple):
        fits, wanted = isinstance(value, list | tuple), "a list"
        value = tuple(value) if fits else value
    elif isinstance(default, bool):
        fits, wanted = isinstance(value, bool), "true or false"
    elif str(known[name].type) == "float | str":
        fits, wanted = isinstance(value, str) or _is_real(value), "a number or text"
        value = float(value) if _is_real(value) else value
    elif isinstance(default, int):
        fits, wanted = is_whole(value), "a whole number"
        value = int(value) if fits else value
    elif isinstance(default, float):
        fits, wanted = _is_real(value), "a number"
        value = float(value) if fits else value
    else:
        fits, wanted = isinstance(value, type(default)), "text"
    if not fits:
        raise ValueError(
            f"hyperparameter {name} of {algorithm!r} must be {wanted}, got {shown(value)} ({source}; "
            f"default {default!r})"
        )
    return value


def _is_real(value: Any) -> bool:
    """Whether it is a number, finite or not; what it may be is checked with the others of its options."""
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
