"""Any `controllers.estimation.Estimator`, the user's or one of ours, as the filters of agents."""

from __future__ import annotations

from typing import Any

import numpy as np

from controllers.estimation import Estimator, Measurements, Prior, ekf
from quad_envs.arguments.names import shown
from quad_envs.observations.team import N_MEASURED
from quad_envs.parameters import Array
from quad_envs.sensors import N_MEASUREMENT, sensor_rows
from quad_envs.tasks import TeamTask

from .decoding import decode_rows, empty_parts, part_starts, split_memory
from .estimation_kernels import FILTER_SIZE, N_REPORT, STAGE, FilterData, P, X, gather_rows
from .filtered import Filtered
from .protocol import Actions
from .row_policy import Flags
from .rows import not_finite

_MEMBERS = ("begin", "predict", "update", "mean", "covariance")


class OwnEstimator:
    """The filters of agents, as a function of their rows and their memory, by a given estimator.

    The memory of an agent is laid out as that of `TargetEstimator` (with mean and covariance as the estimator
    last said them), followed by the estimator's own numbers.

    Args:
        task: With a target.
        estimator: What filters.
        q: Density with which estimates that are under way to others move on, m^2/s^3.

    Raises:
        ValueError: If the estimator lacks a member.
    """

    trilaterates = False

    def __init__(self, task: TeamTask, estimator: Estimator, q: float) -> None:
        missing = [name for name in _MEMBERS if not callable(getattr(estimator, name, None))]
        size = getattr(estimator, "size", None)
        if missing or not isinstance(size, int | np.integer) or size < 0:
            what = ", ".join(missing) if missing else f"a whole number `size` >= 0 (got {shown(size)})"
            raise ValueError(
                f"{estimator!r} is no estimator: it lacks {what}; see controllers.estimation.Estimator"
            )
        self.task, self.estimator, self.q = task, estimator, q
        self.size = FILTER_SIZE + int(size)
        self._starts = part_starts(task.layout)
        self._data = FilterData(q, task.dt, task.layout.comm_size, 0.0)
        self._coefficients = task.params.coefficients()
        self._sigma, self._rows = np.array(task.sensor_sigma, dtype=np.float64), sensor_rows(task.sensor)

    @property
    def can_fuse(self) -> bool:
        """Whether fused estimates can be given back."""
        return callable(getattr(self.estimator, "replaced", None))

    def step(self, obs: Actions, memory: Array, start: Flags) -> Filtered:
        """Move the filters on; see `TargetEstimator.step`.

        Raises:
            ValueError: If an observation is not finite, or the estimator returns what it may not.
        """
        n, m = len(obs), 1 + self.task.layout.neighbours
        parts = empty_parts(self.task.layout, n)
        code = decode_rows(obs, self._starts, *parts)
        if code >= 0:
            raise not_finite(obs, code, self.task.layout.slices)
        first, filters = np.empty((n, memory.shape[1] - self.size)), np.empty((n, self.size))
        split_memory(memory, start, first, filters)
        way, z, place = np.empty((n, 3)), np.empty((n, m, N_MEASUREMENT)), np.empty((n, m, 3))
        age, valid, held = np.empty((n, m)), np.empty((n, m), np.bool_), np.empty(n, np.int64)
        assert parts.measured.shape[1] == m * N_MEASURED
        gather_rows(
            parts.plant, parts.disturbance, parts.comm, parts.measured, filters, self._coefficients,
            self._data, way, z, place, age, valid, held, np.empty(6),
        )  # fmt: skip
        own = self._moved_on(filters, parts.slot, way)
        predicted = self._believed(own)
        given = Measurements(z, place, age, valid, self._sigma, self._rows)
        _, said = ekf.update(predicted, given, restart=None)
        own = self._memory("update", self.estimator.update(own, given), n)
        x, covariance = self._believed(own)
        filters[:, STAGE] = 1.0
        filters[:, X], filters[:, P], filters[:, FILTER_SIZE:] = x, covariance.reshape(n, -1), own
        reports = np.zeros((n, N_REPORT))
        reports[:, 0] = np.where(said.rows > 0, said.nis, np.nan)
        reports[:, 1], reports[:, 2] = said.rows, held
        return Filtered(parts, first, filters, reports, False)

    def take_over(self, filters: Array) -> Array:
        """The memories after their mean and covariance were fused with what others sent."""
        n, out = len(filters), filters.copy()
        replaced = getattr(self.estimator, "replaced")  # noqa: B009  optional, not in the protocol
        new = replaced(filters[:, FILTER_SIZE:], filters[:, X], filters[:, P].reshape(n, 6, 6))
        out[:, FILTER_SIZE:] = self._memory("replaced", new, n)
        return out

    def _moved_on(self, filters: Array, slots: Array, way: Array) -> Array:
        """The estimators' memories at the present step: begun, or predicted."""
        own = filters[:, FILTER_SIZE:].copy()
        new = filters[:, STAGE] == 0.0
        if new.any():
            velocity = np.array(self.task.prior_velocity, dtype=np.float64)
            prior = Prior(-slots[new], velocity, np.array(self.task.prior_sigma, dtype=np.float64))
            own[new] = self._memory("begin", self.estimator.begin(prior), int(new.sum()))
        if not new.all():
            later = self.estimator.predict(own[~new], self.task.dt, way[~new])
            own[~new] = self._memory("predict", later, int((~new).sum()))
        return own

    def _memory(self, member: str, value: Any, n: int) -> Array:
        return self._checked(member, value, (n, self.size - FILTER_SIZE))

    def _believed(self, own: Array) -> ekf.TargetFilter:
        n = len(own)
        x = self._checked("mean", self.estimator.mean(own), (n, 6))
        return ekf.TargetFilter(x, self._checked("covariance", self.estimator.covariance(own), (n, 6, 6)))

    def _checked(self, member: str, value: Any, shape: tuple[int, ...]) -> Array:
        """The value of a member, as the protocol wants it."""
        array = np.asarray(value, dtype=np.float64)
        if array.shape != shape or not np.isfinite(array).all():
            what = f"shape {array.shape}" if array.shape != shape else "numbers that are not finite"
            raise ValueError(
                f"{member} of the estimator {self.estimator!r} must return finite numbers of shape {shape}, "
                f"got {what}"
            )
        return array
