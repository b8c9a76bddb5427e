"""The target filter of an agent, fed from its own observation, and the policies whose answer is an estimate.

One extended Kalman filter per row (`controllers.estimation.ekf`), relative to the own vehicle: between two
observations the origin moves by the integral of the own velocity. It begins with the prior of the task and
holds the measurements of the observation, the own one and those that arrive with the messages.

Approximation: displacements are the trapezoid of the observed velocities with the correction of the model's
acceleration at both ends; during a step of the rotor forces it is off by some 0.02 mm per m/s^2.
"""

from __future__ import annotations

from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from controllers.estimation import PolarEstimator, RandomWalkEstimator
from controllers.estimation.ekf import Restart
from controllers.estimation.trilateration import acceptance_limits
from controllers.estimation.trilateration_kernels import MAX_RATIO
from quad_envs.arguments.names import shown, unknown_name
from quad_envs.envs.team.kernel import ESTIMATE_REACH, ESTIMATE_SPEED
from quad_envs.observations.team import N_ESTIMATE
from quad_envs.parameters import Array
from quad_envs.sensors import RANGE, reads, sensor_rows
from quad_envs.tasks import TeamTask

from .decoding import empty_parts, part_starts
from .estimation_kernels import (
    FILTER_SIZE,
    N_REPORT,
    FilterData,
    decode_and_filter,
    filter_scratch,
)
from .filtered import Filtered
from .own_estimator import OwnEstimator
from .protocol import Actions, Estimates, PolicyState
from .row_policy import Flags
from .rows import not_finite
from .team import TeamPolicy, plain_state, require_finite

DEFAULT_Q = {"estimation": 0.02, "target-tracking": 0.05}  # m^2/s^3
EstimatorName = Literal["ekf", "trilateration", "polar-ekf", "random-walk"]
Model = Literal["cv", "aircraft", "random-walk"]
_MODELS: dict[str, EstimatorName] = {"cv": "ekf", "aircraft": "polar-ekf", "random-walk": "random-walk"}
_VECH = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # xx, xy, xz, yy, yz, zz


class TargetEstimator:
    """The filters of agents, as a function of their rows and their memory.

    Args:
        task: With a target.
        q: Density of the target's acceleration, m^2/s^3; None: 0.02 for estimation, 0.05 for tracking.
        trilaterate: Whether four or more ranges enter as a trilaterated position.

    Raises:
        ValueError: If the task has no target, or q is negative.
    """

    size = FILTER_SIZE  # numbers in the memory of an agent
    can_fuse = True

    def __init__(self, task: TeamTask, q: float | None = None, trilaterate: bool = False) -> None:
        require_target(task)
        density = density_of(task, q)
        self.task, self.q, self.trilaterates = task, density, trilaterate
        position, velocity = task.prior_sigma
        prior = Restart(task.prior_velocity, (position,) * 3 + (velocity,) * 3)
        data = FilterData(self.q, task.dt, task.layout.comm_size, MAX_RATIO)
        m, rows = 1 + task.layout.neighbours, sensor_rows(task.sensor)
        if trilaterate and not reads(rows, RANGE):
            raise ValueError(
                f"trilateration needs ranges, which the sensor {task.sensor!r} does not read: take "
                "estimator='ekf', or an environment with sensor='range'"
            )
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

    def take_over(self, filters: Array) -> Array:
        """The memories after their mean and covariance were fused: nothing else depends on them."""
        return filters


AgentFilters: TypeAlias = TargetEstimator | OwnEstimator


def require_target(task: TeamTask) -> None:
    """Check that there is something to estimate.

    Raises:
        ValueError: If there is not.
    """
    if not task.layout.target:
        raise ValueError(
            f"there is no target to estimate in {task.env_id!r} (mission {task.mission!r}); take "
            "quad/TargetTracking-v0 or quad/CooperativeEstimation-v0"
        )


def density_of(task: TeamTask, q: Any) -> float:
    """The density of the target's acceleration, m^2/s^3; None: that of the mission.

    Raises:
        ValueError: If it is not a finite number >= 0.
    """
    density = DEFAULT_Q[task.mission] if q is None else q
    if isinstance(density, bool) or not isinstance(density, int | float | np.integer | np.floating):
        raise ValueError(f"q must be a number, m^2/s^3, got {shown(q)}")
    if not 0.0 <= density < np.inf:
        raise ValueError(f"q must be finite and >= 0 m^2/s^3, got {shown(q)}")
    return float(density)


def make_estimator(task: TeamTask, estimator: Any = None, q: Any = None) -> AgentFilters:
    """The filters of agents.

    Args:
        task: With a target.
        estimator: "ekf" (None), "trilateration", "polar-ekf" (a point mass of constant speed, climb and
            course), "random-walk" (the text's three states), or an object with the members of
            `controllers.estimation.Estimator`.
        q: Of the target's motion; None for the usual: a density of its acceleration, m^2/s^3; for "polar-ekf"
            three, of V', gamma' and chi'; for "random-walk" one of its velocity, m^2/s.

    Raises:
        ValueError: If the task has no target, there is no such estimator, or q does not belong to it.
    """
    require_target(task)
    if estimator is None or estimator in ("ekf", "trilateration"):
        return TargetEstimator(task, q, trilaterate=estimator == "trilateration")
    usual = density_of(task, None)
    if estimator == "polar-ekf":
        if q is not None and np.shape(q) != (3,):
            raise ValueError(
                f"q of 'polar-ekf' must be three densities, of V', gamma' and chi', got {shown(q)}"
            )
        return OwnEstimator(task, PolarEstimator() if q is None else PolarEstimator(tuple(q)), usual)
    if estimator == "random-walk":
        return OwnEstimator(task, RandomWalkEstimator() if q is None else RandomWalkEstimator(q), usual)
    if isinstance(estimator, str):
        raise ValueError(f"{unknown_name('estimator', estimator, get_args(EstimatorName))}, or an object")
    if q is not None:
        raise ValueError(f"q = {q!r} belongs to the named estimators: give it to {estimator!r} itself")
    return OwnEstimator(task, estimator, usual)


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
        estimator: See `make_estimator`.
        q: See there.
    """

    def __init__(self, task: TeamTask, name: str, estimator: Any, q: Any) -> None:
        self.estimator = make_estimator(task, estimator, q)
        super().__init__(task, name, self.estimator.size)

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
        q: Of the target's motion, see `make_estimator`; None: 0.02 m^2/s^3 with the model "cv".
        model: Of the target: "cv" (constant velocity), "aircraft" (a point mass of constant speed, climb and
            course, 6.2.2), "random-walk" (the three states of 6.2.1).

    Raises:
        ValueError: If there is no such model, or q does not belong to it.
    """

    def __init__(self, task: TeamTask, q: Any = None, *, model: Model = "cv") -> None:
        if model not in _MODELS:
            raise ValueError(unknown_name("model", model, _MODELS))
        super().__init__(task, "ekf", _MODELS[model], q)


class TrilaterationPolicy(EstimatorPolicy):
    """Trilateration where four ranges, and who measured them, allow it; else the filter, section 6.2.

    A fix enters the filter as a position with covariance sigma^2 (J'J)^-1. `state.estimates.modes` says which
    it was, and `state.fallbacks[:, 1]` counts the steps that took the filter.

    Args:
        task: What is known of the scene.
        q: Density of the target's acceleration, m^2/s^3; None: 0.02.
    """

    def __init__(self, task: TeamTask, q: float | None = None) -> None:
        super().__init__(task, "trilateration", "trilateration", q)


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
