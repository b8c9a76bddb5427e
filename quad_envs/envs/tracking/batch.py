"""A batch of tracking flights: the arrays that the kernel works on, and the reset of one of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...checks import array_bytes, require_memory
from ...compilation.decorators import entry_of
from ...compilation.packed import IntArray, pack
from ...compilation.threads import Threads
from ...disturbances import Disturbance
from ...lanes import LANES, N_PLANT, N_TRACKING, Blocks
from ...names import shown
from ...normals import key_of
from ...plant import N_STATE, POSITION, Array
from ...references import Reference, make_reference, state_on
from ...table_row import N_TABLE
from ...tasks import Task
from ..shared.draws import gusts_in_flight, make_draws
from ..shared.given import given_plants
from ..shared.packed_batch import PackedBatch
from ..shared.tables import disturbance_rows, draw_vehicle, reference_rows, stage_times
from ..shared.task_vector import task_vector
from .kernel import N_TOLD, Flights, begin_flights, step_flights, tell_flights
from .options import TrackingOptions
from .scores import Scores, scores_of

_step, _begin, _tell = entry_of(step_flights), entry_of(begin_flights), entry_of(tell_flights)
Generators = Sequence[np.random.Generator]


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
        # A table that is the same in every episode is stored once.
        random = (
            self._reference.random,
            self._disturbance is not None and self._disturbance.random,
            max(self.task.sensor_noise) > 0.0,
        )
        count = [n if is_random else 1 for is_random in random]
        steps, dt, nodes = self.task.episode_steps, self.task.dt, 2 * options.substeps + 1
        references = (count[0], steps + 1 + self.task.layout.preview, N_TABLE)
        blown = 1 if gusts_in_flight(self._disturbance) else steps if self._disturbance else 0
        disturbances = (count[1], blown, nodes, 6)
        noises = (count[2], 1 if random[2] else 0, N_STATE)
        seen = (n, self.task.layout.size)
        require_memory(
            f"{shown(n)} flights of {steps} steps",
            array_bytes((n, N_TRACKING // LANES), references, disturbances, noises, (steps, nodes), seen),
            "choose fewer of them, shorter ones, a shorter preview, or fewer substeps",
        )
        self.vehicles = Blocks(n, N_TRACKING)
        self._randomization = options.randomization()
        self._start, self._widths = options.start_state(), options.start_half_widths()
        self._times: Array = dt * np.arange(references[1], dtype=np.float64)
        self._nodes = stage_times(self.task, options.substeps)
        never = np.random.default_rng(0)
        self.references: Array = np.zeros(references)
        self.disturbances: Array = np.zeros(disturbances)
        self.noises: Array = np.zeros(noises)
        first = reference_rows(self._reference, self._times, never)  # of a random one, to see that it works
        options.require_near(first[0, POSITION])
        if not random[0]:
            self.references[0] = first
        if self._disturbance is not None and not random[1]:
            self.disturbances[0] = disturbance_rows(self._disturbance, self._nodes, dt, never)
        self._random = random
        self.which: NDArray[np.int64] = np.zeros((3, n), dtype=np.int64)
        for table in range(3):
            if random[table]:
                self.which[table] = np.arange(n)
        self._place(*draw_vehicle(self.task, {}, never))
        self._arrays = Flights(
            self.vehicles.array,
            self.references,
            self.disturbances,
            self.noises,
            self.which,
            make_draws(self._disturbance, self.task, options.substeps, n, self.vehicles.count),
            task_vector(self.task, options.substeps, options.lost_distance),
        )
        self._told_shape = N_TOLD + len(self.task.constraint_names), n
        self._words = pack(self._arrays)
        self._blocks = self.vehicles.count
        threads = min(threads, self._blocks)
        self._threads = Threads(threads) if threads > 1 else None

    def scores(self, told: Array) -> Scores:
        """What is told there."""
        return scores_of(told)

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
        draws = np.empty((len(index), N_STATE))
        varied = bool(self._randomization) or any(self._random)
        for draw, i, rng in zip(draws, index.tolist(), generators, strict=True):
            rng.random(out=draw)
            if varied:
                self._draw(i, rng)
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
        """What else is drawn for flight i."""
        if self._randomization:
            self._place(*draw_vehicle(self.task, self._randomization, rng), i)
        if self._random[0]:
            self.references[i] = reference_rows(self._reference, self._times, rng)
        draws = self._arrays.draws
        if self._disturbance is not None and self._random[1] and not draws.gusty:
            self.disturbances[i] = disturbance_rows(self._disturbance, self._nodes, self.task.dt, rng)
        if draws.gusty or draws.noisy:
            draws.keys[i] = key_of(rng.random())

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
            ended = _step(self._words, actions, out, told, 0, self._blocks)
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
        cuts = [self._blocks * k // threads.count for k in range(threads.count + 1)]
        found = threads.each(
            lambda thread: _step(self._words, actions, out, told, cuts[thread], cuts[thread + 1])
        )
        return min(found) if min(found) < 0 else sum(found)

    def given_states(self, options: Mapping[str, Any] | None) -> Array | None:
        """The plant (16,) of the reset options, if there is one.

        Raises:
            ValueError: If an option is unknown, or the state is not a finite plant.
        """
        if not options:
            return None
        unknown = sorted(set(options) - {"state"})
        if unknown:
            raise ValueError(f"unknown reset option {unknown[0]!r}; known: 'state' (12 or 16 numbers)")
        return given_plants(options["state"], (), self.task.hover_force)
