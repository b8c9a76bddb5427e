"""Whether a policy is known to decide each row by itself, so that many flights may be its rows."""

from __future__ import annotations

from typing import Any

import numpy as np

from .protocol import Policy

_SUITE = ("baselines", "controllers", "quad_envs")
_KNOWN = (*_SUITE, "builtins", "numpy", "numba", "stable_baselines3")  # whose parts remember no decision


def has_independent_rows(policy: Policy | Any) -> bool:
    """Whether a policy may be given the observations of several flights at once.

    The policies of this suite may, as long as no part of them is somebody else's. Others say so themselves:
    `independent_rows = True`, for which `check_policy` tests. One that decides for a whole team may not.
    """
    if getattr(policy, "privileged", False):
        return False
    said = getattr(policy, "independent_rows", None)
    if said is not None:
        return bool(said)
    return _home(type(policy)) in _SUITE and _is_ours(policy, set())


def _is_ours(part: Any, seen: set[int]) -> bool:
    """Whether code that belongs to nobody else is behind an object and what hangs on it."""
    if part is None or isinstance(part, str | int | float | np.ndarray) or id(part) in seen:
        return True
    seen.add(id(part))
    if isinstance(part, list | tuple):
        return all(_is_ours(each, seen) for each in part)
    if isinstance(part, dict):
        return all(_is_ours(each, seen) for each in part.values())
    code = part if hasattr(part, "__qualname__") else type(part)  # a function, a class, or an object
    if _home(code) not in _KNOWN:
        return False
    return _home(code) not in _SUITE or code is part or _is_ours(_attributes(part), seen)


def _home(code: Any) -> str:
    """Package of a class or a function."""
    return str(getattr(code, "__module__", None)).partition(".")[0]


def _attributes(part: Any) -> list[Any]:
    """Values of the attributes of an object."""
    slots = [name for kind in type(part).__mro__ for name in getattr(kind, "__slots__", ())]
    return [*getattr(part, "__dict__", {}).values(), *(getattr(part, name, None) for name in slots)]
