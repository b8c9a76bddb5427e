"""The fields of a dataclass, written once: what they mean, and as the arguments of a function."""

from __future__ import annotations

import ast
import inspect
import io
import textwrap
import tokenize
from collections.abc import Callable
from dataclasses import fields
from functools import wraps
from typing import Any, ParamSpec, TypeVar

Fields = ParamSpec("Fields")
Value = TypeVar("Value")
Returned = TypeVar("Returned")


def field_comments(kind: type[Any]) -> dict[str, str]:
    """The comment behind each field of a dataclass, or on its further lines, inherited ones included.

    A field that is declared again without one, for another default, keeps the comment that it inherits.

    Args:
        kind: A dataclass.

    Returns:
        Text of each field in their order; empty where there is none, or where the source is not at hand.
    """
    found: dict[str, str] = {}
    for parent in reversed(kind.__mro__[:-1]):
        found |= {name: comment for name, comment in _own_comments(parent).items() if comment}
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


def called_with(
    kind: Callable[Fields, Value],
) -> Callable[[Callable[[Value], Returned]], Callable[Fields, Returned]]:
    """Make of a function of one value a function of the value's fields, to which its docstring adds them.

    Args:
        kind: The dataclass of the value.
    """

    def of_fields(function: Callable[[Value], Returned]) -> Callable[Fields, Returned]:
        @wraps(function)
        def call(*args: Fields.args, **kwargs: Fields.kwargs) -> Returned:
            return function(kind(*args, **kwargs))

        del call.__wrapped__
        signature = inspect.signature(kind)
        call.__signature__ = signature.replace(  # type: ignore[attr-defined]
            return_annotation=function.__annotations__["return"]
        )
        comments = field_comments(kind)  # type: ignore[arg-type]
        lines = [f"    {name}: {comments[name]}" for name in signature.parameters]
        call.__doc__ = "\n".join([inspect.getdoc(function) or "", "", "Args:", *lines])
        return call

    return of_fields
