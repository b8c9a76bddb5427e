"""The command line that repeats a training."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from typing import Any


def training_command(
    env_id: str,
    algorithm: str,
    seed: int,
    seconds: float | None = None,
    steps: int | None = None,
    out: str = "",
    env_set: Sequence[str] = (),
    hyper: Sequence[str] = (),
    start_from: str = "",
) -> str:
    """`quad-envs train ...`, quoted for a shell.

    Args:
        env_id: Id of the task.
        algorithm: Name of the algorithm.
        seed: Of everything random.
        seconds: Budget in CPU-seconds, if given.
        steps: Budget in environment steps, if given.
        out: Folder, if named.
        env_set: Keyword arguments of the environment as KEY=VALUE.
        hyper: Hyperparameters as KEY=VALUE.
        start_from: Checkpoint whose network it begins with, if any.
    """
    words = ["quad-envs", "train", env_id, algorithm, "--seed", str(seed)]
    words += [] if seconds is None else ["--seconds", f"{seconds:g}"]
    words += [] if steps is None else ["--steps", str(steps)]
    words += ["--out", out] if out else []
    words += [word for text in env_set for word in ("--set", text)]
    words += [word for text in hyper for word in ("--hyper", text)]
    words += ["--from", start_from] if start_from else []
    return shlex.join(words)


def assignments(values: Mapping[str, Any]) -> list[str]:
    """KEY=VALUE texts, as the options of the command line read them; what is no JSON as its repr."""
    return [f"{key}={json.dumps(value, default=repr)}" for key, value in values.items()]
