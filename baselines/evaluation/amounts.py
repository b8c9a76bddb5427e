"""How much is flown, and by how many at once: what is allowed, and from when on intervals mean something."""

from __future__ import annotations

from typing import Any

from quad_envs.arguments.checks import require_memory, require_whole

MOST_EPISODES = 100_000
INTERVAL_LEAST = 5  # flights, below which no interval is said
TAILS_LEAST = 1000  # flights, below which nothing is said of one in a thousand
_EPISODE_BYTES = 4000  # a record, and two float32 decision times of 200 steps
_MOST_JOBS = 1024
_JOB_BYTES = 200_000_000  # an interpreter with its compiled kernels


def require_episodes(what: str, value: Any) -> None:
    """Check a number of flights.

    Raises:
        ValueError: If it is not a whole number from 1 to MOST_EPISODES.
    """
    require_whole(what, value, 1, MOST_EPISODES, lambda n: n * _EPISODE_BYTES)


def require_jobs(value: Any, here: bool = True) -> None:
    """Check a number of processes, on this machine (`here`) or on a cluster.

    Raises:
        ValueError: If it is not a whole number >= 1, or this machine has not the memory for them.
    """
    require_whole("jobs", value, 1, _MOST_JOBS, lambda n: n * _JOB_BYTES)
    if here and value > 1:
        require_memory(f"{value} processes", value * _JOB_BYTES, "choose fewer jobs")
