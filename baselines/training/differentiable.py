"""What the analytic policy gradient asks of flights, of single vehicles and of teams alike."""

from __future__ import annotations

from typing import Protocol, TypeVar

from quad_envs.observations.features import Features
from quad_envs.plant import Array
from quad_envs.tasks import BaseTask

from .flights import Bools, Floats


class Step(Protocol):
    """One step of all flights, as far as the learner reads it."""

    @property
    def rewards(self) -> Array:
        """Of each row, (n,)."""

    @property
    def crashed(self) -> Bools:
        """Rows whose reward leads nowhere, (n,)."""


S = TypeVar("S", bound=Step)


class Flights(Protocol[S]):
    """Flights, or teams, as a differentiable function of the actions of n vehicles."""

    @property
    def n(self) -> int:
        """Number of vehicles."""

    @property
    def task(self) -> BaseTask:
        """What is flown."""

    @property
    def features(self) -> Features:
        """What the network sees."""

    def begin_window(self, n_steps: int) -> None:
        """A window follows, of n_steps."""

    def observe(self) -> Floats:
        """Scaled features as they are, (n, features)."""

    def advance(self, actions: Floats) -> S:
        """One step; flights that end begin anew."""

    def advance_vjp(
        self, step: S, bar_after: Array, bar_commands: Array, bar_rewards: Array, bar_cost: float, /
    ) -> tuple[Array, Array, Array]:
        """Sensitivities to actions, plants and commands before, from those to what `advance` gives."""

    def observe_vjp(self, step: S, bar: Floats, /) -> tuple[Array, Array]:
        """Sensitivities to plants and last commands before a step, from those to what was seen."""
