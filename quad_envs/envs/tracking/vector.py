"""Many quadrotors follow references at once: the native vector environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from ...arguments.checks import require_whole
from ...lanes import N_PLANT, PLANT
from ...plant import Array
from ...references.table_row import N_REFERENCE
from ...tasks import Task
from ..shared.actions import FLOAT32, real_numbers
from ..shared.given import as_numbers, given_plants
from ..shared.render_modes import NO_RENDERING, checked_rendering
from ..shared.specified import Specified
from ..shared.vector_parts import Generators, autoreset_of, seeded
from .batch import TrackingBatch
from .options import TrackingOptions
from .scores import answer_of, blank_info

if TYPE_CHECKING:
    from ..pictures import TrackingPictures

Observations = NDArray[np.float32]
Bools = NDArray[np.bool_]
_Step = tuple[Observations, Array, Bools, Bools, dict[str, Any]]


class TrackingVectorEnv(
    Specified, gymnasium.vector.VectorEnv[Observations, NDArray[np.float32], NDArray[Any]]
):
    """n tracking tasks stepped in one compiled call, equal row by row to n `TrackingEnv` with the same seeds.

    Args:
        num_envs: Number of flights.
        autoreset_mode: Gymnasium's NEXT_STEP (default), SAME_STEP or DISABLED.
        threads: Threads that share the flights of a step, at most one for four flights. Results do not depend
            on it; below a thousand flights one thread is the fastest, and more than there are cores are slow.
        render_mode: None or "rgb_array".
        render_size: Width and height of each picture, pixels.
        kwargs: As for `TrackingEnv`.

    Raises:
        ValueError: If num_envs < 1 or an argument is not valid.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int = 1,
        render_mode: str | None = None,
        render_size: tuple[int, int] = (640, 480),
        **kwargs: Any,
    ) -> None:
        require_whole("num_envs", num_envs, 1)
        require_whole("threads", threads, 1)
        size = checked_rendering(render_mode, ("rgb_array",), render_size)
        options = TrackingOptions.from_kwargs(kwargs)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.autoreset_mode = autoreset_of(autoreset_mode)
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": 20,
            "autoreset_mode": self.autoreset_mode,
        }
        self._batch = TrackingBatch(options, num_envs, threads)
        self._pictures: list[TrackingPictures] = []
        if render_mode:
            from ..pictures import TrackingPictures  # not needed by who trains and measures

            self._pictures = [TrackingPictures(self._batch, i, size) for i in range(num_envs)]
        self._blank_info = blank_info(self._batch.fresh_scores())
        self.single_action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.single_observation_space = spaces.Box(-np.inf, np.inf, (self.task.layout.size,), np.float32)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._shape = (num_envs, self.task.layout.size)
        self._generators: Generators = []
        self._done = np.zeros(num_envs, dtype=np.bool_)
        self._any_done = False

    @property
    def task(self) -> Task:
        """What is known of the task before the flight."""
        return self._batch.task

    @property
    def state(self) -> Array:
        """Copy of the plant states [p, V_B, Theta, Omega, F], (n, 16). For study and tests."""
        return self._batch.vehicles.read(PLANT, N_PLANT)

    @property
    def reference(self) -> Array:
        """Copy of the reference rows of the present episodes, (n, n_steps, 8). For study and tests."""
        tables = self._batch.references[:, :, :N_REFERENCE]
        return np.repeat(tables, self.num_envs, axis=0) if len(tables) == 1 else tables.copy()

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Begin episodes: in all rows, or in those of `options["reset_mask"]` (bool, (n,)).

        Args:
            seed: One number s (row i gets s + i), one per row, or None to draw on.
            options: `{"state": x}` sets the plants, 12 or 16 numbers for all or one such row for each.
        """
        given = dict(options or {})
        mask = np.asarray(given.pop("reset_mask", np.ones(self.num_envs)), dtype=np.bool_)
        if mask.shape != (self.num_envs,):
            raise ValueError(f"reset_mask must have shape ({self.num_envs},), got {mask.shape}")
        if not (mask.all() or self._generators):
            raise ValueError("the first reset must begin all rows; reset_mask is for later ones")
        state = given.pop("state", None)
        states = None if state is None else self._given_states(state, mask)
        if given:
            self._batch.given_states(given)
        self._generators = seeded(self._generators, seed, mask)
        observations, told = self._fresh_observations(), self._batch.fresh_scores()
        index, rest = np.flatnonzero(mask), np.flatnonzero(~mask)
        self._begin(index, observations, told, states)
        if rest.size:
            self._batch.tell(rest, observations.reshape(-1), told)
        self._done[mask] = False
        self._any_done = bool(self._done.any())
        for i, pictures in enumerate(self._pictures):
            if mask[i]:
                pictures.record()
        return observations, answer_of(told, self._blank_info)[-1]

    def step(self, actions: NDArray[np.float32]) -> _Step:
        """Hold the rotor commands of all flights over one control period."""
        actions = real_numbers(actions, "actions must be numbers", (self.num_envs, 4))
        if actions.shape != (self.num_envs, 4):
            raise ValueError(f"actions must have shape ({self.num_envs}, 4), got {actions.shape}")
        if not self._generators:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        some_ended = self._any_done
        again = some_ended and self.autoreset_mode is AutoresetMode.NEXT_STEP
        if again:
            actions = np.where(self._done[:, None], np.float32(0.0), actions)
        observations, told = self._fresh_observations(), self._batch.fresh_scores()
        ended = self._batch.step(actions.ravel(), observations.ravel(), told)
        if again:
            self._begin(np.flatnonzero(self._done), observations, told)
        reward, crashed, truncated, info = answer_of(told, self._blank_info)
        if ended or some_ended:
            self._done = crashed | truncated
            self._any_done = bool(self._done.any())
        if self._any_done and self.autoreset_mode is AutoresetMode.SAME_STEP:
            info = self._begin_in_same_step(observations, info)
        for pictures in self._pictures:
            pictures.record()
        return observations, reward, crashed, truncated, info

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """One picture of each flight, (height, width, 3), with `render_mode="rgb_array"`."""
        if not self._pictures:
            gymnasium.logger.warn(NO_RENDERING)
            return None
        return tuple(pictures.frame() for pictures in self._pictures)

    def _given_states(self, state: Any, mask: Bools) -> Array:
        """Plants from the reset options of the flights that begin, (m, 16)."""
        states = as_numbers(state)
        if states.ndim == 1:
            states = np.tile(states, (self.num_envs, 1))
        if states.ndim != 2 or len(states) != self.num_envs:
            raise ValueError(
                f"reset option 'state' must be one state for all or {self.num_envs} rows, "
                f"got shape {states.shape}"
            )
        return given_plants(states[mask], (int(mask.sum()),), self.task.hover_force)

    def _begin(
        self, index: NDArray[np.int64], observations: Observations, told: Array, states: Array | None = None
    ) -> None:
        generators = [self._generators[i] for i in index.tolist()]
        self._batch.begin(index, generators, observations.reshape(-1), told, states)

    def _begin_in_same_step(self, observations: Observations, info: dict[str, Any]) -> dict[str, Any]:
        """Begin anew where an episode ended; what was before travels in `final_obs` and `final_info`."""
        done = self._done
        final = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(done).tolist():
            final[i] = observations[i].copy()
        told = self._batch.fresh_scores()
        self._begin(np.flatnonzero(done), observations, told)
        self._batch.tell(np.flatnonzero(~done), observations.reshape(-1), told)
        *_, fresh = answer_of(told, self._blank_info)
        fresh["final_obs"], fresh["_final_obs"] = final, done.copy()
        last = {key: value.copy() for key, value in info.items() if not key.startswith("_")}
        fresh["final_info"] = last | {f"_{key}": done.copy() for key in last}
        fresh["_final_info"] = done.copy()
        return fresh

    def _fresh_observations(self) -> Observations:
        return np.empty(self._shape, FLOAT32)
