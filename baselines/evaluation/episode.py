"""One flight as arrays, and how it is collected step by step."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_envs.constraints import forces_from_actions
from quad_envs.parameters import Array
from quad_envs.tasks import BaseTask, TeamTask

from ..errors import MissingPackageError
from ..policies.protocol import N_FALLBACKS, Actions, Counts, PolicyState
from .episode_columns import as_csv, episode_columns
from .team_signals import TEAM_INFO, WRAPPER_INFO, estimate_signals

SCORES = ("stage_cost", "cost", "constraint_violation")
INFO = (
    *SCORES,
    "constraint_values",
    "crashed",
    "crash_cause",
)  # keys that every environment of the suite tells
_N_ROTORS = 4


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


class Said(NamedTuple):
    """What the environment said of a step, for all vehicles."""

    rewards: NDArray[Any]  # (n,)
    terminated: NDArray[Any]
    truncated: NDArray[Any]
    info: Mapping[str, NDArray[Any]]  # the keys INFO, and those of TEAM_INFO that it has, vehicles first


class Recorder:
    """What n vehicles do in one round, collected step by step as arrays over the vehicles.

    Args:
        task: As flown.
        seeds: Of each vehicle's episode.
        references: (n, at least T+1, 8).
        plants: Of the start, (n, 16).
        agents: Names, in a multi-agent environment.
        targets: Rows r, v of what each vehicle follows or estimates, (n, T+1, 6); None without a target.
        team_size: Vehicles of a team.
    """

    def __init__(
        self,
        task: BaseTask,
        seeds: Sequence[int],
        references: Array,
        plants: Array,
        *,
        agents: Sequence[str] = (),
        targets: Array | None = None,
        team_size: int = 1,
    ) -> None:
        self.task, self.seeds, self.references, self.targets = task, seeds, references, targets
        n = len(seeds)
        self.agents, self.team_size = agents or [""] * n, team_size
        self.live = np.ones(n, dtype=np.bool_)
        self.lengths = np.zeros(n, dtype=np.int64)
        self.ends = np.zeros((3, n), dtype=np.bool_)  # crashed, terminated, truncated
        self.causes = np.zeros(n, dtype=np.int64)  # places in `task.crash_causes`
        self.fallbacks, self.worst = np.zeros((n, N_FALLBACKS), dtype=np.int64), np.zeros(n, dtype=np.int64)
        self.left = np.zeros(n, dtype=np.int64)
        self.steps: list[tuple[NDArray[Any], Array, NDArray[Any]]] = []
        self.seconds: list[float] = []
        self.plants: list[Array] = [plants]
        self.signals: dict[str, list[NDArray[Any]]] = {}

    def add(
        self,
        observations: NDArray[Any],
        state: Any,
        actions: Actions,
        said: Said,
        seconds: float,
        plants: Array,
    ) -> None:
        """One step of all vehicles; of those that are done, nothing is kept.

        Args:
            observations: Those from which the policy decided, (n, d).
            state: What the policy returned with the actions.
            actions: (n, action size).
            said: By the environment, of the step.
            seconds: Wall time of the decision per vehicle.
            plants: After the step, (n, 16).
        """
        live, info = self.live.copy(), said.info
        scores = np.stack([said.rewards, *(info[key] for key in SCORES)], axis=1).astype(np.float64)
        self.steps.append((np.array(actions), scores, info["constraint_values"]))
        self.seconds.append(seconds)
        told = {key: info[key] for key in TEAM_INFO if key in info}
        if self.targets is not None and isinstance(self.task, TeamTask):
            truth = self.targets[:, len(self.steps) - 1]
            told |= estimate_signals(self.task, state, observations, actions, self.plants[-1], truth)
            if "nis" in info and "nis" in told and np.isnan(told["nis"]).all():
                told |= {key: info[key] for key in WRAPPER_INFO}
        for name, values in told.items():
            self.signals.setdefault(name, []).append(np.array(values))
        self.plants.append(plants)
        self.lengths[live] += 1
        self.ends[:, live] = np.stack([info["crashed"], said.terminated, said.truncated])[:, live]
        self.causes[live] = np.asarray(info["crash_cause"])[live]
        if isinstance(state, PolicyState):  # a policy that decides for the whole team has a single row
            n = len(live)
            self.fallbacks[live] = np.broadcast_to(state.fallbacks, (n, N_FALLBACKS))[live]
            self.worst[live] = np.broadcast_to(state.worst_iterations, (n,))[live]
            if state.left_model is not None:
                self.left[live] = np.broadcast_to(state.left_model, (n,))[live]
        self.live &= ~(self.ends[1] | self.ends[2])

    def episodes(self) -> Iterator[Episode]:
        """The flights as arrays."""
        actions, scores, values = (np.stack([step[i] for step in self.steps]) for i in range(3))
        seconds, plants = np.array(self.seconds), np.stack(self.plants)
        signals = {name: np.stack(steps) for name, steps in self.signals.items()}
        for j, steps in enumerate(self.lengths.tolist()):
            flown = scores[:steps, j].copy()
            yield Episode(
                task=self.task,
                seed=self.seeds[j],
                states=plants[: steps + 1, j].copy(),
                references=self.references[j, : steps + 1].copy(),
                commands=self._commands(actions[:steps, j]),
                rewards=flown[:, 0],
                stage_costs=flown[:, 1],
                costs=flown[:, 2],
                violations=flown[:, 3] > 0.0,
                constraint_values=values[:steps, j].copy(),
                decision_times=seconds[:steps].copy(),
                fallbacks=self.fallbacks[j].copy(),
                worst_iterations=int(self.worst[j]),
                crashed=bool(self.ends[0, j]),
                terminated=bool(self.ends[1, j]),
                truncated=bool(self.ends[2, j]),
                agent=self.agents[j],
                crash_cause=self.task.crash_causes[self.causes[j]],
                left_model=int(self.left[j]),
                team_size=self.team_size,
                signals={name: entries[:steps, j].copy() for name, entries in signals.items()},
            )

    def _commands(self, actions: NDArray[Any]) -> Array:
        """Rotor forces of actions, (T, 4); an estimate as an action commands none."""
        task = self.task
        if isinstance(task, TeamTask) and task.mission == "estimation":
            return np.full((len(actions), _N_ROTORS), np.nan)
        return forces_from_actions(actions[:, :_N_ROTORS], task.hover_force, task.force_max)
