"""A batch of tracking flights: the arrays that the kernel works on, and the reset of one of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...arguments.checks import array_bytes, require_memory
from ...arguments.names import shown
from ...compilation.decorators import DirectEntry, entry_of
from ...compilation.normals import key_of
from ...compilation.packed import IntArray, pack
from ...compilation.threads import Threads
from ...disturbances import Disturbance
from ...lanes import LANES, N_PLANT, N_TRACKING, STEP, Blocks
from ...observations.tracking import tabulate_previews
from ...plant import N_STATE, POSITION, Array
from ...references import RandomSmooth, Reference, make_reference, state_on
from ...references.table_row import N_PREVIEW, N_TABLE
from ...tasks import Task
from ..shared.draws import coming, gusts_in_flight, make_draws
from ..shared.given import given_plants
from ..shared.packed_batch import PackedBatch
from ..shared.random_vehicles import random_vehicles
from ..shared.tables import disturbance_rows, reference_rows, stage_times
from ..shared.task_vector import task_vector
from .kernel import N_TOLD, Flights, begin_flights, step_flights, tell_flights
from .options import TrackingOptions
from .scores import Scores, scores_of

_tabulate_previews = entry_of(tabulate_previews)
_step, _begin, _tell = DirectEntry(step_flights), entry_of(begin_flights), entry_of(tell_flights)
Generators = Sequence[np.random.Generator]


class _Drawn(NamedTuple):
    """Which uniform numbers a flight draws when it begins: its start, (12,), and what follows."""

    vehicle: slice
    reference: slice
    key: bool  # whether it draws that of gusts and noise, which is the last
    first: int  # those that are drawn before objects draw, the rest comes after
    objects: bool  # whether reference or disturbance draws by itself

    @property
    def size(self) -> int:
        """How many they are."""
        return self.first + self.key


class TrackingBatch(PackedBatch):
    """n independent flights of one task.

    The public arrays are views for reading; `begin` and `step` change them.
    """

    options: TrackingOptions
    task: Task

    def __init__(self, options: TrackingOptions, n: int, threads: int = 1) -> None:
        self.options, self.n, self.task = options, n, options.task
        self._reference: Reference = make_reference(options.reference)
        self._disturbance: Disturbance | None = options.make_disturbance()
        random = self._random = self._drawn_anew()
        count = [n if is_random else 1 for is_random in random]
        steps, dt, nodes = self.task.episode_steps, self.task.dt, 2 * options.substeps + 1
        references = (count[0], steps + 1 + self.task.layout.preview, N_TABLE)
        blown = 1 if gusts_in_flight(self._disturbance) else steps if self._disturbance else 0
        disturbances = (count[1], blown, nodes, 6)
        noises = (count[2], 1 if random[2] else 0, N_STATE)
        seen, previews = (n, self.task.layout.size), (*references[:2], N_PREVIEW // 2)
        require_memory(
            f"{shown(n)} flights of {steps} steps",
            array_bytes(
                (n, N_TRACKING // LANES), references, previews, disturbances, noises, (steps, nodes), seen
            ),
            "choose fewer of them, shorter ones, a shorter preview, or fewer substeps",
        )
        self.vehicles = Blocks(n, N_TRACKING)
        self._vehicles = random_vehicles(self.task, options.randomization())
        self._start, self._widths = options.start_state(), options.start_half_widths()
        self._times: Array = dt * np.arange(references[1], dtype=np.float64)
        self._nodes = stage_times(self.task, options.substeps)
        never = np.random.default_rng(0)
        self.references: Array = np.zeros(references)
        self._previews = np.zeros((*references[:2], N_PREVIEW), dtype=np.float32)
        self.disturbances: Array = np.zeros(disturbances)
        self.noises: Array = np.zeros(noises)
        first = reference_rows(self._reference, self._times, never)  # of a random one, to see that it works
        options.require_near(first[0, POSITION])
        if not random[0]:
            self.references[0] = first
            _tabulate_previews(self.references, np.zeros(1, dtype=np.int64), self._previews)
        if self._disturbance is not None and not random[1]:
            self.disturbances[0] = disturbance_rows(self._disturbance, self._nodes, dt, never)
        self.which: NDArray[np.int64] = np.outer(random, np.arange(n))  # a table of each, or the one of all
        self._place_nominal()
        self._arrays = Flights(
            self.vehicles.array,
            self.references,
            self._previews,
            self.disturbances,
            self.noises,
            self.which,
            make_draws(self._disturbance, self.task, options.substeps, n, self.vehicles.count),
            task_vector(self.task, options.substeps, options.lost_distance),
        )
        self._drawn = self._uniform_numbers()
        self._told_shape = N_TOLD + len(self.task.constraint_names), n
        self._words = pack(self._arrays)
        self._blocks = self.vehicles.count
        threads = min(threads, self._blocks)
        self._threads = Threads(threads) if threads > 1 else None

    def _drawn_anew(self) -> tuple[bool, bool, bool]:
        """Whether references, disturbances and noise differ from episode to episode.

        A table that is the same in every episode is stored once.
        """
        blown = self._disturbance is not None and self._disturbance.random
        return self._reference.random, blown, max(self.task.sensor_noise) > 0.0

    def _uniform_numbers(self) -> _Drawn:
        """What the flights of this task draw."""
        vehicle = N_STATE + self._vehicles.columns.size
        reference = vehicle + (self._reference.numbers if isinstance(self._reference, RandomSmooth) else 0)
        draws = self._arrays.draws
        own_reference = self._random[0] and reference == vehicle
        return _Drawn(
            vehicle=slice(N_STATE, vehicle),
            reference=slice(vehicle, reference),
            key=draws.gusty or draws.noisy,
            first=reference,
            objects=own_reference or (self._random[1] and not draws.gusty),
        )

    def scores(self, told: Array) -> Scores:
        """What is told there."""
        return scores_of(told)

    def coming_disturbances(self) -> Array:
        """Of each flight, at the stage times of the control period that begins, (n, 2 substeps + 1, 6)."""
        steps = self.vehicles.read(STEP).astype(np.int64)
        return coming(self._arrays.draws, self.disturbances, self.which[1], steps)

    def begin(
        self,
        index: IntArray,
        generators: Generators,
        out: NDArray[np.float32],
        told: Array,
        states: Array | None = None,
    ) -> None:
        """Begin new episodes, and write their first observations and scores.

        Draws for each flight, in this order: start (12 uniform numbers), vehicle, reference, disturbance, and
        the key of gusts and sensor noise (one uniform number).

        Args:
            index: Flights, (m,).
            generators: Theirs, m.
            out: Observations, (n layout.size,) float32.
            told: Scores, of `fresh_scores`.
            states: Plants (m, 16) instead of the drawn starts.

        Raises:
            ValueError: If a start is lost already.
        """
        uniform = np.empty((len(index), self._drawn.size))
        for row, i, rng in zip(uniform, index.tolist(), generators, strict=True):
            if self._drawn.objects:
                rng.random(out=row[: self._drawn.first])
                self._draw(i, rng)
                rng.random(out=row[self._drawn.first :])
            else:
                rng.random(out=row)
        self._take(index, uniform)
        draws = uniform[:, :N_STATE]
        if states is None:
            plants = np.full((len(index), N_PLANT), self.task.hover_force)
            plants[:, :N_STATE] = self._start + self._widths * (2.0 * draws - 1.0)
            if self.options.starts_on_reference:
                plants[:, :N_STATE] += [state_on(self.reference(i)[0]) for i in index.tolist()]
        else:
            plants = np.ascontiguousarray(states)
        lost = _begin(self._words, index, plants, out, told)
        if lost >= 0:
            off = plants[lost, POSITION] - self.reference(int(index[lost]))[0, POSITION]
            raise ValueError(
                f"the start is {float(np.linalg.norm(off)):.3g} m from the reference, beyond lost_distance = "
                f"{self.options.lost_distance:g} m; move the start or the reference, or raise lost_distance"
            )

    def _draw(self, i: int, rng: np.random.Generator) -> None:
        """What reference and disturbance draw for flight i by themselves."""
        if self._random[0] and not isinstance(self._reference, RandomSmooth):
            self.references[i] = reference_rows(self._reference, self._times, rng)
        if self._disturbance is not None and self._random[1] and not self._arrays.draws.gusty:
            self.disturbances[i] = disturbance_rows(self._disturbance, self._nodes, self.task.dt, rng)

    def _take(self, index: IntArray, uniform: Array) -> None:
        """What follows from the uniform numbers (m, `_drawn.size`) of flights that begin."""
        drawn = self._drawn
        if self._vehicles.columns.size:
            h = self.task.dt / self.options.substeps
            self._vehicles.place(uniform[:, drawn.vehicle], index, self.vehicles, h)
        if isinstance(self._reference, RandomSmooth):
            self._reference.tabulate(uniform[:, drawn.reference], self._times, index, self.references)
        if self._random[0]:
            _tabulate_previews(self.references, index, self._previews)
        if drawn.key:
            self._arrays.draws.keys[index] = key_of(uniform[:, -1])

    def tell(self, index: IntArray, out: NDArray[np.float32], told: Array) -> None:
        """Write observations and scores of flights as they are; arguments as in `begin`."""
        _tell(self._words, index, out, told)

    def reference(self, i: int) -> Array:
        """Reference rows of flight i in its present episode, a view, (n_steps, N_TABLE)."""
        return np.asarray(self.references[self.which[0, i]])

    def step(self, actions: NDArray[np.float32], out: NDArray[np.float32], told: Array) -> int:
        """Move all flights by one control period, and write their observations and scores.

        Args:
            actions: (4 n,), contiguous; clipped to [-1, 1], which is counted.
            out: Observations, (n layout.size,).
            told: Scores, of `fresh_scores`.

        Returns:
            Number of episodes that ended.

        Raises:
            ValueError: If an action is not finite; then no flight has moved.
        """
        if self._threads is None:
            ended: int = _step.call(self._words, actions, out, told, 0, self._blocks)
        else:
            ended = self._step_in_threads(self._threads, actions, out, told)
        if ended < 0:
            bad = -1 - ended
            where = f"[{bad}]" if self.n == 1 else f"[{bad // 4}, {bad % 4}]"
            raise ValueError(
                f"action{where} is {actions[bad]}; actions must be finite numbers in [-1, 1]. "
                "The environment has not moved."
            )
        return ended

    def _step_in_threads(
        self, threads: Threads, actions: NDArray[np.float32], out: NDArray[np.float32], told: Array
    ) -> int:
        """As the kernel of `step`; each thread moves an equal share of the blocks."""
        found = threads.shares(
            self._blocks, lambda _, begin, end: _step.call(self._words, actions, out, told, begin, end)
        )
        return min(found) if min(found) < 0 else sum(found)

    def given_states(self, options: Mapping[str, Any] | None) -> Array | None:
        """The plant (16,) of the reset options, if there is one.

        Raises:
            ValueError: If an option is unknown, or the state is not a finite plant.
        """
        if not isinstance(options, Mapping | None):
            raise ValueError(f"reset options must be a mapping, as {{'state': [...]}}, got {shown(options)}")
        if not options:
            return None
        unknown = [name for name in options if name != "state"]
        if unknown:
            raise ValueError(f"unknown reset option {shown(unknown[0])}; known: 'state' (12 or 16 numbers)")
        return given_plants(options["state"], (), self.task.hover_force)
