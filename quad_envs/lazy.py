"""Public names of a package that load at first use, and what `dir` says of a package."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any


def load_public(package: str, public: Mapping[str, str], name: str) -> Any:
    """The object that a package calls by a name, for its `__getattr__`.

    Args:
        package: Its name.
        public: Name -> module of the package that has it.
        name: What was asked for.

    Raises:
        AttributeError: If there is no such name.
    """
    if name not in public:
        raise AttributeError(f"module {package!r} has no attribute {name!r}")
    return getattr(import_module(f".{public[name]}", package), name)


def public_names(package: Mapping[str, Any], *modules: str) -> list[str]:
    """What `dir` of a package lists: `__all__`, loaded or not, and what every module has.

    Args:
        package: Its `globals()`.
        modules: Of it that users name, too.
    """
    every = (name for name in package if name.startswith("__") and name.endswith("__"))
    return sorted({*package["__all__"], *modules, *every})
