"""The policy protocol, which is Stable-Baselines3's `predict`, and the names that `make_policy` knows."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from importlib import import_module
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_envs.names import unknown_name

Actions = NDArray[np.float32]
Counts = NDArray[np.int64]

N_FALLBACKS = 5  # members of controllers.fallback.Fallback


class Estimates(NamedTuple):
    """What a policy believes of the target, one row per vehicle."""

    r: NDArray[np.float64]  # (n, 3), position relative to the own vehicle, m
    v: NDArray[np.float64]  # (n, 3), m/s
    P: NDArray[np.float64]  # (n, 6, 6), covariance of [r; v]
    nis: NDArray[np.float64]  # (n,), normalised innovation squared of the last update; nan without one
    rows: Counts  # (n,), numbers in the measurements of the last update; 0: none


class PolicyState(NamedTuple):
    """What a policy carries from step to step, one row per vehicle. Callers pass it on, or read it."""

    memory: NDArray[np.float64]  # (n, memory_size), opaque: warm starts, filters
    fallbacks: Counts  # (n, 5), how the commands of this episode were found, by controllers.fallback.Fallback
    iterations: Counts  # (n,), solver iterations of the last decision
    worst_iterations: Counts  # (n,), most iterations of a decision in this episode
    estimates: Estimates | None = None  # of policies that estimate a target


@runtime_checkable
class Policy(Protocol):
    """Observations in, actions out, for any number of vehicles at once.

    Rows are treated independently and nothing is remembered in attributes: what a policy knows of an episode
    travels in `state`. `check_policy` tests all of this.
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
            Actions (n, 4) float32 in [-1, 1], or (4,) for an observation (d,), and the state to pass on.
        """
        ...


class PolicyEntry(NamedTuple):
    """A row of the registry."""

    module: str
    factory: str  # name in the module: called with the task and the options
    description: str


# Names that `make_policy` knows for tracking tasks.
TRACKING_POLICIES: dict[str, PolicyEntry] = {
    "lmpc": PolicyEntry("controllers", "LinearMPC", "linear MPC on the hover model (chapter 3)"),
    "sdc-nmpc": PolicyEntry("controllers", "SdcNmpc", "MPC on the state-dependent model (chapter 4)"),
    "nmpc": PolicyEntry("controllers", "ExactNmpc", "MPC on the exact model: real-time iteration, or SQP"),
    "sdre": PolicyEntry("controllers", "Sdre", "state-dependent Riccati feedback, without preview"),
    "lqr": PolicyEntry("controllers", "Lqr", "constant feedback of the hover model, without preview"),
    "feedback-linearization": PolicyEntry(
        "controllers", "FeedbackLinearization", "feedback linearization with an attitude loop"
    ),
    "hover": PolicyEntry("baselines.tracking", "Hover", "hover thrust, whatever happens"),
    "random": PolicyEntry("baselines.tracking", "Random", "uniform random actions"),
}


def _factory(name: str) -> Callable[..., Any]:
    if name not in TRACKING_POLICIES:
        raise ValueError(unknown_name("policy", name, TRACKING_POLICIES))
    entry = TRACKING_POLICIES[name]
    found: Callable[..., Any] = getattr(import_module(entry.module), entry.factory)
    return found


def policy_options(name: str) -> dict[str, Any]:
    """Options of a policy and their defaults.

    Raises:
        ValueError: If the name is unknown.
    """
    parameters = list(inspect.signature(_factory(name)).parameters.values())[1:]  # the first is the task
    return {parameter.name: parameter.default for parameter in parameters}


def _check_kind(name: str, option: str, value: Any, default: Any) -> None:
    """Refuse a word for a number and the like; whether the number is allowed, the controller knows."""
    if isinstance(default, bool):
        kind, fits = "True or False", isinstance(value, bool | np.bool_)
    elif isinstance(default, int | float):
        fits = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
        kind = "a number"
    elif isinstance(default, str):
        kind, fits = "a name", isinstance(value, str)
    else:
        return
    if not fits:
        raise ValueError(f"{option} of policy {name!r} must be {kind}, got {value!r} (default {default!r})")


def make_policy(name: str, env: Any, **options: Any) -> Policy:
    """A policy for a task.

    Args:
        name: One of TRACKING_POLICIES.
        env: An environment (wrapped or not), a vector environment, an id, or a Task. Only its Task is used.
        options: Of the policy, see `policy_options`; MPCs take `horizon`, `solver` and what their chapter
            offers. A horizon that is not given is 25, or the preview of the task where that is shorter.
            Feedback linearization uses the acceleration of the reference where there is a preview.

    Raises:
        ValueError: If the name, an option or its value is not allowed, or the horizon exceeds the preview.
    """
    from .environments import task_of
    from .tracking import ControllerPolicy

    factory, defaults = _factory(name), policy_options(name)
    for option in options:
        if option not in defaults:
            raise ValueError(unknown_name(f"option of policy {name!r}:", option, defaults))
        _check_kind(name, option, options[option], defaults[option])
    task = task_of(env)
    preview = task.layout.preview
    if "horizon" in defaults:
        options.setdefault("horizon", min(defaults["horizon"], preview))
    if "acceleration_feed_forward" in defaults:
        options.setdefault("acceleration_feed_forward", defaults["acceleration_feed_forward"] and preview > 0)
    try:
        controller = factory(task, **options)
    except TypeError as error:
        raise ValueError(f"policy {name!r} refused its options {options}: {error}") from error
    if controller.horizon > preview:
        remedy = f"horizon <= {preview}" if "horizon" in defaults else "acceleration_feed_forward=False"
        raise ValueError(
            f"policy {name!r} looks {controller.horizon} steps ahead, the observation {preview}: "
            f"choose {remedy}, or gym.make({task.env_id!r}, preview={controller.horizon})"
        )
    return ControllerPolicy(controller, task, name)
