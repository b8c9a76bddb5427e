"""A batch of teams: the arrays that the kernel works on, and the reset of one of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...arguments.checks import array_bytes, require_memory
from ...arguments.names import nearest_name, shown, unknown_name
from ...compilation.decorators import DirectEntry, entry_of
from ...compilation.normals import key_of
from ...compilation.packed import IntArray, pack
from ...compilation.threads import Threads
from ...constraints import constraint_scales
from ...formations import start_positions
from ...graphs import in_neighbours
from ...lanes import (
    ALIVE,
    LANES,
    MEASURES,
    MOST_VALUES,
    N_PLANT,
    N_TEAM,
    PLANT,
    STEP,
    Blocks,
)
from ...observations.tracking import N_REFERENCE, tabulate_previews
from ...plant import N_STATE, Array
from ...references import make_reference, pack_rows
from ...references.plausible import target_too_fast
from ...references.table_row import N_PREVIEW, N_TABLE
from ...sensors import sensor_rows
from ...targets import N_TARGET, make_target
from ...tasks import TeamTask
from ..shared.draws import coming, gusts_in_flight, make_draws
from ..shared.given import given_plants
from ..shared.packed_batch import PackedBatch
from ..shared.random_vehicles import random_vehicles
from ..shared.tables import checked_rows, disturbance_rows, reference_rows, stage_times
from ..shared.task_vector import task_vector
from .exchange import (
    DISTURBANCE,
    DRAW,
    HEAD,
    LIFETIME,
    NOISE,
    PLAN,
    REFERENCE,
    SENT,
    TARGET,
    WEIGHT,
    Tables,
)
from .kernel import N_TOLD, Teams, begin_teams, scratch_size, step_teams
from .options import EstimationOptions, FormationOptions, TargetTrackingOptions, TeamOptions
from .scores import N_LOSS
from .told import Parts, TeamScores, parts_of, team_scores

_tabulate_previews = entry_of(tabulate_previews)
_step, _begin = DirectEntry(step_teams), entry_of(begin_teams)
Generators = Sequence[np.random.Generator]
_RESET_OPTIONS = ("state",)


class TeamBatch(PackedBatch):
    """`teams` independent flights of one multi-agent task; vehicle i of team t is row t N + i.

    The public arrays are views for reading; `begin` and `step` change them.
    """

    options: TeamOptions
    task: TeamTask
    _arrays: Teams

    def __init__(self, options: TeamOptions, teams: int, threads: int = 1) -> None:
        self.options, self.teams, self.task = options, teams, options.task
        self.n = options.vehicles
        self.slots, self.graphs = np.array(self.task.slots), options.graphs
        layout = self.task.layout
        content = PLAN + 6 * layout.plan
        shapes = (
            (teams * self.n, layout.neighbours, HEAD + content),
            (teams, options.delay + 1, self.n, content),
        )
        threads = min(threads, teams)
        self._take_choices()
        self._require_memory((teams * self.n, N_TEAM // LANES), *shapes)
        self.vehicles = Blocks(teams * self.n, N_TEAM, self.n)
        self._messages, self._history = map(np.zeros, shapes)
        self.neighbours = np.full((self.n, layout.neighbours), -1, dtype=np.int64)
        found = in_neighbours(self.graphs.graphs)
        self.neighbours[:, : found.shape[1]] = found
        self._make_tables()
        self._arrays = Teams(
            self.vehicles.array,
            self._messages,
            self._history,
            Tables(
                self._weights(),
                self.neighbours,
                np.array(self.graphs.which, dtype=np.int64),
                self._offsets(),
                self._which,
                self.references,
                self._previews,
                self.disturbances,
                self.noises,
                self.targets,
                self._draws,
            ),
            task_vector(self.task, options.substeps, math.inf),
            _team_vector(options),
            np.zeros((threads, scratch_size(self.n, layout.sensed))),
            make_draws(self._disturbance, self.task, options.substeps, teams * self.n, self.vehicles.count),
        )
        self._words = pack(self._arrays)
        self._threads = Threads(threads) if threads > 1 else None
        self._constraints = len(self.task.constraint_names)
        self._told_shape = N_TOLD + 2 * self._constraints + N_LOSS, teams * self.n
        self._place_nominal()
        if isinstance(options, TargetTrackingOptions):
            for t in range(teams):
                for i in options.informed():
                    self.vehicles.write(MEASURES, np.ones(1), t * self.n + i)

    def parts(self, told: Array) -> Parts:
        """What is told there, kind by kind."""
        return parts_of(told, self._constraints)

    def scores(self, told: Array) -> TeamScores:
        """What is told there."""
        return team_scores(told, self._constraints)

    def _take_choices(self) -> None:
        """What is flown, and which of it is drawn at reset."""
        options = self.options
        self._vehicles = random_vehicles(self.task, options.randomization())
        self._reference = make_reference(
            options.reference if isinstance(options, FormationOptions) else "setpoint"
        )
        self._disturbance = options.make_disturbance()
        self._target = make_target(options.target) if isinstance(options, TargetTrackingOptions) else None
        self._spread = options.target_spread if isinstance(options, TargetTrackingOptions) else (0.0, 0.0)
        self._random = (
            self._reference.random,
            self._disturbance is not None and self._disturbance.random,
            max(self.task.sensor_noise) > 0.0,
            self._target is not None and (self._target.random or max(self._spread) > 0.0),
            self._target is not None or options.drop_out > 0.0,
        )

    def _table_shapes(self) -> list[tuple[int, ...]]:
        """Shapes of references, disturbances, noises, targets, draws; what never changes is stored once."""
        n, teams, steps = self.n, self.teams, self.task.episode_steps
        units = (teams, teams * n, teams * n, teams, teams)
        count = [unit if random else 1 for unit, random in zip(units, self._random, strict=True)]
        # Gusts and noise are drawn period by period.
        blown = 1 if gusts_in_flight(self._disturbance) else steps if self._disturbance else 0
        return [
            (count[REFERENCE], steps + 1 + self.task.layout.preview, N_TABLE),
            (count[DISTURBANCE], blown, 2 * self.options.substeps + 1, 6),
            (count[NOISE], 1 if self._random[NOISE] else 0, N_STATE),
            (count[TARGET], steps + 1 if self._target else 0, N_TARGET),
            (count[DRAW], steps + 1 if self._random[DRAW] else 0, n, 4 + self.task.layout.neighbours),
        ]

    def _require_memory(self, *shapes: tuple[int, ...]) -> None:
        """Refuse what this machine cannot hold, before it is taken."""
        seen = (self.teams * self.n, self.task.layout.size)
        require_memory(
            f"{shown(self.teams)} teams of {self.n} vehicles, {self.task.episode_steps} steps",
            array_bytes(*shapes, seen, *self._table_shapes()),
            "choose fewer of them, shorter ones, a shorter preview or delay, or fewer neighbours",
        )

    def _make_tables(self) -> None:
        """Tables of what is drawn at reset."""
        options, n, teams, never = self.options, self.n, self.teams, np.random.default_rng(0)
        steps, dt = self.task.episode_steps, self.task.dt
        self._times = dt * np.arange(steps + 1 + self.task.layout.preview, dtype=np.float64)
        self._nodes = stage_times(self.task, options.substeps)
        tables = [np.zeros(shape) for shape in self._table_shapes()]
        self.references, self.disturbances, self.noises, self.targets, self._draws = tables
        self._previews = np.zeros((*self.references.shape[:2], N_PREVIEW), dtype=np.float32)
        self._which = np.zeros((5, teams * n), dtype=np.int64)
        for kind in range(5):
            if self._random[kind]:
                each = 1 if kind in (DISTURBANCE, NOISE) else n
                self._which[kind] = np.arange(teams * n) // each
        first = reference_rows(self._reference, self._times, never)  # of a random one, to see that it works
        if not self._random[REFERENCE]:
            self.references[0] = first
            _tabulate_previews(self.references, np.zeros(1, dtype=np.int64), self._previews)
        if self._disturbance is not None and not self._random[DISTURBANCE]:
            self.disturbances[0] = disturbance_rows(self._disturbance, self._nodes, dt, never)
        if self._target is not None and not self._random[TARGET]:
            self.targets[0] = self._target_rows(never)

    def _weights(self) -> Array:
        """G_ij per graph and slot, (M, N, K)."""
        i = np.arange(self.n)[:, None]
        weights = np.where(self.neighbours >= 0, self.graphs.graphs[:, i, self.neighbours], 0.0)
        return np.ascontiguousarray(weights, dtype=np.float64)

    def _offsets(self) -> Array:
        """delta_ij per slot, then the own slot, (N, K + 1, 3)."""
        K = self.neighbours.shape[1]
        out = np.zeros((self.n, K + 1, 3))
        offsets = self.slots[:, None] - self.slots[self.neighbours]
        out[:, :K] = np.where(self.neighbours[..., None] >= 0, offsets, 0.0)
        out[:, K] = self.slots
        return out

    def begin(
        self,
        index: IntArray,
        generators: Generators,
        out: NDArray[np.float32],
        told: Array,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        """Begin new episodes, and write their first observations and scores.

        Draws for each team, in this order: starts, vehicles, reference, disturbances, target, keys of gusts
        and of own sensors' noise (a uniform number each), measurement noise, detections and drop-outs.

        Args:
            index: Teams, (m,).
            generators: Theirs, m.
            out: Observations of all, (teams N layout.size,) float32.
            told: Scores of all, of `fresh_scores`.
            options: `{"state": ...}` puts the plants (N, 12) or (N, 16) there.

        Raises:
            ValueError: If the state does not fit, or two vehicles start nearer than the crash distance.
        """
        given = _given_state(options, self.n, self.task.hover_force)
        plants = np.empty((len(index), self.n, N_PLANT))
        for start, t, rng in zip(plants, index.tolist(), generators, strict=True):
            start[:] = self._start(rng) if given is None else given
            self.options.require_apart(start[:, :3])
            self._draw(t, rng)
        _begin(self._words, index, plants, out, told, self._constraints)

    def _draw(self, t: int, rng: np.random.Generator) -> None:
        """What else is drawn for team t."""
        first, n = t * self.n, self.n
        if self._vehicles.columns.size:
            uniform, h = rng.random((n, self._vehicles.columns.size)), self.task.dt / self.options.substeps
            self._vehicles.place(uniform, np.arange(first, first + n), self.vehicles, h)
        if self._random[REFERENCE]:
            self.references[t] = reference_rows(self._reference, self._times, rng)
            _tabulate_previews(self.references, np.array([t]), self._previews)
        draws = self._arrays.draws
        if self._disturbance is not None and self._random[DISTURBANCE] and not draws.gusty:
            for i in range(first, first + n):
                self.disturbances[i] = disturbance_rows(self._disturbance, self._nodes, self.task.dt, rng)
        if self._random[TARGET]:
            self.targets[t] = self._target_rows(rng)
        if draws.gusty or draws.noisy:
            draws.keys[first : first + n] = key_of(rng.random(n))
        if self._random[DRAW]:
            draws = self._draws[t]
            draws[..., :3] = rng.standard_normal((*draws.shape[:-1], 3))
            draws[..., 3:] = rng.random((*draws.shape[:-1], draws.shape[-1] - 3))

    def target(self, t: int) -> Array:
        """Rows r, v of the target of team t, a view, (T+1, 6); zero where there is none."""
        if self._target is None:
            return np.broadcast_to(0.0, (self.task.episode_steps + 1, N_TARGET))
        return np.asarray(self.targets[self._which[TARGET, t * self.n]])

    def wanted(self, t: int) -> Array:
        """Where each vehicle of team t should be, rows as in a reference, (N, T+1, 8)."""
        steps = self.task.episode_steps + 1
        if self._target is None:
            rows = self.references[self._which[REFERENCE, t * self.n], :steps, :N_REFERENCE]
        else:
            rows = pack_rows(*np.split(self.target(t), 2, axis=1))
        out = np.repeat(rows[None], self.n, axis=0)
        out[..., :3] += self.slots[:, None]
        return out

    def graph(self, k: int) -> Array:
        """Weights G at step k, (N, N)."""
        return np.asarray(self.graphs.graphs[self.graphs.which[k]])

    def state(self) -> Array:
        """The whole truth of each team, (teams, S), parts as in `TeamTask.state_slices`."""
        n, stages, first = self.n, self.task.layout.preview + 1, slice(None, None, self.n)
        k = self.vehicles.read(STEP)[first].astype(np.int64)
        alive = self.vehicles.read(ALIVE).reshape(-1, n)
        preview = np.zeros((self.teams, stages, N_REFERENCE))
        if self.options.has_leader:
            at = self._which[REFERENCE, first][:, None], k[:, None] + np.arange(stages)
            preview = self.references[at][..., :N_REFERENCE]
        target = np.zeros((self.teams, N_TARGET))
        if self._target is not None:
            target = self.targets[self._which[TARGET, first], k]
        graph = self.graphs.graphs[np.asarray(self.graphs.which)[k]] * alive[:, None] * alive[:, :, None]
        parts = self.vehicles.read(PLANT, N_PLANT), target, graph, preview, k / self.task.episode_steps
        return np.concatenate([part.reshape(self.teams, -1) for part in parts], axis=1)

    def heard(self, t: int) -> Array:
        """Weight, sent, received of the last message in each comm slot of team t, a view, (N, K, 3)."""
        return self._messages[t * self.n : (t + 1) * self.n, :, :HEAD]

    def ages(self) -> IntArray:
        """Control steps since the message in each comm slot was sent, (n, K); -1 where none is valid."""
        head = self._messages[:, :, :HEAD]
        ages = self.vehicles.read(STEP)[:, None] - head[..., SENT]
        valid = (head[..., WEIGHT] > 0.0) & (ages <= self._arrays.team[LIFETIME])
        return np.where(valid, ages, -1.0).astype(np.int64)

    def coming_disturbances(self) -> Array:
        """Of each vehicle, at the stage times of the control period that begins, (n, 2 substeps + 1, 6)."""
        steps = self.vehicles.read(STEP).astype(np.int64)
        return coming(self._arrays.draws, self.disturbances, self._which[DISTURBANCE], steps)

    @property
    def arrays(self) -> Teams:
        """What the kernels work on, for their adjoints."""
        return self._arrays

    def step(self, actions: NDArray[np.float32], out: NDArray[np.float32], told: Array) -> None:
        """Move all teams by one control period, and write their observations and scores.

        Args:
            actions: (teams N action_size,), contiguous; clipped to [-1, 1], which is counted.
            out: Observations, (teams N layout.size,).
            told: Scores, of `fresh_scores`.

        Raises:
            ValueError: If an action is not finite; then nobody has moved.
        """
        if self._threads is None:
            bad: int = _step.call(self._words, actions, out, told, self._constraints, 0, 0, self.teams)
        else:
            step = partial(_step.call, self._words, actions, out, told, self._constraints)
            bad = min(self._threads.shares(self.teams, step))
        if bad >= 0:
            row, entry = divmod(bad, self.task.action_size)
            raise ValueError(
                f"action[{entry}] of vehicle {row % self.n} (team {row // self.n}) is "
                f"{actions[bad]}; actions must be finite numbers in [-1, 1]. Nobody has moved."
            )

    def _start(self, rng: np.random.Generator) -> Array:
        """First plants, (N, 16): at rest, or on their rails."""
        plants = np.zeros((self.n, N_STATE + 4))
        plants[:, N_STATE:] = self.task.hover_force
        if isinstance(self.options, EstimationOptions):
            plants[:, :3] = self.options.rail_positions()
            plants[:, 3:6] = self.options.rail_velocity
        else:
            plants[:, :3] = start_positions(self.options.start, self.slots, rng, self.task.separation)
        return plants

    def _target_rows(self, rng: np.random.Generator) -> Array:
        """Rows r, v of the target, displaced by what is not known of its start."""
        assert self._target is not None
        times = self._times[: self.task.episode_steps + 1]
        rows = checked_rows("target", self._target, self._target.rows(times, rng), times, N_TARGET)
        said = target_too_fast(rows[:, 3:6], times)
        if said:
            raise ValueError(f"target {shown(self._target)} {said}")
        if max(self._spread) > 0.0:
            offset = np.repeat(np.asarray(self._spread), 3) * rng.standard_normal(N_TARGET)
            rows = rows + offset
            rows[:, :3] += times[:, None] * offset[3:]
        return rows


def _team_vector(options: TeamOptions) -> Array:
    """The team's part of the task in the form that the kernels read, see `exchange`."""
    task = options.task
    scales = np.ones(MOST_VALUES)
    named = constraint_scales(task.limits, task.dt)
    scales[: named.size] = named
    scales[named.size] = task.separation - task.crash_distance
    targets = isinstance(options, TargetTrackingOptions)
    return np.array(
        [
            task.separation,
            task.crash_distance,
            task.sensing_radius,
            round(options.message_lifetime / task.dt + 1e-9),
            options.drop_out,
            task.formation_weight,
            options.arena,
            options.terminate == "team",
            options.has_leader,
            isinstance(options, EstimationOptions),
            sensor_rows(task.sensor) if targets else 0,
            options.detection if isinstance(options, TargetTrackingOptions) else 0.0,
            task.layout.plan,
            len(task.constraint_names),
            task.layout.sensed,
            *task.sensor_sigma,
            *scales,
        ],
        dtype=np.float64,
    )


def _given_state(options: Mapping[str, Any] | None, n: int, hover: float) -> Array | None:
    """Plants (N, 16) from the reset options. Foreign options pass, as PettingZoo's tests demand."""
    for name in options or {}:
        if name not in _RESET_OPTIONS and nearest_name(name, _RESET_OPTIONS) is not None:
            raise ValueError(unknown_name("reset option", name, _RESET_OPTIONS))
    if not options or "state" not in options:
        return None
    return given_plants(options["state"], (n,), hover)
