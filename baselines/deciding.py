"""A decision in a flight: timed, and if it fails for numbers that are not finite, where that was."""

from __future__ import annotations

from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .episode import Recorder
from .policy import Policy


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
    """
    begin = perf_counter()
    try:
        actions, kept = policy.predict(observations, state, start, deterministic=True)
    except ValueError as error:
        row = _first_row(observations)
        if row is None:
            raise
        raise ValueError(f"{_place(policy, recorder, row)}: {error}") from error
    seconds = perf_counter() - begin
    row = _first_row(actions)
    if row is not None and recorder.live[row if len(actions) == len(recorder.live) else 0]:
        found = np.asarray(actions)[row].tolist()
        raise ValueError(f"{_place(policy, recorder, row)}: the action is not finite, got {found}")
    return Decided(actions, kept, seconds)


def _first_row(values: NDArray[Any]) -> int | None:
    """The first row with a number that is not finite."""
    finite = np.isfinite(values)
    return None if finite.all() else int(np.argmin(finite.reshape(len(finite), -1).all(axis=1)))


def _place(policy: Policy, recorder: Recorder, row: int) -> str:
    """Which policy, where."""
    name, agent = getattr(policy, "name", type(policy).__name__), recorder.agents[row]
    who = f"row {row}" + (f" ({agent})" if agent else "")
    return f"policy {name!r}, {who} from seed {recorder.seeds[row]}, step {len(recorder.steps)}"
