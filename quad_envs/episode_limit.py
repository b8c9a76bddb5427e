"""How long an episode lasts: between Gymnasium's `max_episode_steps` and the environment's own limit.

The environments end their episodes themselves, which costs nothing, and need to know when, since references,
disturbances and noise are tables of that length. `gymnasium.make` keeps its `max_episode_steps` from the
environment and puts a `TimeLimit` around it, which can only shorten. So two things look at the caller:

- an environment that is being made asks for the number that its maker was given;
- a specification of the suite tells its number to everybody but Gymnasium's makers, which would put a second
  counter around the environment, with the registered number whatever `time_limit` says.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from typing import Any

from gymnasium.envs.registration import EnvSpec

_MODULE = EnvSpec.__module__
_MAKERS = ("make", "make_vec")


def _is_maker(frame: Any, names: tuple[str, ...]) -> bool:
    return frame.f_globals.get("__name__") == _MODULE and frame.f_code.co_name in names


def steps_asked() -> int | None:
    """`max_episode_steps` of the `gymnasium.make` that makes the calling environment, if it has one."""
    frame: Any = sys._getframe(1)
    while frame is not None and frame.f_code.co_name == "__init__":
        frame = frame.f_back
    if frame is None or not _is_maker(frame, ("make",)):
        return None
    given, spec = frame.f_locals.get("max_episode_steps"), frame.f_locals.get("env_spec")
    if given is None and type(spec) is EnvSpec:  # of an id of somebody else, or read from JSON
        given = spec.max_episode_steps
    return None if given == -1 else given  # by Gymnasium's convention no limit


class SuiteSpec(EnvSpec):
    """A specification of environments that end their episodes themselves; it says what JSON cannot hold."""

    @property
    def max_episode_steps(self) -> int | None:
        """Steps until truncation; None for Gymnasium's makers alone."""
        return None if _is_maker(sys._getframe(1), _MAKERS) else self._steps

    @max_episode_steps.setter
    def max_episode_steps(self, steps: int | None) -> None:
        self._steps = steps

    def to_json(self) -> str:
        """The specification as text, from which `EnvSpec.from_json` makes one again.

        Raises:
            ValueError: If an argument cannot be written, as a function.
        """
        for name, value in self.kwargs.items():
            bad = _unwritable(value)
            if bad is not None:
                raise ValueError(
                    f"{self.id}: {name} holds {bad}, which JSON cannot: give a name, a mapping with 'kind', "
                    "an array or the path of a table instead"
                )
        return super().to_json()


def _unwritable(value: Any) -> str | None:
    """What of a value cannot be written as JSON; None if all can."""
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, list | tuple):
        return next((bad for bad in map(_unwritable, value) if bad is not None), None)
    try:
        json.dumps(value)
    except (TypeError, ValueError):
        kind = type(value).__name__
        return f"a function, {getattr(value, '__name__', kind)}" if callable(value) else f"a {kind}"
    return None
