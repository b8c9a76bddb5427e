"""What the multi-agent environments share: one team behind PettingZoo's parallel API."""

from __future__ import annotations

from operator import attrgetter, itemgetter
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from gymnasium import logger, spaces
from gymnasium.utils import seeding
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from ...arguments.names import shown
from ...graphs import GraphTable
from ...lanes import N_PLANT, PLANT
from ...plant import Array
from ...tasks import TeamTask
from ..shared.actions import FLOAT32, real_numbers
from ..shared.render_modes import NO_RENDERING, checked_rendering
from .batch import TeamBatch
from .options import TeamOptions
from .told import Parts

if TYPE_CHECKING:
    from ..pictures import TeamPictures

Observation = NDArray[np.float32]
Named = dict[str, Any]

# PettingZoo asks for finite bounds; no state of a flight within the arena comes near.
_BOUND = 1e6
_FIRST = np.zeros(1, dtype=np.int64)  # the batch's only team
_ndim, _dtype = attrgetter("ndim"), attrgetter("dtype")
_METADATA: dict[str, Any] = {
    "render_modes": ["human", "rgb_array"],
    "render_fps": 20,
    "name": "team",
    "is_parallelizable": True,
}


class TeamEnv(ParallelEnv[str, Observation, NDArray[np.float32]]):  # type: ignore[misc]
    """One team of a `TeamBatch`. The subclasses document their task."""

    options_type: ClassVar[type[TeamOptions]] = TeamOptions
    metadata: ClassVar[dict[str, Any]] = _METADATA

    def __init__(
        self, render_mode: str | None = None, render_size: tuple[int, int] = (640, 480), **kwargs: Any
    ) -> None:
        picture_size = checked_rendering(render_mode, ("human", "rgb_array"), render_size)
        # PettingZoo's wrappers write into it: every environment has its own.
        self.metadata = {**_METADATA, "name": self.options_type.mission}  # type: ignore[misc]
        self.render_mode = render_mode
        options = self.options_type.from_kwargs(kwargs)
        self._batch = TeamBatch(options, 1)
        self._pictures: TeamPictures | None = None
        if render_mode:
            from ..pictures import TeamPictures  # not needed by who trains and measures

            self._pictures = TeamPictures(self._batch, picture_size, render_mode)
        self.possible_agents = [f"quad_{i}" for i in range(options.vehicles)]
        self.max_cycles = self.task.episode_steps
        self.np_random: np.random.Generator | None = None
        self._action_size = self.task.action_size
        size = self.task.layout.size
        self._shape = (options.vehicles, size)
        self.observation_spaces = {
            name: spaces.Box(-_BOUND, _BOUND, (size,), np.float32) for name in self.possible_agents
        }
        self.action_spaces = {
            name: spaces.Box(-1.0, 1.0, (self._action_size,), np.float32) for name in self.possible_agents
        }
        state_size = sum(part.stop - part.start for part in self.state_slices.values())
        self.state_space = spaces.Box(-_BOUND, _BOUND, (state_size,), np.float64)
        self._let_fly(np.arange(0))

    def observation_space(self, agent: str) -> spaces.Box:
        """Of one agent; always the same object."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Box:
        """Of one agent; always the same object."""
        return self.action_spaces[agent]

    @property
    def options(self) -> TeamOptions:
        """The arguments of the environment as a value."""
        return self._batch.options

    @property
    def task(self) -> TeamTask:
        """What is known of the task before the flight: from this, policies are built."""
        return self._batch.task

    @property
    def plants(self) -> Array:
        """Copy of the plants [p, V_B, Theta, Omega, F], (N, 16), for study; policies never see it."""
        return self._batch.vehicles.read(PLANT, N_PLANT)

    @property
    def references(self) -> Array:
        """Where each vehicle should be in this episode, (N, T+1, 8), rows as in a reference. For study."""
        return self._batch.wanted(0)

    @property
    def target(self) -> Array:
        """Rows r, v of the target in this episode, (T+1, 6); zero where there is none. For study."""
        return self._batch.target(0).copy()

    @property
    def graphs(self) -> GraphTable:
        """Communication graphs of this episode, and which of them holds at each step. For study."""
        graphs, which = self._batch.graphs
        return GraphTable(graphs.copy(), which.copy())

    @property
    def senders(self) -> NDArray[np.int64]:
        """Vehicle behind each comm slot, -1 for none, (N, K)."""
        return self._batch.neighbours.copy()

    @property
    def state_slices(self) -> dict[str, slice]:
        """Name -> slice of `state()`: plants, target, graph, preview, time."""
        return self.task.state_slices

    def state(self) -> Array:
        """The whole truth for centralised critics, parts as in `state_slices`, absolute, float64.

        Plants (N, 16) row by row; the target's r, v (zero without one); the present weights G (N, N), with
        rows and columns of zeros, G_ii included, for vehicles that crashed; the leader's reference rows
        k..k+N_p (zero without a leader); t / T.
        """
        return np.asarray(self._batch.state()[0])

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, Named]]:
        """Begin an episode; `options={"state": x}` with (N, 12) or (N, 16) numbers sets the plants."""
        if seed is not None or self.np_random is None:
            self.np_random, _ = seeding.np_random(seed)
        observations, told = self._fresh_observations(), self._batch.fresh_scores()
        self._batch.begin(_FIRST, [self.np_random], observations.reshape(-1), told, options)
        if self._pictures:
            self._pictures.record()
        self._let_fly(np.arange(len(self.possible_agents)))
        *_, infos = self._tell(self.agents, self._batch.parts(told), False)
        return dict(zip(self.agents, observations, strict=True)), infos

    def step(
        self, actions: dict[str, NDArray[np.float32]]
    ) -> tuple[dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, Named]]:
        """Hold the rotor commands of all agents over one control period.

        After the end of an episode `step({})` answers with nothing, as PettingZoo's environments do.
        """
        agents = self.agents
        if not agents and actions == {} and self.np_random is not None:
            return {}, {}, {}, {}, {}
        observations, told = self._fresh_observations(), self._batch.fresh_scores()
        stacked = self._stack(actions)
        self._batch.step(stacked.reshape(-1), observations.reshape(-1), told)
        if self._pictures:
            self._pictures.record(stacked)
        parts, which = self._batch.parts(told), self._rows
        if len(which) < len(self.possible_agents):
            observations = observations[which]
            numbers, counts, flags, values, terms = parts
            parts = Parts(numbers[:, which], counts[:, which], flags[:, which], values[which], terms[which])
        ends = parts.somebody_ends()
        rewards, terminated, truncated, infos = self._tell(agents, parts, ends)
        if ends:
            self._let_fly(which[[not (terminated[name] or truncated[name]) for name in agents]])
        return dict(zip(agents, observations, strict=True)), rewards, terminated, truncated, infos

    def render(self) -> NDArray[np.uint8] | None:
        """The picture of the present moment, (height, width, 3); with "human" it is in the window already."""
        if self._pictures is None:
            logger.warn(NO_RENDERING)
            return None
        return self._pictures.show()

    def close(self) -> None:
        """Close the window."""
        if self._pictures:
            self._pictures.close()

    def _fresh_observations(self) -> Observation:
        return np.empty(self._shape, dtype=np.float32)

    def _stack(self, actions: dict[str, NDArray[np.float32]]) -> NDArray[np.float32]:
        """Actions of all vehicles, (N, action_size); zero for those that left."""
        agents, size = self.agents, self._action_size
        try:
            rows: Any = self._of_each(actions) if len(agents) > 1 else [actions[name] for name in agents]
            fits = set(map(len, rows)) == {size} and len(actions) == len(agents)
            if set(map(_ndim, rows)) == {1} and list(map(_dtype, rows)) == [FLOAT32] * len(rows):
                joined = np.frombuffer(b"".join(rows), dtype=np.float32)  # the quickest way for many
            else:
                joined = np.concatenate(rows, dtype=np.float32, casting="same_kind")
        except (AttributeError, KeyError, TypeError, ValueError):
            fits = False
        if not fits or joined.ndim != 1:
            self._check(actions)
            joined = np.concatenate([actions[name] for name in agents]).astype(np.float32)
        if len(agents) == len(self.possible_agents):
            return joined
        out = np.zeros((len(self.possible_agents), self._action_size), dtype=np.float32)
        out[self._rows] = joined.reshape(len(agents), self._action_size)
        return out

    def _check(self, actions: Any) -> None:
        """Refuse what is not one action per agent.

        Raises:
            ValueError: If the environment is not in an episode, or it says which agent's action is wrong.
        """
        if not self.agents:
            raise ValueError("no agent is flying: call reset() before step()")
        if not isinstance(actions, dict):
            raise ValueError(f"actions must be a dict agent -> action, got {type(actions).__name__}")
        missing = [name for name in self.agents if name not in actions]
        extra = [name for name in actions if name not in self.agents]
        if missing or extra:
            left = [name for name in extra if name in self.possible_agents]
            remedy = f"; {', '.join(left)} left the episode" if left else ""
            raise ValueError(
                f"actions need one entry for each of env.agents: missing {missing}, extra {extra}{remedy}"
            )
        for name in self.agents:
            action = actions[name]
            what = f"action of {name} must be {self._action_size} numbers"
            if real_numbers(action, what).shape != (self._action_size,):
                raise ValueError(f"{what}, got {shown(action)}")

    def _let_fly(self, rows: NDArray[np.int64]) -> None:
        """These vehicles, (n,), are the agents from now on."""
        self._rows = rows
        self.agents: list[str] = [self.possible_agents[i] for i in rows.tolist()]
        self._nobody = dict.fromkeys(self.agents, False)
        self._of_each: Any = itemgetter(*self.agents) if self.agents else None

    def _tell(
        self, agents: list[str], parts: Parts, ends: bool
    ) -> tuple[dict[str, float], dict[str, bool], dict[str, bool], dict[str, Named]]:
        """Rewards, terminations, truncations and infos of the agents; arrays are rows of one of the team."""
        rewards, *numbers = parts.numbers.tolist()
        crashed, truncated, violated, terminated, _ = parts.flags.tolist()
        columns = *numbers, *parts.counts.tolist(), crashed, violated, parts.values, parts.terms
        told = zip(*columns, strict=True)
        infos = [
            {
                "cost": cost,
                "episode_cost": total,
                "constraint_violation": violates,
                "constraint_values": value,
                "stage_cost": loss,
                "crashed": crashes,
                "crash_cause": cause,
                "clipped_actions": clipped,
                "formation_error": error,
                "min_separation": near,
                "messages": heard,
                "reward_terms": terms,
            }
            for loss, cost, total, error, near, clipped, cause, heard, crashes, violates, value, terms in told
        ]
        return (
            dict(zip(agents, rewards, strict=True)),
            dict(zip(agents, terminated, strict=True)) if ends else self._nobody.copy(),
            dict(zip(agents, truncated, strict=True)) if ends else self._nobody.copy(),
            dict(zip(agents, infos, strict=True)),
        )
