"""What training is judged by: the reward, from starts that training never sees, in all flights at once.

Environment seeds from 10 000 on are held out. Those from 20 000 on choose the best policy while training, so
that those from 10 000 to 19 999 stay untouched for comparisons.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping
from importlib import import_module
from typing import Any, NamedTuple, TypeAlias

import gymnasium
import numpy as np

from quad_envs.arguments.names import unknown_name
from quad_envs.registration import ENTRY, TEAMS, TRACKING, VECTOR_ENTRY

from ..evaluation.columns import renamed
from ..evaluation.evaluate import Evaluation, fly_and_measure
from ..policies.network import Network
from ..policies.network_policies import network_policy
from ..policies.outside import import_named
from ..policies.protocol import Policy

HELD_OUT = 10_000  # the first environment seed that training must not use
CHOOSING = 20_000  # the first of those that choose the best policy
_FLIGHTS, _TEAM_FLIGHTS = 20, 5


class Progress(NamedTuple):
    """How far a training is."""

    update: int
    steps: int
    reward: float  # mean of the last update, as the algorithm saw it; nan if not known


Training: TypeAlias = Generator[tuple[Progress, Network], None, None]  # after each update, what flies by now


class Point(NamedTuple):
    """A row of the learning curve."""

    cpu_seconds: float
    steps: int
    updates: int
    score: float  # mean over the held-out flights
    quadratic_cost: float  # mean over the flights; nan if one crashed
    violation_share: float  # of the steps
    crashes: int  # flights (of a team: vehicles) that crashed
    flights: int
    training_reward: float  # mean of the last update, as the algorithm saw it


def read_point(stored: Mapping[str, Any]) -> Point:
    """A row as JSON or CSV stored it: nan, the cost of a flight that crashed, is null or empty there.

    Raises:
        KeyError, TypeError, ValueError: If a field is missing or is no number.
    """
    known = renamed(stored)
    values = {name: math.nan if known[name] in (None, "") else float(known[name]) for name in Point._fields}
    whole: dict[str, Any] = {name: int(values[name]) for name in _WHOLE}
    return Point(**{**values, **whole})


_WHOLE = ("steps", "updates", "crashes", "flights")  # fields of a Point that are whole numbers


def training_options(env_id: str, env_kwargs: Mapping[str, Any]) -> Any:
    """The options of an environment as a value, from its id and keyword arguments.

    Raises:
        ValueError: If the id or an argument is unknown or not allowed.
    """
    name = env_id.removeprefix("quad_envs:")
    try:
        if name in TEAMS:
            return import_module(TEAMS[name]).raw_env.options_type.from_kwargs(env_kwargs)
        from quad_envs.envs.tracking.options import TrackingOptions

        if name in TRACKING:
            return TrackingOptions.from_kwargs({"env_id": name, **TRACKING[name], **env_kwargs})
        if ":" in name:
            return TrackingOptions.from_kwargs({**_registered(name), **env_kwargs})
    except TypeError as error:
        raise ValueError(str(error)) from error
    raise ValueError(unknown_name("environment id", env_id, [*TRACKING, *TEAMS]))


def _registered(env_id: str) -> dict[str, Any]:
    """Arguments with which a module of the user's registers a task of this suite, by `module:id`.

    Raises:
        ValueError: If it registers no such id, or another kind of environment.
    """
    module, _, name = env_id.rpartition(":")
    import_named(module, f"environment {env_id!r}")
    if name not in gymnasium.registry:
        raise ValueError(unknown_name("environment id", env_id, [*TRACKING, *TEAMS]))
    spec = gymnasium.registry[name]
    if (spec.entry_point, spec.vector_entry_point) != (ENTRY, VECTOR_ENTRY):
        raise ValueError(
            f"{env_id!r} cannot be trained in: it must be registered with the entry_point {ENTRY!r} and the "
            f"vector_entry_point {VECTOR_ENTRY!r}"
        )
    return {"env_id": name, **spec.kwargs}


class HeldOutFlights:
    """Flights from held-out starts, of one task; `flights` of them, or those that judge while training."""

    def __init__(self, env_id: str, env_kwargs: Mapping[str, Any], flights: int | None = None) -> None:
        name = env_id.removeprefix("quad_envs:")
        self.flights = flights or (_TEAM_FLIGHTS if name in TEAMS else _FLIGHTS)
        if name in TEAMS:
            self.env: Any = import_module(TEAMS[name]).vector_env(self.flights, **env_kwargs)
        else:
            self.env = gymnasium.make_vec(name, num_envs=self.flights, **env_kwargs)
        self.task = self.env.unwrapped.task

    def judge(self, network: Network, cpu_seconds: float, progress: Progress, seed: int = CHOOSING) -> Point:
        """Fly a network, see `judge_policy`."""
        policy = network_policy(network, self.task, "training")
        return self.judge_policy(policy, cpu_seconds, progress, seed)

    def fly(self, policy: Policy, seed: int) -> Evaluation:
        """Fly a policy from the starts of these seeds, the first of which is given."""
        return fly_and_measure(policy, self.env, self.flights, seed)

    def judge_policy(
        self, policy: Policy, cpu_seconds: float, progress: Progress, seed: int = CHOOSING
    ) -> Point:
        """Fly a policy.

        Args:
            policy: It.
            cpu_seconds: That its training has taken.
            progress: Of its training.
            seed: Environment seed of the first flight.
        """
        found = self.fly(policy, seed)
        summary = found.summary()
        return Point(
            cpu_seconds=cpu_seconds,
            steps=progress.steps,
            updates=progress.update,
            score=summary["score"].mean,
            quadratic_cost=summary["quadratic_cost"].mean,
            violation_share=summary["violation_share"].mean,
            crashes=int(np.sum([record.crashed for record in found.records])),
            flights=len(found.records),
            training_reward=progress.reward,
        )


def better(point: Point, best: Point | None, limit: float | None = None) -> bool:
    """Whether a policy is better: the higher score, among those under the limit of violating steps if any.

    A flight that crashed counts as one that violated throughout: it has fewer steps to violate in.
    """
    if best is None:
        return True
    if limit is not None:
        over, over_best = (
            max(0.0, one.violation_share + one.crashes / one.flights - limit) for one in (point, best)
        )
        if over != over_best:
            return over < over_best
    return point.score > best.score
