"""What a training is asked to be: the arguments of `train`, once, and the command line that repeats it."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

from quad_envs.arguments.checks import require_mappings, require_paths, require_words

from .watching import Watcher


@dataclass(frozen=True, slots=True)
class TrainingRequest:
    """The arguments of `train`; the comment of a field is its documentation everywhere."""

    env_id: str  # id of the task
    algorithm: str  # one of `algorithms.ALGORITHMS`
    _: KW_ONLY
    seed: int = 0  # of everything random, 0 to 4 999
    seconds: float | None = (
        None  # budget in CPU-seconds, without compilation and evaluation; the algorithm's own if neither
        # this nor `steps` is given
    )
    steps: int | None = None  # budget in environment steps instead
    out: str | Path | None = None  # folder; `default_folder` if not given
    env_kwargs: Mapping[str, Any] | None = None  # of the environment
    hyper: Mapping[str, Any] | None = None  # hyperparameters that differ from the committed ones
    start_from: str | Path | None = (
        None  # checkpoint, or shipped policy, whose network it begins with: with the features, the hidden
        # layers and the squash of this training
    )
    resume: bool = (
        False  # go on with the run in the folder until the whole budget is used; the weights, the counters,
        # the learning rate's place in its schedule and the curve are restored; the optimiser's averages, a
        # critic, collected data and the random streams begin anew
    )
    fresh: bool = False  # discard the run that is in the folder
    watcher: Watcher | None = None  # hears of the progress

    def __post_init__(self) -> None:
        require_words(env_id=self.env_id, algorithm=self.algorithm)
        require_mappings(env_kwargs=self.env_kwargs, hyper=self.hyper)
        require_paths(out=self.out, start_from=self.start_from)
        if self.resume and self.fresh:
            raise ValueError("either resume or fresh: a run that is discarded cannot go on")

    @property
    def folder(self) -> Path:
        """Where it goes."""
        return default_folder(self.env_id, self.algorithm, self.seed) if self.out is None else Path(self.out)

    @property
    def command(self) -> str:
        """`quad-envs train ...`, quoted for a shell; what is no JSON in it as its repr."""
        words = ["quad-envs", "train", self.env_id, self.algorithm, "--seed", str(self.seed)]
        words += [] if self.seconds is None else ["--seconds", f"{self.seconds:g}"]
        words += [] if self.steps is None else ["--steps", str(self.steps)]
        words += ["--out", str(self.out)] if self.out else []
        for flag, values in (("--set", self.env_kwargs), ("--hyper", self.hyper)):
            for key, value in (values or {}).items():
                words += [flag, f"{key}={json.dumps(value, default=repr)}"]
        words += ["--from", str(self.start_from)] if self.start_from else []
        words += ["--resume"] if self.resume else []
        return shlex.join(words)


def default_folder(env_id: str, algorithm: str, seed: int) -> Path:
    """Where a training goes if no folder is named."""
    task = env_id.rsplit("/", 1)[-1].removesuffix("-v0")
    return Path("runs") / f"{algorithm}-{task}-{seed}"
