"""Errors of the baselines, and the wording for names that do not exist."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class PolicyCheckError(ValueError):
    """A policy does not keep the protocol; the message says where."""


class ResultsError(ValueError):
    """A results folder cannot be used; the message says why and what to do."""


def unknown_name(kind: str, name: object, known: Iterable[str]) -> str:
    """What to say about a name that is not known: the nearest one if there is one, and all of them."""
    names = list(known)
    near = difflib.get_close_matches(str(name), names, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]!r}? " if near else ""
    return f"unknown {kind} {name!r}; {hint}known: {', '.join(names) if names else 'none'}"
