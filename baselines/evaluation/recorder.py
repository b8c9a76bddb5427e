"""Flights as they are flown, collected step by step: every row is in an episode of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_envs.constraints import forces_from_actions
from quad_envs.parameters import N_INPUT, Array
from quad_envs.tasks import BaseTask, TeamTask

from ..policies.protocol import N_FALLBACKS, Interventions, PolicyState
from .episode import Episode
from .team_signals import TEAM_INFO, WRAPPER_INFO, estimate_signals

SCORES = ("stage_cost", "cost", "constraint_violation")
INFO = (
    *SCORES,
    "constraint_values",
    "crashed",
    "crash_cause",
)  # keys that every environment of the suite tells
_SCORED = ("rewards", *SCORES, "seconds")  # columns of what is stored as one array
_BEHIND = 2  # places behind the last step of an episode: the plant at its end, and what rows that wait say


class Said(NamedTuple):
    """What the environment said of a step, for all vehicles."""

    rewards: NDArray[Any]  # (n,)
    terminated: NDArray[Any]
    truncated: NDArray[Any]
    info: Mapping[str, NDArray[Any]]  # the keys INFO, and those of TEAM_INFO that it has, vehicles first


class Begun(NamedTuple):
    """What is known of episodes when they begin, of all n vehicles."""

    references: NDArray[Any]  # (n, at least T+1, 8)
    plants: Array  # (n, 16)
    targets: Array | None = None  # rows r, v of what each vehicle follows or estimates, (n, T+1, 6)


class Recorder:
    """What n vehicles do, each in an episode and at a step of its own.

    It holds the present episode of each row, and no other.

    Args:
        task: As flown.
        n: Vehicles.
        agents: Their names, in a multi-agent environment.
        team_size: Vehicles of a team, which are consecutive rows.
    """

    def __init__(self, task: BaseTask, n: int, *, agents: Sequence[str] = (), team_size: int = 1) -> None:
        self.task, self.team_size, self.agents = task, team_size, list(agents) or [""] * n
        self.seeds = [0] * n
        self.live = np.zeros(n, dtype=np.bool_)
        self.steps = np.zeros(n, dtype=np.int64)  # flown of the present episodes
        self._rows = np.arange(n)
        self._room, self._longest = task.episode_steps + _BEHIND, 0
        self._kept: dict[str, NDArray[Any]] = {}  # name -> (room, n, ...), what is said of each step
        self._references: list[NDArray[Any]] = [np.zeros((0, 0))] * n
        self._targets: Array | None = None
        self._ends = np.zeros((3, n), dtype=np.bool_)  # crashed, terminated, truncated
        self._causes = np.zeros(n, dtype=np.int64)  # places in `task.crash_causes`
        self._fallbacks = np.zeros((n, N_FALLBACKS), dtype=np.int64)
        self._worst, self._left = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
        self._interventions: Interventions | None = None
        self._signals: tuple[str, ...] = ()

    def begin(self, rows: Sequence[int], seeds: Sequence[int], begun: Begun) -> None:
        """Episodes begin in some rows; what these flew before is forgotten.

        Args:
            rows: Their places.
            seeds: Of each of them.
            begun: What is known of them.
        """
        which = np.asarray(rows)
        for j, seed in zip(which.tolist(), seeds, strict=True):
            self.seeds[j], self._references[j] = seed, begun.references[j]
        self.live[which], self.steps[which], self._longest = True, 0, int(self.steps.max())
        self._ends[:, which], self._causes[which] = False, 0
        self._fallbacks[which], self._worst[which], self._left[which] = 0, 0, 0
        if begun.targets is not None:
            if self._targets is None:
                self._targets = np.zeros_like(begun.targets)
            self._targets[which] = begun.targets[which]
        self._room_for("plants", begun.plants)[0, which] = begun.plants[which]

    def add(
        self,
        observations: NDArray[Any],
        state: Any,
        actions: NDArray[Any],
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
        live, info = self.live, said.info
        self._longest += 1
        if self._longest + _BEHIND > self._room:
            self._grow()
        now, then = self._place(0), self._place(1)
        signals = self._signals_of(observations, state, actions, info)
        self._signals = tuple(signals)
        scores = np.empty(
            (len(live), len(_SCORED))
        )  # one array, since each takes as long to store as another
        scores.T[:] = (said.rewards, *(info[key] for key in SCORES), np.broadcast_to(seconds, live.shape))
        told = {
            "scores": scores,
            "constraint_values": info["constraint_values"],
            "actions": actions,
        } | signals
        for name, values in told.items():
            self._room_for(name, values)[now] = values
        self._room_for("plants", plants)[then] = plants
        for end, values in zip(self._ends, (info["crashed"], said.terminated, said.truncated), strict=True):
            np.copyto(end, values, where=live)
        np.copyto(self._causes, info["crash_cause"], where=live)
        if isinstance(state, PolicyState):  # a policy that decides for the whole team has a single row
            np.copyto(self._fallbacks, state.fallbacks, where=live[:, None])
            np.copyto(self._worst, state.worst_iterations, where=live)
            if state.left_model is not None:
                np.copyto(self._left, state.left_model, where=live)
            if state.interventions is not None:
                if self._interventions is None:
                    self._interventions = Interventions._make(map(np.zeros_like, state.interventions))
                for kept, found in zip(self._interventions, state.interventions, strict=True):
                    np.copyto(kept, found, where=live)
        self.steps += live
        live &= ~(self._ends[1] | self._ends[2])

    def _signals_of(
        self, observations: NDArray[Any], state: Any, actions: NDArray[Any], info: Mapping[str, NDArray[Any]]
    ) -> dict[str, NDArray[Any]]:
        """What only some environments and policies tell, see `team_signals`."""
        told = {key: info[key] for key in TEAM_INFO if key in info}
        if self._targets is not None and isinstance(self.task, TeamTask):
            at = np.minimum(self.steps, self._targets.shape[1] - 1)
            truth, plants = self._targets[self._rows, at], self._kept["plants"][self._place(0)]
            told |= estimate_signals(self.task, state, observations, actions, plants, truth)
            if "nis" in info and "nis" in told and np.isnan(told["nis"]).all():
                told |= {key: info[key] for key in WRAPPER_INFO}
        return told

    def _place(self, later: int) -> Any:
        """Where what is said of every row belongs; one slice, which is quick, where all are at one step."""
        first = self.steps[0] + later
        return first if (self.steps == self.steps[0]).all() else (self.steps + later, self._rows)

    def _room_for(self, name: str, values: NDArray[Any]) -> NDArray[Any]:
        """Where values of a name are kept, (room, n, ...), in a type that holds them and those before."""
        kept = self._kept.get(name)
        if kept is None:
            kept = self._kept[name] = np.zeros((self._room, *values.shape), values.dtype)
        elif kept.dtype != values.dtype and not np.can_cast(values.dtype, kept.dtype):
            kept = self._kept[name] = kept.astype(np.result_type(kept, values))
        return kept

    def _grow(self) -> None:
        """Make room for an episode that is longer than its task says."""
        self._room *= 2
        for name, kept in self._kept.items():
            self._kept[name] = np.concatenate([kept, np.zeros_like(kept)])

    def episodes(self, rows: Sequence[int]) -> list[Episode]:
        """The flights of some rows as arrays of their own."""
        return [self._episode(j) for j in rows]

    def _episode(self, j: int) -> Episode:
        steps, kept = int(self.steps[j]), self._kept

        scores = dict(zip(_SCORED, kept["scores"][:steps, j].T.copy(), strict=True))

        return Episode(
            task=self.task,
            seed=self.seeds[j],
            states=kept["plants"][: steps + 1, j].copy(),
            references=self._references[j][: steps + 1].copy(),
            commands=self._commands(kept["actions"][:steps, j]),
            rewards=scores["rewards"],
            stage_costs=scores["stage_cost"],
            costs=scores["cost"],
            violations=scores["constraint_violation"] > 0.0,
            constraint_values=kept["constraint_values"][:steps, j].astype(np.float64),
            decision_times=scores["seconds"],
            fallbacks=self._fallbacks[j].copy(),
            worst_iterations=int(self._worst[j]),
            crashed=bool(self._ends[0, j]),
            terminated=bool(self._ends[1, j]),
            truncated=bool(self._ends[2, j]),
            agent=self.agents[j],
            crash_cause=self.task.crash_causes[self._causes[j]],
            left_model=int(self._left[j]),
            team_size=self.team_size,
            signals={name: kept[name][:steps, j].copy() for name in self._signals},
            target=None if self._targets is None else self._targets[j].copy(),
            interventions=self._interventions
            and Interventions._make(part[j : j + 1].copy() for part in self._interventions),
        )

    def _commands(self, actions: NDArray[Any]) -> Array:
        """Rotor forces of actions, (T, 4); an estimate as an action commands none."""
        task = self.task
        if isinstance(task, TeamTask) and task.mission == "estimation":
            return np.full((len(actions), N_INPUT), np.nan)
        return forces_from_actions(actions[:, :N_INPUT], task.hover_force, task.force_max)
