"""About how long a suite takes, said before it begins."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from ..training.algorithms import ALGORITHMS
from ..training.held_out import training_options
from ..training.tuning import SECONDS
from .choices import Training
from .progress import said_seconds
from .stages import price
from .suite import Suite
from .units import TrainingUnit, Unit, suite_units, training_units

_JUDGED = 1.25  # evaluations while training or tuning, beside what its budget counts
_STEPS = 200  # of a flight whose environment is one of the user's


class Budget(NamedTuple):
    """CPU-seconds, about."""

    made: int  # networks and controllers
    making: float
    units: int
    flying: float

    def said(self, jobs: int) -> str:
        """In a line."""
        making = f"make {self.made} policies, about {said_seconds(self.making)} of CPU; " if self.made else ""
        whole = said_seconds((self.making + self.flying) / max(1, jobs))
        return (
            f"budget: {making}fly {self.units} units, about {said_seconds(self.flying)} of CPU; with "
            f"{jobs} job{'s' * (jobs != 1)} about {whole}, beside compilation"
        )


def budget_of(suite: Suite) -> Budget:
    """What a suite is going to take on a core of today, if nothing of it is there yet."""
    made, units = training_units(suite), suite_units(suite)
    return Budget(len(made), _JUDGED * sum(map(_making, made)), len(units), _flying(units))


def _making(unit: TrainingUnit) -> float:
    """Of a budget in steps what they take about; where there is none, that of the algorithm."""
    said = unit.made
    if said.seconds is not None:
        return said.seconds
    if not isinstance(said, Training):
        return SECONDS
    algorithm = ALGORITHMS[unit.policy.name]
    return algorithm.seconds if said.steps is None else said.steps / algorithm.steps_per_second


def _flying(units: Sequence[Unit]) -> float:
    steps: dict[str, int] = {}
    for unit in units:
        if unit.env.title not in steps:
            steps[unit.env.title] = _steps(unit)
    return 1e-3 * sum(unit.episodes * steps[unit.env.title] * price(unit) for unit in units)


def _steps(unit: Unit) -> int:
    """Of a flight, times its vehicles."""
    try:
        task = training_options(unit.env.id, unit.env.kwargs).task
    except ValueError:
        return _STEPS
    return int(task.episode_steps) * int(getattr(task, "vehicles", 1))
