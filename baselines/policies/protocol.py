"""The policy protocol, which is Stable-Baselines3's `predict`, and what policies carry from step to step."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

Actions = NDArray[np.float32]
Counts = NDArray[np.int64]

N_FALLBACKS = 5  # members of controllers.fallback.Fallback


class Estimates(NamedTuple):
    """What a policy believes of the target, one row per vehicle.

    Of an estimate from the estimate wrapper only the position's covariance is known: the rest of P is nan.
    """

    r: NDArray[np.float64]  # (n, 3), position relative to the own vehicle, m
    v: NDArray[np.float64]  # (n, 3), m/s
    P: NDArray[np.float64]  # (n, 6, 6), covariance of [r; v]
    nis: NDArray[np.float64]  # (n,), normalised innovation squared of the last update; nan without one
    rows: Counts  # (n,), numbers in the measurements of the last update; 0: none
    measurements: Counts | None = None  # (n,), measurements held at the last update
    trilaterated: NDArray[np.bool_] | None = None  # (n,), whether they entered as a trilaterated position

    @property
    def modes(self) -> tuple[str, ...]:
        """How each row was updated: "trilateration", or "EKF,m" with m measurements."""
        held = self.rows if self.measurements is None else self.measurements
        fixed = np.zeros(len(held), np.bool_) if self.trilaterated is None else self.trilaterated
        return tuple(
            "trilateration" if fix else f"EKF,{m}" for fix, m in zip(fixed, held.tolist(), strict=True)
        )


class Interventions(NamedTuple):
    """What a safety filter did in this episode, one row per vehicle."""

    changed: Counts  # (n,), commands that it changed, those without an answer among them
    total: NDArray[np.float64]  # (n,), N, sum of the largest change of a rotor in each of these
    unanswered: Counts  # (n,), commands that were not finite, and became the MPC's


class PolicyState(NamedTuple):
    """What a policy carries from step to step, one row per vehicle. Callers pass it on, or read it."""

    memory: NDArray[np.float64]  # (n, memory_size), opaque: warm starts, filters
    fallbacks: Counts  # (n, 5), how the commands of this episode were found, by controllers.fallback.Fallback
    iterations: Counts  # (n,), solver iterations of the last decision
    worst_iterations: Counts  # (n,), most iterations of a decision in this episode
    estimates: Estimates | None = None  # of policies that estimate a target
    left_model: Counts | None = None  # (n,), decisions of this episode outside their model; None: none
    interventions: Interventions | None = None  # of safety filters
    behind: Any = None  # state of the policy behind a safety filter


@runtime_checkable
class Policy(Protocol):
    """Observations in, actions out, for any number of vehicles at once.

    Rows are treated independently and nothing is remembered in attributes: what a policy knows of an episode
    travels in `state`. `check_policy` tests all of this. One from outside this suite that keeps to it may say
    `independent_rows = True`: then it is given the observations of many flights at once.
    """

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, Any]:
        """Choose actions.

        Args:
            observation: (n, d), or (d,) for one vehicle.
            state: What the previous call returned; None at the beginning.
            episode_start: (n,) bool, rows that begin an episode; None for none (or all, when state is None).
            deterministic: False lets a stochastic policy draw; the controllers ignore it.

        Returns:
            Actions (n, a) float32 in [-1, 1], or (a,) for an observation (d,), and the state to pass on; a is
            4 for one vehicle and `task.action_size` for a team.

        Raises:
            ValueError: If a shape is wrong, or a number of any row is not finite: then no row is decided.
        """
        ...
