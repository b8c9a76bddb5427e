"""Tracking flights as a differentiable function of the actions.

The forward pass is the environments' compiled step: resets, disturbances, sensor noise and other vehicles
included. The backward pass is its adjoint, in which disturbances and errors of sensors are given. A flight
that ends begins anew in the same step, and no gradient passes through that.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_envs.arguments.names import shown
from quad_envs.envs.shared.adjoint import SCRATCH_ROWS
from quad_envs.envs.shared.task_vector import task_vector
from quad_envs.envs.tracking.adjoint import TrackingRecord, action_slopes, tracking_vjp_rows
from quad_envs.envs.tracking.batch import TrackingBatch
from quad_envs.envs.tracking.options import TrackingOptions
from quad_envs.envs.tracking.scores import scores_of
from quad_envs.lanes import COEFFICIENTS, COMMAND, FORCE_MAX, N_PLANT, PLANT, STEP
from quad_envs.observations.features import Features, preview_stages
from quad_envs.observations.tracking import N_OWN, N_REFERENCE
from quad_envs.parameters import N_COEFFICIENTS
from quad_envs.plant import N_INPUT, Array
from quad_envs.wrappers.encoding import Encoding

from .features import training_features
from .observer import Observer

Bools = NDArray[np.bool_]
Floats = NDArray[np.float32]
_YAW = slice(5, 7)  # sine and cosine of it in an observation
_HEADING = 6  # likewise of the reference in a stage of the preview


class TrackingStep(NamedTuple):
    """One step of all flights, as far as its adjoint needs it."""

    record: TrackingRecord
    slopes: Array  # (n, 4), of the commands by the actions
    rewards: Array  # (n,)
    crashed: Bools  # (n,)
    done: Bools  # (n,), flights that began anew
    axes: Floats  # (n, 2), sine and cosine of the angle by which the observation before was turned
    yaw: Floats  # (n, 2), of the yaw in it


class DifferentiableFlights:
    """n flights of a tracking task, from starts of the environment, at all times of the episode.

    Args:
        options: Of the task; its reward must be the bounded one.
        n: Number of flights.
        seed: Of the starts.
        features: That a network sees: the default ones of `training_features`, with what it may add to them.
            No gradient passes through an estimate of the disturbance.

    Raises:
        ValueError: If the task cannot be differentiated.
    """

    def __init__(self, options: TrackingOptions, n: int, seed: int, features: Features | None = None) -> None:
        if options.reward != "bounded":
            raise ValueError(
                f"the analytic policy gradient needs reward='bounded', got {shown(options.reward)}"
            )
        self.batch, self.n, self.rng = TrackingBatch(options, n), n, np.random.default_rng(seed)
        self.task = self.batch.task
        self.features = training_features(options) if features is None else features
        self._observer = Observer(Encoding(self.features), self.task, n)
        self._vector = task_vector(self.task, options.substeps, options.lost_distance)
        self._scratch = np.zeros((SCRATCH_ROWS + 4, 16))
        self._out = np.empty((n, self.task.layout.size), dtype=np.float32)
        # The first episodes are cut at random, so that the flights are at all times of the episode.
        self._cut = self.rng.integers(1, self.task.episode_steps + 1, n)
        self._told = self.batch.fresh_scores()
        self._begin(np.arange(n))
        self._seen = self._observer.see(self._out, np.ones(n, dtype=np.bool_))

    def _begin(self, index: NDArray[np.int64]) -> None:
        self.batch.begin(index, [self.rng] * len(index), self._out.reshape(-1), self._told)

    def observe(self) -> Floats:
        """Scaled features of all flights as they are, (n, features)."""
        return self._seen

    def begin_window(self, n_steps: int) -> None:
        """A window of n_steps follows; observations reach back to no earlier step."""

    def observe_vjp(self, step: TrackingStep, bar: Floats) -> tuple[Array, Array]:
        """Sensitivities to plants (n, 16) and last commands (n, 4) before a step, from those to `observe`."""
        layout, full = self.task.layout, bar / np.asarray(self.features.scale)
        out, at = np.zeros((self.n, 16)), N_OWN
        out[:, 3:8] = full[:, :5]
        out[:, 8] = full[:, 5] * step.yaw[:, 1] - full[:, 6] * step.yaw[:, 0]
        out[:, 9:16] = full[:, 7:14]
        if layout.position:
            out[:, :3] += full[:, at : at + 3]
        start = layout.preview_start
        stages = preview_stages(layout.preview)
        preview = full[:, start : start + N_REFERENCE * len(stages)].reshape(self.n, -1, N_REFERENCE)
        x, y, z = preview[:, :, :3].sum(axis=1).T
        sine, cosine = step.axes.T
        out[:, :3] -= np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=1)
        return out, full[:, 14:18]

    def _axes_and_yaw(self) -> tuple[Floats, Floats]:
        """Sines and cosines of what turns observations as they are, and of the yaw in them, (n, 2) each."""
        sine, cosine = self._out[:, _YAW].T
        start = self.task.layout.preview_start + _HEADING
        axes = (
            self._out[:, start : start + 2].copy()
            if self.features.heading_axes
            else np.zeros((self.n, 2), np.float32)
        )
        if not self.features.heading_axes:
            axes[:, 1] = 1.0
        s, c = axes.T
        return axes, np.stack([sine * c - cosine * s, cosine * c + sine * s], axis=1)

    def advance(self, actions: Floats) -> TrackingStep:
        """One step of all flights; those that end begin anew."""
        vehicles, references = self.batch.vehicles, self.batch.references
        plants, previous = vehicles.read(PLANT, N_PLANT), vehicles.read(COMMAND, N_INPUT)
        axes, yaw, disturbances = *self._axes_and_yaw(), self.batch.coming_disturbances()
        self.batch.step(np.ascontiguousarray(actions).reshape(-1), self._out.reshape(-1), self._told)
        scores = scores_of(self._told.copy())
        slopes = np.empty((self.n, 4))
        action_slopes(actions, self._vector, slopes)
        steps = np.minimum(vehicles.read(STEP).astype(np.int64), references.shape[1] - 1)
        self._cut -= 1
        done = scores.crashed | scores.truncated | (self._cut == 0)
        record = TrackingRecord(
            plants=plants,
            commands=vehicles.read(COMMAND, N_INPUT),
            previous=previous,
            after=vehicles.read(PLANT, N_PLANT),
            references=references[self.batch.which[0], steps],
            crashed=scores.crashed,
            force_max=vehicles.read(FORCE_MAX, N_INPUT),
            coefficients=vehicles.read(COEFFICIENTS, N_COEFFICIENTS),
            disturbances=disturbances,
        )
        if done.any():
            self._begin(np.flatnonzero(done))
        self._seen = self._observer.see(self._out, done)
        return TrackingStep(record, slopes, scores.reward, scores.crashed, done, axes, yaw)

    def advance_vjp(
        self,
        step: TrackingStep,
        bar_after: Array,
        bar_commands: Array,
        bar_rewards: Array,
        bar_cost: float = 0.0,
    ) -> tuple[Array, Array, Array]:
        """Adjoint of `advance`.

        Args:
            step: It.
            bar_after: Sensitivity to the plants afterwards, (n, 16).
            bar_commands: To the commands, as the next observation shows them, (n, 4).
            bar_rewards: To the rewards, (n,).
            bar_cost: To the violation cost of each flight.

        Returns:
            Sensitivities to the actions (n, 4), the plants (n, 16) and the commands before (n, 4).
        """
        flew_on = ~step.done[:, None]
        plants, commands, previous = np.empty((self.n, 16)), np.empty((self.n, 4)), np.empty((self.n, 4))
        tracking_vjp_rows(
            step.record, self._vector, bar_after * flew_on, bar_rewards, np.float64(bar_cost),
            plants, commands, previous,
            self._scratch,
        )  # fmt: skip
        return (commands + bar_commands * flew_on) * step.slopes, plants, previous
