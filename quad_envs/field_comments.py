"""What the fields of a dataclass mean, read from the comments beside them: written once, shown everywhere."""

from __future__ import annotations

import ast
import inspect
import io
import textwrap
import tokenize
from dataclasses import fields
from typing import Any


def field_comments(kind: type[Any]) -> dict[str, str]:
    """The comment behind each field of a dataclass, or on its further lines, inherited ones included.

    Args:
        kind: A dataclass.

    Returns:
        Text of each field in their order; empty where there is none, or where the source is not at hand.
    """
    found: dict[str, str] = {}
    for parent in reversed(kind.__mro__[:-1]):
        found |= _own_comments(parent)
    return {entry.name: found.get(entry.name, "") for entry in fields(kind)}


def _own_comments(kind: type[Any]) -> dict[str, str]:
    """Comments of the fields that a class itself annotates."""
    try:
        source = textwrap.dedent(inspect.getsource(kind))
    except (OSError, TypeError):
        return {}
    (tree,) = ast.parse(source).body
    assert isinstance(tree, ast.ClassDef)
    behind = {
        token.start[0]: token.string.lstrip("# ")
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    return {
        node.target.id: " ".join(
            behind[n] for n in range(node.lineno, (node.end_lineno or node.lineno) + 1) if n in behind
        )
        for node in tree.body
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    }
