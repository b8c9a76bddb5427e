"""Whether a policy and an environment belong together: one task, and no wrapper that changes the numbers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any, NamedTuple

import gymnasium

from quad_envs.arguments.names import shown
from quad_envs.tasks import BaseTask
from quad_envs.wrappers.vector import FilterAndRescale

from .disturbance_wrappers import DisturbanceEstimateWrapper, VectorDisturbanceEstimateWrapper
from .environments import find_task

_REWRITERS = (
    gymnasium.ObservationWrapper,
    gymnasium.ActionWrapper,
    gymnasium.vector.VectorObservationWrapper,
    gymnasium.vector.VectorActionWrapper,
    FilterAndRescale,
    DisturbanceEstimateWrapper,
    VectorDisturbanceEstimateWrapper,
)
_HARMLESS = (
    gymnasium.wrappers.FlattenObservation,
    gymnasium.wrappers.ClipAction,
)  # same numbers for a flat Box


# Fields of a task that no decision depends on: its name, how long it lasts, how it is judged.
JUDGED_ONLY = ("env_id", "episode_steps", "reward", "crash_distance", "formation_weight", "spanning_tree")
_OF_STATE = ("layout.preview", "layout.target")  # what of a layout shapes `env.state()`
_SHOWN = 3  # differences that a message names


class Difference(NamedTuple):
    """A field in which two tasks differ."""

    field: str  # path, as "params.mass"
    own: Any
    flown: Any


def require_pair(policy: Any, env: Any, mismatch: bool = False) -> None:
    """Check that a policy of a task is in an environment of that task, and gets its numbers as they are.

    What a policy without a `task` wants, only its owner knows. A policy with `decides_from`, names of parts
    of the task, depends on these alone: a network on "layout" and "limits.kappa".

    Args:
        policy: Anything with `predict`.
        env: Of this suite, wrapped or not, or its task.
        mismatch: Whether the tasks may differ on purpose. Observations have to have the same layout.

    Raises:
        ValueError: If the tasks differ, with both values of the first fields that do; or if a wrapper changes
            the numbers, with its name.
    """
    own, flown = getattr(policy, "task", None), env if isinstance(env, BaseTask) else find_task(env)
    if not isinstance(own, BaseTask):
        return
    _require_own_numbers(policy, env)
    found = [
        difference
        for difference in task_differences(own, flown)
        if _matters(policy, difference.field, mismatch)
    ]
    if found:
        raise ValueError(_said(policy, flown, found))


def task_differences(own: BaseTask, flown: Any) -> list[Difference]:
    """In what two tasks differ that decisions may depend on."""
    if type(own) is not type(flown):
        return [Difference("", type(own).__name__, type(flown).__name__)]
    return [found for found in _differences(own, flown, "") if found.field not in JUDGED_ONLY]


def _differences(own: Any, flown: Any, path: str) -> Iterator[Difference]:
    for entry in fields(own):
        name = "kappas" if entry.name == "kappa" else entry.name  # one number, or the same for each rotor
        a, b = getattr(own, name), getattr(flown, name)
        if is_dataclass(a) and type(a) is type(b):
            yield from _differences(a, b, f"{path}{entry.name}.")
        elif a != b:
            yield Difference(f"{path}{entry.name}", getattr(own, entry.name), getattr(flown, entry.name))


def _matters(policy: Any, field: str, mismatch: bool) -> bool:
    """Whether a policy's decisions may depend on a field; with a mismatch on purpose those of the layout."""
    if getattr(policy, "privileged", False) and field.startswith("layout."):
        return field in _OF_STATE
    parts = ("layout",) if mismatch else getattr(policy, "decides_from", None)
    return parts is None or not field or any(field == part or field.startswith(f"{part}.") for part in parts)


def _said(policy: Any, flown: Any, found: list[Difference]) -> str:
    """The message: both values of the first fields that differ, and the remedy."""
    name, where = getattr(policy, "name", type(policy).__name__), getattr(flown, "env_id", "this environment")
    values = [
        f"task{'.' * bool(field)}{field} is {shown(a)} for the policy and {shown(b)} in the environment"
        for field, a, b in found[:_SHOWN]
    ]
    more = f" (and {len(found) - _SHOWN} more differ)" if len(found) > _SHOWN else ""
    return (
        f"policy {name!r} was made for another task than that of this {where}: {'; '.join(values)}{more}. "
        f"Make it for this one, make_policy({name!r}, env), or say mismatch=True to fly it as it is, "
        "for which the layout of observations has to be the same"
    )


def _require_own_numbers(policy: Any, env: Any) -> None:
    """Check that no wrapper between a policy of a task and its environment changes the numbers.

    One that normalises, delays or rescales would feed the policy other numbers in the same shape.

    Raises:
        ValueError: If a wrapper stands between them; it names the wrapper and the remedy.
    """
    inner = env
    while isinstance(inner, gymnasium.Wrapper | gymnasium.vector.VectorWrapper):
        if isinstance(inner, _REWRITERS) and not isinstance(inner, _HARMLESS):
            name = getattr(policy, "name", type(policy).__name__)
            raise ValueError(
                f"the wrapper {type(inner).__name__} changes observations or actions, and policy {name!r} "
                "reads and writes those of its task: evaluate it in env.unwrapped, or without the wrapper"
            )
        inner = inner.env
