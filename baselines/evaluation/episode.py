"""One flight as arrays."""

from __future__ import annotations

import os
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_envs.parameters import Array
from quad_envs.tasks import BaseTask

from ..errors import MissingPackageError
from ..policies.protocol import Counts, Interventions
from .episode_columns import as_csv, episode_columns


class Episode(NamedTuple):
    """One flight of T control periods. Row k of what is per step belongs to the step from k to k + 1.

    `signals` has what only some environments and policies tell, first axis T, see `team_signals.py`.
    """

    task: BaseTask  # as flown: with the time limit that Gymnasium set, where that one is shorter
    seed: int
    states: Array  # (T+1, 16), true plant [p, V_B, Theta, Omega, F]
    references: Array  # (T+1, 8), p_ref, v_ref, sin psi_ref, cos psi_ref
    commands: Array  # (T, 4), commanded rotor forces, N; nan where an action is none
    rewards: Array  # (T,)
    stage_costs: Array  # (T,), l of the reward: state at k + 1, command at k
    costs: Array  # (T,), sum of hinge / scale over the limits
    violations: NDArray[np.bool_]  # (T,), whether any limit was exceeded
    constraint_values: Array  # (T, number of rows), value minus limit, SI
    decision_times: Array  # (T,), s of wall time in predict per vehicle; nan where it was not measured
    fallbacks: Counts  # (5,), decisions by controllers.fallback.Fallback
    worst_iterations: int  # most solver iterations of a decision
    crashed: bool
    terminated: bool
    truncated: bool
    agent: str = ""  # in a multi-agent environment
    crash_cause: str = (
        ""  # one of `task.crash_causes`; empty too where another vehicle ended the team's flight
    )
    left_model: int = 0  # decisions whose state or plan left where the policy's model holds
    team_size: int = 1  # vehicles that were decided for at once: the team took team_size * decision_times
    signals: Mapping[str, NDArray[Any]] = {}
    target: Array | None = None  # rows r, v of the team's target in all of the episode, (steps, 6)
    interventions: Interventions | None = None  # of a safety filter, (1,) each

    def columns(self) -> dict[str, Array]:
        """Name -> (T+1,), the flight as a table: a row is a control period; see `episode_columns`."""
        return episode_columns(self)

    def to_csv(self, path: str | os.PathLike[str] | None = None) -> str:
        """The columns as text, written to a file if there is a path; what is not a number stays empty."""
        text = as_csv(self.columns())
        if path is not None:
            Path(path).write_text(text, encoding="utf-8")
        return text

    def to_frame(self) -> Any:
        """The columns as a pandas `DataFrame`.

        Raises:
            MissingPackageError: If pandas, which this suite does not need otherwise, is not installed.
        """
        try:
            pandas = import_module("pandas")
        except ImportError as error:
            raise MissingPackageError(
                f"to_frame needs pandas ({error}): pip install pandas; columns() gives the same without"
            ) from error
        return pandas.DataFrame(self.columns())
