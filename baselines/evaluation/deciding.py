"""A decision in a flight: timed and checked; what goes wrong is said with policy, start and step."""

from __future__ import annotations

from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_envs.tasks import TeamTask

from ..errors import PolicyError
from ..policies.blame import place_of, place_where_defined, told
from ..policies.protocol import Policy
from ..policies.registry import policy_name
from .recorder import Recorder

_SUITE = ("baselines", "controllers", "quad_envs")  # whose errors say all there is to say


class Decided(NamedTuple):
    """What a policy said."""

    actions: NDArray[Any]
    state: Any
    seconds: float  # of wall time in predict


def decide(
    policy: Policy, observations: NDArray[Any], state: Any, start: ArrayLike, recorder: Recorder
) -> Decided:
    """Ask a policy for the actions of the present step.

    A policy that is shown a row with NaN refuses all rows, since none may differ from what it gets alone.

    Args:
        policy: It.
        observations: (n, d), or (1, S) of a privileged policy.
        state: What it returned before.
        start: (n,), rows that begin an episode.
        recorder: Of these flights; it knows seeds, agents, the step and who still flies.

    Raises:
        ValueError: If it refused, or answered with, numbers that are not finite: with the policy, the row,
            its seed and the step.
        PolicyError: If the answer is not (actions, state) with actions of the right shape, or if a policy
            from outside raised anything else: with the line of its file, the seed and the step.
    """
    begin = perf_counter()
    try:
        answer = policy.predict(observations, state, start, deterministic=True)
    except (Exception, SystemExit) as error:
        row = _first_row(observations)
        if row is not None and isinstance(error, ValueError):
            raise ValueError(f"{_place(policy, recorder, row)}: {error}") from error
        source = getattr(policy, "unfiltered", policy)  # what stands behind a safety filter
        if type(source).__module__.partition(".")[0] in _SUITE:
            raise
        raise _broken(policy, recorder, told(error), place_of(error)) from error
    seconds = perf_counter() - begin
    if not isinstance(answer, tuple) or len(answer) != 2:
        raise _broken(policy, recorder, f"predict must return (actions, state), got {_kind(answer)}")
    try:
        actions = np.asarray(answer[0])
    except (
        TypeError,
        ValueError,
        RuntimeError,
    ) as error:  # ragged lists; tensors with a gradient or on a GPU
        raise _broken(policy, recorder, f"actions must be an array: {told(error)}") from error
    wanted = _shape(policy, observations, recorder)
    if actions.shape != wanted or actions.dtype.kind not in "fiu":
        seen = f"for observations of shape {np.shape(observations)}"
        raise _broken(policy, recorder, f"actions must have shape {wanted} {seen}, got {_kind(answer[0])}")
    row = _first_row(actions)
    if row is not None and recorder.live[row if len(actions) == len(recorder.live) else 0]:
        found = actions[row].tolist()
        raise ValueError(f"{_place(policy, recorder, row)}: the action is not finite, got {found}")
    return Decided(actions, answer[1], seconds)


def _shape(policy: Policy, observations: NDArray[Any], recorder: Recorder) -> tuple[int, ...]:
    """Shape that the actions must have; a privileged policy answers for the whole team."""
    task = recorder.task
    size = task.action_size if isinstance(task, TeamTask) else 4
    team = (recorder.team_size,) if getattr(policy, "privileged", False) else ()
    return (len(observations), *team, size)


def _first_row(values: NDArray[Any]) -> int | None:
    """The first row with a number that is not finite."""
    finite = np.isfinite(values)
    return None if finite.all() else int(np.argmin(finite.reshape(len(finite), -1).all(axis=1)))


def _place(policy: Policy, recorder: Recorder, row: int) -> str:
    """Which policy, where."""
    agent = recorder.agents[row]
    who = f"row {row}" + (f" ({agent})" if agent else "")
    step = recorder.steps[row]
    return f"policy {policy_name(policy)!r}, {who} from seed {recorder.seeds[row]}, step {step}"


def _broken(policy: Policy, recorder: Recorder, what: str, line: str = "") -> PolicyError:
    """The error for what a policy did to all rows, with the line of its file."""
    flown = recorder.live if recorder.live.any() else np.ones_like(recorder.live)
    seeds, steps = np.array(recorder.seeds)[flown], recorder.steps[flown]
    when = f"{_span('seed', seeds)}, {_span('step', steps)}"
    line = line or place_where_defined(getattr(policy, "predict", policy))
    said = f"policy {policy_name(policy)!r}, from {when}: {what}"
    return PolicyError(f"{said}; {line}" if line else said)


def _span(what: str, values: NDArray[np.int64]) -> str:
    """A number, or the first and the last, in words."""
    first, last = int(values.min()), int(values.max())
    return f"{what} {first}" if first == last else f"{what}s {first} to {last}"


def _kind(answer: Any) -> str:
    """What an answer is, for messages."""
    if isinstance(answer, tuple):
        return f"a tuple of {len(answer)}"
    if hasattr(answer, "shape"):
        return f"{type(answer).__name__} of shape {tuple(answer.shape)}, {getattr(answer, 'dtype', '')}"
    return type(answer).__name__
