"""Flights in the rows of a vector environment: each row, or team of rows, flies one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_envs.parameters import Array
from quad_envs.tasks import TeamTask

from ..policies.protocol import Policy
from .deciding import decide
from .episode import Episode
from .recorder import Begun, Recorder, Said

_REFILLED = 4  # a reset begins new flights when one in so many rows waits for it


def row_episodes(
    policy: Policy, env: Any, episodes: int, seed: int, *, refill: bool = False
) -> Iterator[Episode]:
    """Fly episodes side by side, and yield them in the order of their seeds.

    A row that is done waits with what it saw last. No more flights are held than began since the first one
    that has not ended.

    Args:
        policy: Decides for all rows.
        env: A vector environment, of single vehicles or of teams, whose vehicles are consecutive rows.
        episodes: Number of episodes, of vehicles or of teams.
        seed: Of the first.
        refill: Whether new flights begin while others go on, which needs `reset_mask`; otherwise all rows
            begin together.
    """
    n = env.num_envs
    teams = getattr(env.unwrapped, "num_teams", n)
    size, recorder = n // teams, _recorder(env.unwrapped, n)
    flying = np.zeros(teams, dtype=np.bool_)
    ended: dict[int, list[Episode]] = {}
    least = max(1, teams // _REFILLED) if refill else teams
    begun, due, state, start = 0, 0, None, np.zeros(n, dtype=np.bool_)
    observations: NDArray[Any] = np.zeros((n, 0))
    while due < episodes:
        idle = np.flatnonzero(~flying)
        if begun < episodes and len(idle) >= least:
            seeds = dict(zip(idle.tolist(), range(seed + begun, seed + begun + len(idle)), strict=True))
            start = np.repeat(~flying, size)
            mask = None if len(idle) == teams else {"reset_mask": ~flying}
            first, _ = env.reset(seed=[seeds.get(t) for t in range(teams)], options=mask)
            observations = first if begun == 0 else np.where(start[:, None], first, observations)
            wanted = idle[: episodes - begun]
            rows = (wanted[:, None] * size + np.arange(size)).ravel()
            recorder.begin(rows, [seeds[j // size] for j in rows.tolist()], _begun(env.unwrapped, n))
            flying[wanted] = True
            begun += len(wanted)
        actions, state, _ = decide(policy, observations, state, start, recorder)
        if not recorder.live.all():
            actions = np.where(recorder.live[:, None], actions, np.float32(0.0))
        seen, *told = env.step(actions)
        recorder.add(observations, state, actions, Said(*told), np.nan, plants_of(env.unwrapped, n))
        observations = seen if recorder.live.all() else np.where(recorder.live[:, None], seen, observations)
        start = np.zeros(n, dtype=np.bool_)
        done = flying & ~recorder.live.reshape(teams, size).any(axis=1)
        for t in np.flatnonzero(done).tolist():
            ended[recorder.seeds[t * size]] = recorder.episodes(range(t * size, (t + 1) * size))
        flying &= ~done
        while seed + due in ended:
            yield from ended.pop(seed + due)
            due += 1


def _recorder(plain: Any, n: int) -> Recorder:
    if not isinstance(plain.task, TeamTask):
        return Recorder(plain.task, n)
    size = n // plain.num_teams
    return Recorder(plain.task, n, agents=[f"quad_{i % size}" for i in range(n)], team_size=size)


def _begun(plain: Any, n: int) -> Begun:
    """What a vector environment shows of the episodes that its rows are in."""
    if not isinstance(plain.task, TeamTask):
        return Begun(plain.reference, plain.state)
    known = plain.task.layout.target
    targets = np.repeat(plain.targets, n // plain.num_teams, axis=0) if known else None
    return Begun(plain.references, plain.plants, targets)


def plants_of(plain: Any, n: int) -> Array:
    """Plants as a team shows them, or as a vector of single vehicles does."""
    found = getattr(plain, "plants", None)
    if found is None:
        found = getattr(plain, "state", None) if hasattr(plain, "num_envs") else np.zeros((n, 0))
    return np.array(found, dtype=np.float64)
