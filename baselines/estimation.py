"""The target filter of an agent, fed from its own observation, and the policies whose answer is an estimate.

One extended Kalman filter per row (`controllers.estimation.ekf`), relative to the own vehicle: between two
observations the origin moves by the integral of the own velocity. It begins with the prior of the task and
holds the measurements of the observation, the own one and those that arrive with the messages.

Approximation: displacements are the trapezoid of the observed velocities with the correction of the model's
acceleration at both ends; during a step of the rotor forces it is off by some 0.02 mm per m/s^2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from controllers.estimation.ekf import Restart
from controllers.estimation.trilateration import acceptance_limits
from controllers.estimation.trilateration_kernels import MAX_RATIO
from quad_envs.agent_observations import N_ESTIMATE
from quad_envs.envs.team_kernel import ESTIMATE_REACH, ESTIMATE_SPEED
from quad_envs.parameters import Array
from quad_envs.sensors import sensor_rows
from quad_envs.tasks import TeamTask

from .cooperative_decoding import Decoded, empty_parts, part_starts
from .estimation_kernels import (
    FILTER_SIZE,
    N_REPORT,
    FilterData,
    P,
    X,
    decode_and_filter,
    filter_scratch,
)
from .policy import Actions, Estimates, PolicyState
from .rows import not_finite
from .team_policies import Flags, TeamPolicy, plain_state, require_finite

DEFAULT_Q = {"estimation": 0.02, "target-tracking": 0.05}  # m^2/s^3
_VECH = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # xx, xy, xz, yy, yz, zz


class Filtered(NamedTuple):
    """Rows after a step of their filters."""

    parts: Decoded
    first: Array  # (n, a), what else the memory holds
    filters: Array  # (n, FILTER_SIZE)
    reports: Array  # (n, N_REPORT)
    trilaterates: bool  # whether a position may enter instead of the ranges

    @property
    def estimates(self) -> Estimates:
        """What the filters believe."""
        n, x = len(self.filters), self.filters[:, X]
        covariance = self.filters[:, P].reshape(n, 6, 6).copy()
        counts = self.reports[:, 1:].astype(np.int64)
        nis = self.reports[:, 0].copy()
        fixed = counts[:, 2] > 0 if self.trilaterates else None
        return Estimates(x[:, :3].copy(), x[:, 3:].copy(), covariance, nis, counts[:, 0], counts[:, 1], fixed)


class TargetEstimator:
    """The filters of agents, as a function of their rows and their memory.

    Args:
        task: With a target.
        q: Density of the target's acceleration, m^2/s^3; None: 0.02 for estimation, 0.05 for tracking.
        trilaterate: Whether four or more ranges enter as a trilaterated position.

    Raises:
        ValueError: If the task has no target, or q is negative.
    """

    def __init__(self, task: TeamTask, q: float | None = None, trilaterate: bool = False) -> None:
        if not task.layout.target:
            raise ValueError(
                f"there is no target to estimate in {task.env_id!r} (mission {task.mission!r}); take "
                "quad/TargetTracking-v0 or quad/CooperativeEstimation-v0"
            )
        density = DEFAULT_Q[task.mission] if q is None else q
        if isinstance(density, bool) or not isinstance(density, int | float | np.integer | np.floating):
            raise ValueError(f"q must be a number, m^2/s^3, got {q!r}")
        if not 0.0 <= density < np.inf:
            raise ValueError(f"q must be finite and >= 0 m^2/s^3, got {q!r}")
        self.task, self.q, self.trilaterates = task, float(density), trilaterate
        position, velocity = task.prior_sigma
        prior = Restart(task.prior_velocity, (position,) * 3 + (velocity,) * 3)
        data = FilterData(self.q, task.dt, task.layout.comm_size, MAX_RATIO)
        m, rows = 1 + task.layout.neighbours, sensor_rows(task.sensor)
        self._starts = part_starts(task.layout)
        self._constants = (
            prior.data(),
            np.array(task.sensor_sigma, dtype=np.float64),
            np.int64(rows),
            task.params.coefficients(),
            acceptance_limits(m) if trilaterate else None,
            data,
            np.zeros(m, dtype=np.bool_),
            np.zeros(filter_scratch(m, rows)),
        )

    def step(self, obs: Actions, memory: Array, start: Flags) -> Filtered:
        """Move the filters on.

        Args:
            obs: (n, layout.size) float32.
            memory: (n, a + FILTER_SIZE); the last numbers are the filters'.
            start: (n,) bool, rows that begin an episode.

        Raises:
            ValueError: If an observation is not finite.
        """
        n = len(obs)
        parts = empty_parts(self.task.layout, n)
        first, filters = np.empty((n, memory.shape[1] - FILTER_SIZE)), np.empty((n, FILTER_SIZE))
        reports = np.empty((n, N_REPORT))
        code = decode_and_filter(
            obs, self._starts, start, memory, *parts, first, filters, reports, *self._constants
        )
        if code >= 0:
            raise not_finite(obs, code, self.task.layout.slices)
        return Filtered(parts, first, filters, reports, self.trilaterates)


def shared_estimates(blocks: Array) -> Estimates:
    """The own estimates in the block of the estimate wrapper.

    Args:
        blocks: (n, 13 (1 + K)), or the own ones alone, (n, 13); nan where there is none yet.
    """
    n = len(blocks)
    own = blocks[:, :N_ESTIMATE]
    covariance = np.full((n, 6, 6), np.nan)
    covariance[:, :3, :3] = own[:, 7:][:, _VECH]
    none = np.zeros(n, dtype=np.int64)
    return Estimates(own[:, 1:4].copy(), own[:, 4:7].copy(), covariance, np.full(n, np.nan), none)


def estimate_actions(estimates: Estimates) -> Actions:
    """Estimates as the actions of vehicles on rails, (n, 6), clipped to the reach of the action box."""
    scaled = np.concatenate([estimates.r / ESTIMATE_REACH, estimates.v / ESTIMATE_SPEED], axis=1)
    actions: Actions = np.clip(scaled, -1.0, 1.0).astype(np.float32)
    return actions


class EstimatorPolicy(TeamPolicy):
    """A filter per agent whose estimate is the action.

    Args:
        task: Of the mission "estimation".
        name: For tables.
        q: See `TargetEstimator`.
        trilaterate: See there.
    """

    def __init__(self, task: TeamTask, name: str, q: float | None, trilaterate: bool) -> None:
        super().__init__(task, name, FILTER_SIZE)
        self.estimator = TargetEstimator(task, q, trilaterate)

    def _decide(self, obs: Actions, state: PolicyState, start: Flags) -> tuple[Actions, PolicyState]:
        done = self.estimator.step(obs, state.memory, start)
        estimates, n = done.estimates, len(obs)
        fallbacks = np.where(start[:, None], 0, state.fallbacks)
        fallbacks[:, 0] += 1  # `estimates.modes` tells how each was found
        count = np.zeros(n, dtype=np.int64)
        kept = PolicyState(done.filters, fallbacks, count, count, estimates)
        return estimate_actions(estimates), kept


class EkfPolicy(EstimatorPolicy):
    """One joint update per step with all measurements held, section 6.2.

    Args:
        task: What is known of the scene.
        q: Density of the target's acceleration, m^2/s^3; None: 0.02.
    """

    def __init__(self, task: TeamTask, q: float | None = None) -> None:
        super().__init__(task, "ekf", q, trilaterate=False)


class TrilaterationPolicy(EstimatorPolicy):
    """Trilateration where four ranges, and who measured them, allow it; else the filter, section 6.2.

    A fix enters the filter as a position with covariance sigma^2 (J'J)^-1. `state.estimates.modes` says which
    it was, and `state.fallbacks[:, 1]` counts the steps that took the filter.

    Args:
        task: What is known of the scene.
        q: Density of the target's acceleration, m^2/s^3; None: 0.02.
    """

    def __init__(self, task: TeamTask, q: float | None = None) -> None:
        super().__init__(task, "trilateration", q, trilaterate=True)


class SharedEstimatePolicy(TeamPolicy):
    """The estimate that the estimate wrapper put into the observation is the action.

    Args:
        task: Of the mission "estimation", with the wrapper's layout.
        name: For tables.
    """

    def __init__(self, task: TeamTask, name: str) -> None:
        super().__init__(task, name, 0)
        self._block = task.layout.slices["estimate"]

    def _decide(self, obs: Actions, state: PolicyState, start: Flags) -> tuple[Actions, PolicyState]:
        require_finite(obs, self.task)
        estimates = shared_estimates(obs[:, self._block].astype(np.float64))
        kept = plain_state(state, start, state.memory)._replace(estimates=estimates)
        return estimate_actions(estimates), kept
