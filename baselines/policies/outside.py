"""Policies that others wrote: `module:factory`, an entry point, or an object. Whatever has `predict` may fly.

A factory takes what its first parameter is called: `env` the environment, anything else the task; it may also
take nothing. Its other parameters are the options of the policy.
"""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module, metadata
from typing import Any

from quad_envs.arguments.names import suggestion, unknown_name

from ..errors import PolicyError
from .blame import place_of, place_where_defined, told

GROUP = "quad_envs.policies"  # of entry points: an installed package names its policies there
_ENV = ("env", "environment")  # what the first parameter of a factory is called that wants the environment
_NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")


def names_factory(name: Any) -> bool:
    """Whether a name has the form `module:factory`."""
    return isinstance(name, str) and _NAME.fullmatch(name) is not None


@cache
def installed_policies() -> dict[str, str]:
    """Name -> `module:factory`, of the policies that installed packages offer; loads none of them."""
    return {entry.name: entry.value for entry in metadata.entry_points(group=GROUP)}


def is_outside(source: Any) -> bool:
    """Whether a policy is none of this suite: `module:factory`, the name of an entry point, or an object."""
    if not isinstance(source, str):
        return not isinstance(source, os.PathLike)
    return names_factory(source) or source in installed_policies()


def import_named(module: str, what: str) -> Any:
    """A module that a user named.

    Args:
        module: Its name.
        what: For which it was named, for the message.

    Raises:
        PolicyError: If it is not there, or raises when it is imported; the message names the line.
    """
    try:
        return import_module(module)
    except (Exception, SystemExit) as error:
        if (
            isinstance(error, ModuleNotFoundError)
            and error.name
            and f"{module}.".startswith(f"{error.name}.")
        ):
            named = f"; a module is named without .py: {module[:-3]}" if module.endswith(".py") else ""
            raise PolicyError(
                f"{what}: there is no module {error.name!r}, neither in {os.getcwd()!r} nor installed{named}"
            ) from error
        raise PolicyError(f"{what} cannot be imported: {_said(error)}") from error


def find_source(source: Any) -> tuple[Any, str]:
    """What stands behind a name, or the object itself, and how messages call it.

    Raises:
        PolicyError: If there is nothing of this name, or it is neither a policy nor a factory.
    """
    if not isinstance(source, str):
        found, what = source, f"policy {_called(source)!r}"
    else:
        what = f"policy {source!r}"
        module_name, _, path = installed_policies().get(source, source).partition(":")
        found = module = import_named(module_name, what)
        for attribute in path.split("."):
            if not hasattr(found, attribute):
                public = [
                    name
                    for name, value in vars(found).items()
                    if not (name.startswith("_") or inspect.ismodule(value))
                ]
                where = getattr(module, "__file__", None) or module_name
                raise PolicyError(f"{what}: {where} has no {attribute!r}; {suggestion(attribute, public)}")
            found = getattr(found, attribute)
    if not is_policy(found) and not callable(found):
        raise PolicyError(
            f"{what} is {type(found).__name__} {found!r:.60}: a policy has predict, and a factory makes one "
            "from a task"
        )
    return found, what


def named_in_file(name: str) -> str:
    """How policies in a file here are named, where `name` is that of the file; "" where it is not."""
    module = name.removesuffix(".py")
    if not (re.fullmatch(r"\w+", module) and os.path.isfile(f"{module}.py")):
        return ""
    return (
        f"{module}.py is here: what it has is named {module}:NAME, which is a class, a function that makes a "
        "policy, or an object with predict"
    )


def is_policy(found: Any) -> bool:
    """Whether something is a policy as it stands, not a class or a function that makes one."""
    return not inspect.isclass(found) and callable(getattr(found, "predict", None))


def outside_options(source: Any) -> dict[str, Any]:
    """Options of a policy and their defaults: what its factory takes beside the task."""
    found, _ = find_source(source)
    return {} if is_policy(found) else _parameters(found)[1]


def build(source: Any, task: Callable[[], Any], env: Callable[[], Any], options: Mapping[str, Any]) -> Any:
    """The policy of a name, a factory or an object.

    Args:
        source: The name, the factory or the policy.
        task: Gives the task of the environment where it is to fly.
        env: Gives that environment, for a factory which wants it.
        options: Of the policy.

    Raises:
        PolicyError: If it cannot be made, or what is made has no `predict`; the message names the line.
        ValueError: If it has no such option.
    """
    found, what = find_source(source)
    if is_policy(found):
        if options:
            raise ValueError(f"{what} is made already and takes no options, got {', '.join(options)}")
        return found
    first, known, takes_all = _parameters(found)
    for option in options:
        if option not in known and not takes_all:
            raise ValueError(unknown_name(f"option of {what}:", option, known))
    given = () if first is None else ((env if first in _ENV else task)(),)
    try:
        made = found(*given, **options)
    except (Exception, SystemExit) as error:
        raise PolicyError(f"{what} cannot be made: {_said(error, found)}") from error
    if not is_policy(made):
        raise PolicyError(
            f"{what}: the factory returned {type(made).__name__}, which has no predict(observation, state, "
            f"episode_start, deterministic); {place_where_defined(found)}"
        )
    return made


def _parameters(factory: Any) -> tuple[str | None, dict[str, Any], bool]:
    """Name of the first parameter, the others with their defaults, and whether any keyword is taken."""
    try:
        parameters = list(inspect.signature(factory).parameters.values())
    except (TypeError, ValueError):  # compiled ones have no signature
        return "task", {}, True
    positional = [one for one in parameters if one.kind not in (one.KEYWORD_ONLY, one.VAR_KEYWORD)]
    first = positional[0] if positional else None
    known = {
        one.name: one.default
        for one in parameters
        if one is not first and one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD)
    }
    return (
        None if first is None else first.name,
        known,
        any(one.kind == one.VAR_KEYWORD for one in parameters),
    )


def name_of(source: Any) -> str:
    """What an object is, `module:factory` or `module:class` where it has such a name."""
    code = source if hasattr(source, "__qualname__") else type(source)
    return f"{getattr(code, '__module__', '?')}:{code.__qualname__}"


def _called(source: Any) -> str:
    """How an object is called in messages."""
    name = getattr(source, "name", None) or getattr(source, "__name__", None) or type(source).__name__
    return str(name)


def _said(error: BaseException, found: Any = None) -> str:
    """What an error says, and where it arose in the user's code, or where what was called is defined."""
    place = place_of(error) or ("" if found is None else place_where_defined(found))
    return ", at ".join(filter(None, (told(error), place)))
