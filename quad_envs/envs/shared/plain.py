"""Arguments of an environment in the plain form that a specification keeps: names, numbers, mappings."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import fields
from enum import Enum
from typing import Any

import numpy as np
from gymnasium import registry
from gymnasium.envs.registration import EnvSpec

from ...arguments.kinds import mapping_of
from ...disturbances import DISTURBANCES
from ...episode_limit import SuiteSpec
from ...graphs import KINDS as SCHEDULES
from ...graphs import edges_of, is_networkx
from ...references import REFERENCES, is_frame
from ...targets import TARGETS

_KINDS = {**REFERENCES, **TARGETS, **DISTURBANCES, **SCHEDULES}


def plain(value: Any) -> Any:
    """The value as text, numbers, lists and mappings; what has no such form, as a function, stays."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Mapping):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return list(map(plain, value))
    if is_networkx(value):
        return plain(edges_of(value))
    if is_frame(value):
        return {str(name): np.asarray(value[name]).tolist() for name in value.columns}
    mapping = mapping_of(value, _KINDS, plain)
    return value if mapping is None else mapping


def plain_spec(spec: EnvSpec, steps: int, asked: int | None) -> SuiteSpec:
    """A specification with plain arguments that says how long its episodes are.

    Args:
        spec: As Gymnasium made it.
        steps: Control periods of an episode.
        asked: `max_episode_steps`, if that was given.
    """
    values = {one.name: getattr(spec, one.name) for one in fields(spec) if one.init}
    out = SuiteSpec(**values)
    out.kwargs = {name: plain(value) for name, value in spec.kwargs.items()}
    if asked is not None:
        out.kwargs["max_episode_steps"] = asked
    out.max_episode_steps = steps
    known = registry.get(spec.id)
    if isinstance(known, SuiteSpec) and known.reward_threshold and known.max_episode_steps:
        out.reward_threshold = known.reward_threshold * steps / known.max_episode_steps
    if spec.kwargs.get("reward") == "quadratic":  # which is negative
        out.reward_threshold = None
    return out
