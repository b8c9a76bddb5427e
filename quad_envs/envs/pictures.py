"""What the environments tell of their flights for pictures: trails, scores, a Scene of the present moment.

An environment has one of these only if it was given a render_mode; without one nothing is recorded.
"""

from __future__ import annotations

from collections import deque

import gymnasium
import numpy as np
from numpy.typing import NDArray

from ..constraints import TOLERANCE
from ..lanes import (
    ALIVE,
    CRASHED,
    MEASURES,
    MOST_VALUES,
    N_PLANT,
    NEAREST,
    PLANT,
    REWARD,
    SLOT_ERROR,
    STEP,
    TRUNCATED,
    VALUES,
    VIOLATED,
)
from ..limits import UNITS
from ..parameters import POSITION, VELOCITY, Array
from ..pictures.scenes import Framing, Scene
from ..pictures.window import Window
from ..tasks import Task, TeamTask
from .team.batch import TeamBatch
from .team.exchange import SENT, WEIGHT
from .team.kernel import ESTIMATE_REACH, ESTIMATE_SPEED
from .team.options import EstimationOptions
from .tracking.batch import TrackingBatch

_TRAIL = 3.0  # s
_OVERVIEW_POINTS = 120


class Pictures:
    """Records one flight and shows it.

    Args:
        batch: What flies.
        vehicles: Rows of the flight's vehicles in the batch.
        size: Width and height of the pictures, pixels.
    """

    def __init__(self, batch: TrackingBatch | TeamBatch, vehicles: slice, size: tuple[int, int]) -> None:
        self.size = size
        self._flying, self._vehicles = batch, vehicles
        task = self._task
        self._trail: deque[Array] = deque(maxlen=max(2, round(_TRAIL / task.dt) + 1))
        self._rewards = 0.0
        self._wanted = np.zeros((0, 0, 3))
        self._target = np.zeros((0, 3))
        self._estimates = np.zeros((0, 3))  # of the target's position, where those are the actions
        self._framing: Framing | None = None
        limits = task.limits
        self._box = np.array([limits.position_lower, limits.position_upper])
        if not limits.has_position:
            self._box = self._box[:0]

    @property
    def _task(self) -> Task | TeamTask:
        return self._flying.task

    def _read(self, row: int, count: int = 1) -> Array:
        """One quantity of the vehicles, (n,), or some that follow each other, (n, count)."""
        return self._flying.vehicles.read(row, count)[self._vehicles]

    @property
    def _plants(self) -> Array:
        return self._read(PLANT, N_PLANT)

    @property
    def _step(self) -> int:
        return int(self._read(STEP)[0])

    def record(self, actions: NDArray[np.float32] | None = None) -> None:
        """Take the present moment down, and the actions that led there; a reset begins anew."""
        if self._step == 0:
            self._trail.clear()
            self._rewards, self._estimates = 0.0, self._estimates[:0]
            self._wanted, self._target = self._wishes()
            seen = np.concatenate([self._wanted, self._target[None]]) if len(self._target) else self._wanted
            self._framing = Framing(seen, self._box, self._task.dt)
        else:
            self._rewards += float(self._read(REWARD).mean())
        self._trail.append(self._plants[:, POSITION])

    def frame(self) -> NDArray[np.uint8]:
        """The picture of the present moment, (height, width, 3).

        Raises:
            ResetNeeded: If no episode has begun.
        """
        from ..pictures.rendering import render

        return render(self.scene(), *self.size)

    def scene(self) -> Scene:
        """The present moment.

        Raises:
            ResetNeeded: If no episode has begun.
        """
        if self._framing is None:
            raise gymnasium.error.ResetNeeded("call reset() before render()")
        plants, task, k = self._plants, self._task, self._step
        sound = np.isfinite(plants).all(axis=1)
        flies = sound & self._alive()
        who, wrecks, plants = np.flatnonzero(flies), plants[~flies & sound], plants[flies]
        values = self._read(VALUES, MOST_VALUES)[flies, : len(task.constraint_names)]
        names = task.constraint_names
        aim = self._target[max(0, k + 1 - len(self._trail)) : k + 1]
        path, links = self._path(), self._links(who)
        leader = np.flatnonzero(who == self._leader())
        return Scene(
            title=task.env_id.removeprefix("quad/"),
            lines=self._lines(k),
            limits=_limit_texts(names, values),
            ended=self._ending(),
            plants=plants,
            numbers=tuple(who.tolist()),
            leader=int(leader[0]) if leader.size else -1,
            violated=self._read(VIOLATED)[flies] > 0.0,
            crowded=_too_near(names, values),
            trails=np.array(self._trail)[:, flies],
            wrecks=wrecks[:, POSITION],
            behind=path[max(0, k - round(2.0 * _TRAIL / task.dt)) : k + 1],
            ahead=path[k:],
            slots=self._wanted[flies[: len(self._wanted)], min(k, self._wanted.shape[1] - 1)],
            overview=path[:: max(1, len(path) // _OVERVIEW_POINTS)] if self._framing.follows else path[:0],
            target=aim,
            estimates=self._estimates[flies[: len(self._estimates)]],
            sights=self._sights()[flies],
            links=links[:, :2].astype(np.int64),
            strength=links[:, 2:],
            box=self._box,
            view=self._framing.view(k, np.concatenate([plants[:, POSITION], aim[-1:]])),
            ground=self._framing.ground(k),
            arm=task.params.arm,
            arms=task.params.rotor_positions() / task.params.arm,
            separation=float(getattr(task, "separation", 0.0)),
            forces=(task.hover_force, task.force_max),
        )

    def _lines(self, k: int) -> tuple[str, ...]:
        """Time and score: the mean reward so far, and of a whole episode once it is over."""
        task = self._task
        score = f"score {self._rewards / (task.episode_steps if self._ending() else max(k, 1)):.3f}"
        return (
            f"t {k * task.dt:.2f} / {task.episode_steps * task.dt:g} s",
            score if task.reward == "bounded" else f"return {self._rewards:.1f}",
        )

    def _ending(self) -> str:
        if (self._read(CRASHED) > 0.0).all():
            return "crashed"
        return "time limit" if (self._read(TRUNCATED) > 0.0).any() else ""

    def _wishes(self) -> tuple[Array, Array]:
        """Wanted positions (n, T+1, 3) and the target's (T+1, 3), no rows where there is none."""
        raise NotImplementedError

    def _path(self) -> Array:
        """The reference to draw, (T+1, 3) or no rows."""
        return np.asarray(self._wanted[0])

    def _alive(self) -> NDArray[np.bool_]:
        return np.ones(len(self._plants), dtype=np.bool_)

    def _sights(self) -> NDArray[np.bool_]:
        return np.zeros(len(self._plants), dtype=np.bool_)

    def _leader(self) -> int:
        return -1

    def _links(self, who: NDArray[np.int64]) -> Array:
        """Hearer, sender (as rows of the flying ones), relative weight, freshness, (l, 4)."""
        return np.zeros((0, 4))


class TrackingPictures(Pictures):
    """Of flight i of a tracking batch."""

    def __init__(self, batch: TrackingBatch, i: int, size: tuple[int, int]) -> None:
        super().__init__(batch, slice(i, i + 1), size)
        self._batch, self._i = batch, i

    def _wishes(self) -> tuple[Array, Array]:
        rows = self._batch.reference(self._i)[: self._task.episode_steps + 1]
        return np.asarray(rows[None, :, POSITION]), np.zeros((0, 3))

    def _lines(self, k: int) -> tuple[str, ...]:
        p = self._plants[0, POSITION]
        off = float(np.linalg.norm(p - self._wanted[0, min(k, self._wanted.shape[1] - 1)]))
        return (*super()._lines(k), f"position error {off:.2f} m", f"height {0.0 - p[2]:.2f} m")


class TeamPictures(Pictures):
    """Of the first team of a batch; with the mode "human" each moment is shown in a window."""

    def __init__(self, batch: TeamBatch, size: tuple[int, int], mode: str) -> None:
        super().__init__(batch, slice(batch.n), size)
        self._mode = mode
        self._window: Window | None = None
        self._batch = batch
        self._on_rails = isinstance(batch.options, EstimationOptions)
        self._heaviest = float((batch.graphs.graphs * (1.0 - np.eye(batch.n))).max(initial=1e-9))

    def record(self, actions: NDArray[np.float32] | None = None) -> None:
        """Take the present moment down; on rails the actions are estimates, carried on to the present."""
        super().record(actions)
        if self._on_rails and actions is not None:
            plants = self._plants
            told = np.clip(actions.reshape(len(plants), -1), -1.0, 1.0)
            drift = ESTIMATE_SPEED * told[:, 3:] - plants[:, VELOCITY]
            self._estimates = plants[:, POSITION] + ESTIMATE_REACH * told[:, :3] + self._task.dt * drift
        if self._mode == "human":
            self._show_in_window()

    def show(self) -> NDArray[np.uint8] | None:
        """The picture, or with "human" nothing: it has been in the window since it was recorded."""
        if self._mode != "human":
            return self.frame()
        if self._framing is None:
            raise gymnasium.error.ResetNeeded("call reset() before render()")
        return None

    def _show_in_window(self) -> None:
        if self._window is None:
            self._window = Window(self.size, self._task.env_id)
        self._window.show(self.frame(), round(1.0 / self._task.dt))

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def _wishes(self) -> tuple[Array, Array]:
        batch = self._batch
        target = batch.target(0)[:, POSITION] if self._has_target else np.zeros((0, 3))
        if not self._on_rails:
            return batch.wanted(0)[..., POSITION], target
        times = self._task.dt * np.arange(self._task.episode_steps + 1)[:, None]
        plants = self._plants
        return plants[:, None, POSITION] + plants[:, None, VELOCITY] * times, target

    @property
    def _has_target(self) -> bool:
        return not self._batch.options.has_leader

    def _path(self) -> Array:
        return self._wanted[0, :0] if self._has_target else self._wanted[0]

    def _lines(self, k: int) -> tuple[str, ...]:
        flies = self._alive()
        error, near = self._read(SLOT_ERROR)[flies], self._read(NEAREST)[flies]
        if not error.size:
            return super()._lines(k)
        what = "estimates off by" if self._on_rails else "slot error"
        lines = (*super()._lines(k), f"{what} {error.mean():.2f} m")
        return lines if self._on_rails else (*lines, f"nearest pair {near.min():.2f} m")

    def _alive(self) -> NDArray[np.bool_]:
        return np.asarray(self._read(ALIVE) > 0.0)

    def _sights(self) -> NDArray[np.bool_]:
        return np.asarray(self._read(MEASURES) > 0.0) & self._has_target

    def _leader(self) -> int:
        return 0 if self._batch.options.has_leader else -1

    def _links(self, who: NDArray[np.int64]) -> Array:
        batch, k = self._batch, self._step
        heard, lifetime = batch.heard(0)[who], batch.options.message_lifetime
        age = (k - heard[..., SENT]) * self._task.dt
        i, s = np.nonzero((heard[..., WEIGHT] > 0.0) & (age <= lifetime + 1e-9))
        row = np.full(batch.n + 1, -1)
        row[who] = np.arange(who.size)
        weight, fresh = heard[i, s, WEIGHT] / self._heaviest, 1.0 - age[i, s] / lifetime
        links = np.column_stack([i, row[batch.neighbours[who[i], s]], weight, fresh])
        return np.asarray(links[links[:, 1] >= 0.0])


def _too_near(names: tuple[str, ...], values: Array) -> NDArray[np.bool_]:
    """Who violates the separation, of the limits' values (n, number of limits), (n,)."""
    if "separation" not in names:
        return np.zeros(len(values), dtype=np.bool_)
    return np.asarray(values[:, names.index("separation")] > TOLERANCE)


def _limit_texts(names: tuple[str, ...], values: Array) -> tuple[tuple[str, bool], ...]:
    """Each limit, and by how much and by how many it is violated, of values (n, number of limits)."""
    texts = []
    for name, column in zip(names, values.T, strict=True):
        over = column[column > TOLERANCE]
        many = f" ({over.size})" if len(values) > 1 else ""
        texts.append((f"{name} +{over.max():.2f} {UNITS[name]}{many}" if over.size else name, over.size > 0))
    return tuple(texts)
