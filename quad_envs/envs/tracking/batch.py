"""A batch of tracking flights: the arrays that the kernel works on, and the reset of one of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..._numba import entry_of
from ...checks import array_bytes, require_memory
from ...disturbances import Disturbance
from ...names import shown
from ...parameters import N_STATE, POSITION, Array
from ...references import Reference, make_reference, state_on
from ...turning import N_TABLE
from ..shared.given import given_plants
from ..shared.tables import disturbance_rows, draw_vehicle, reference_rows, stage_times
from .kernel import (
    COEFFICIENTS,
    COMMAND,
    FORCE_MAX,
    PLANT,
    ROW_SIZE,
    SCRATCH_SIZE,
    begin_row,
    observe_row,
    step_rows,
    task_vector,
)
from .options import TrackingOptions

_step = entry_of(step_rows)


class TrackingBatch:
    """n independent flights of one task.

    The public arrays are views for reading; `reset_row` and `step` change them.
    """

    def __init__(self, options: TrackingOptions, n: int) -> None:
        self.options, self.n, self.task = options, n, options.task
        self._reference: Reference = make_reference(options.reference)
        self._disturbance: Disturbance | None = options.make_disturbance()
        self._noise = np.repeat(np.asarray(self.task.sensor_noise), 3)
        # A table that is the same in every episode is stored once.
        random = (
            self._reference.random,
            self._disturbance is not None and self._disturbance.random,
            bool(self._noise.any()),
        )
        count = [n if is_random else 1 for is_random in random]
        steps, dt, nodes = self.task.episode_steps, self.task.dt, 2 * options.substeps + 1
        references = (count[0], steps + 1 + self.task.layout.preview, N_TABLE)
        disturbances = (count[1], steps if self._disturbance else 0, nodes, 6)
        noises = (count[2], steps + 1 if random[2] else 0, N_STATE)
        seen = (n, self.task.layout.size)
        require_memory(
            f"{shown(n)} flights of {steps} steps",
            array_bytes((n, ROW_SIZE), references, disturbances, noises, (steps, nodes), seen),
            "choose fewer of them, shorter ones, a shorter preview, or fewer substeps",
        )
        self.rows: Array = np.zeros((n, ROW_SIZE))
        self._vector = task_vector(self.task, options.substeps, options.lost_distance)
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
        self._scratch = np.zeros(SCRATCH_SIZE)
        # What the step kernel takes before the actions and between them and the observations.
        self._before = (self.rows, self.references, self.disturbances, self.noises, self.which)
        self._after = (self._vector, self._scratch, np.zeros(n, dtype=np.int64))

    def reset_row(
        self,
        i: int,
        rng: np.random.Generator,
        out: NDArray[np.float32],
        options: Mapping[str, Any] | None = None,
    ) -> None:
        """Begin a new episode in row i and write its first observation.

        Draws, in this order: start (12 uniform numbers), vehicle, reference, disturbance, sensor noise.

        Args:
            i: Row.
            rng: The generator of this flight.
            out: Observation, (layout.size,) float32.
            options: `{"state": ...}` puts the plant (12 or 16 numbers) there instead of the drawn start.

        Raises:
            ValueError: If the options are unknown or the state is not a finite plant.
        """
        start = None if not options else self._start_from(options)
        state = self._start + self._widths * rng.uniform(-1.0, 1.0, N_STATE)
        vehicle, force_max = draw_vehicle(self.task, self._randomization, rng)
        row = self.rows[i]
        row[:] = 0.0
        row[PLANT] = [*state, *[self.task.hover_force] * 4] if start is None else start
        row[COMMAND] = self.task.hover_force
        row[COEFFICIENTS], row[FORCE_MAX] = vehicle, force_max
        if self._random[0]:
            self.references[i] = reference_rows(self._reference, self._times, rng)
        if self._disturbance is not None and self._random[1]:
            self.disturbances[i] = disturbance_rows(self._disturbance, self._nodes, self.task.dt, rng)
        if self._random[2]:
            rng.standard_normal(out=self.noises[i])
            self.noises[i] *= self._noise
        if self.options.starts_on_reference and start is None:
            row[:N_STATE] += state_on(self.reference(i)[0])
        distance = float(np.linalg.norm(row[POSITION] - self.references[self.which[0, i], 0, POSITION]))
        if distance > self.options.lost_distance:
            raise ValueError(
                f"the start is {distance:.3g} m from the reference, beyond lost_distance = "
                f"{self.options.lost_distance:g} m; move the start or the reference, or raise lost_distance"
            )
        begin_row(self.rows, i, self.references[self.which[0, i]], self._vector)
        self.observe(i, out)

    def observe(self, i: int, out: NDArray[np.float32]) -> None:
        """Write the present observation of row i, (layout.size,) float32."""
        observe_row(
            self.rows,
            i,
            self.references,
            self.disturbances,
            self.noises,
            self.which,
            self._vector,
            self._scratch,
            out,
        )

    def reference(self, i: int) -> Array:
        """Reference rows of flight i in its present episode, a view, (n_steps, 9)."""
        return np.asarray(self.references[self.which[0, i]])

    def step(self, actions: NDArray[np.floating], out: NDArray[np.float32]) -> None:
        """Move all flights by one control period and write their observations.

        Args:
            actions: (n, 4) or, for one flight, (4,), contiguous; clipped to [-1, 1], which is counted.
            out: (n, layout.size) or (layout.size,), float32.

        Raises:
            ValueError: If an action is not finite; then no flight has moved.
        """
        bad = _step(*self._before, actions.reshape(-1), *self._after, out.reshape(-1))
        if bad >= 0:
            where = f"[{bad}]" if self.n == 1 else f"[{bad // 4}, {bad % 4}]"
            raise ValueError(
                f"action{where} is {actions.reshape(-1)[bad]}; actions must be finite numbers in [-1, 1]. "
                "The environment has not moved."
            )

    def _start_from(self, options: Mapping[str, Any]) -> Array:
        unknown = sorted(set(options) - {"state"})
        if unknown:
            raise ValueError(f"unknown reset option {unknown[0]!r}; known: 'state' (12 or 16 numbers)")
        return given_plants(options["state"], (), self.task.hover_force)
