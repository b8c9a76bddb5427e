"""Fly one unit of a suite, and what is kept of it: its numbers as a cell, its flights as arrays."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_envs.tasks import TeamTask

from ..errors import ResultsError
from ..evaluation.episode import Episode
from ..evaluation.evaluate import fly_and_measure
from ..evaluation.rollout import check_flights, time_decisions
from ..evaluation.row_forms import has_row_form
from ..policies.environments import make_env
from ..policies.registry import from_outside, make_policy, policy_name
from .folder import task_facts
from .inputs import at_hand
from .units import Unit


def fly_unit(unit: Unit) -> dict[str, Any]:
    """Fly one unit, or a block of its flights.

    Returns:
        "cell", the form in which it is stored in cells/, and "flights", the content of each file in episodes/
        by its name; or what went wrong as "failure". A policy from outside that breaks off is a finding of
        the sweep, whose other units go on.
    """
    try:
        with at_hand(unit) as (here, places):
            return _fly(here, places)
    except ResultsError:
        raise
    except ValueError as error:
        if not from_outside(unit.source):
            raise
        return {"failure": str(error)}


def timed_unit(unit: Unit) -> Unit:
    """The unit with the times of its decisions, where its flights go side by side; nothing else may run now.

    What is wrong with it shows when it flies.
    """
    try:
        env, policy = _made(unit)
        check_flights(policy, env, unit.episodes, unit.seed, unit.given.mismatch)
        timed = time_decisions(policy, env, unit.seed) if has_row_form(policy, env) else None
    except ValueError:
        return unit
    return unit._replace(timed=timed)


def _made(unit: Unit) -> tuple[Any, Any]:
    """Its environment and its policy."""
    env = unit.given.env
    if env is None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # said once before the first unit
            env = make_env(unit.env.id, **unit.env.kwargs)
    return env, make_policy(unit.source, env, **unit.options)


def _fly(unit: Unit, places: Mapping[str, str]) -> dict[str, Any]:
    begin = perf_counter()
    env, policy = _made(unit)
    flights: dict[str, bytes] = {}
    save = _saver(unit, env, flights)

    def on_episode(episode: Episode) -> None:
        save(episode)
        if unit.given.on_episode is not None:
            unit.given.on_episode(episode)

    found = fly_and_measure(
        policy,
        env,
        unit.episodes,
        unit.seed,
        on_episode=on_episode,
        mismatch=unit.given.mismatch,
        timed=unit.timed,
    )
    if unit.given.policy is None:
        name = policy_name(policy, unit.policy_name)
        for text, place in places.items():
            name = name.replace(place, text)
        found = replace(found, policy=name)
    if unit.given.env is None:
        env.close()
    seconds = perf_counter() - begin
    cell = {
        "env": unit.env.title,
        "policy": unit.policy.title,
        "seconds": seconds,
        "task": task_facts(env.unwrapped.task),
        "flights_saved": len(flights),
        "found": found.to_plain(),
    }
    return {"cell": cell, "flights": flights}


def _saver(unit: Unit, env: Any, flights: dict[str, bytes]) -> Callable[[Episode], None]:
    """Adds the flights that are wanted, each when all vehicles of a team have given theirs."""
    team: list[Episode] = []

    def save(episode: Episode) -> None:
        team.append(episode)
        if len(team) < episode.team_size:
            return
        if episode.seed < unit.save_before:
            arrays: dict[str, Any] = flight_arrays(team) | _graphs(env)
            buffer = io.BytesIO()
            np.savez_compressed(buffer, **arrays)
            flights[unit.episode_name(episode.seed)] = buffer.getvalue()
        team.clear()

    return save


def _graphs(env: Any) -> dict[str, NDArray[Any]]:
    """Who hears whom in a team, in every flight alike.

    `graphs` (M, N, N) are the weights that hold at some step, and `graph_of_step` (T+1,) says which.
    """
    if not isinstance(env.unwrapped.task, TeamTask):
        return {}
    return {"graphs": env.unwrapped.graphs.graphs, "graph_of_step": env.unwrapped.graphs.which}


def flight_arrays(team: Sequence[Episode]) -> dict[str, NDArray[Any]]:
    """The arrays of a flight in the form of episodes/*.npz.

    Of one vehicle those of its Episode. Of a team the same and its signals, stacked with the vehicles first,
    with `agent` their names and `lengths` the steps that each flew: what lies behind, where one left early,
    is nan, or zero where there are only whole numbers. `target` is one for all of them.
    """
    plain = [
        {
            key: value
            for key, value in episode._asdict().items()
            if isinstance(value, np.ndarray) and key != "target"
        }
        | {key: np.asarray(value) for key, value in episode.signals.items()}
        for episode in team
    ]
    if not team[0].agent:
        return plain[0]
    out = {key: _stack_ragged([arrays[key] for arrays in plain]) for key in plain[0]}
    out["agent"] = np.array([episode.agent for episode in team])
    out["lengths"] = np.array([len(episode.rewards) for episode in team])
    out["crashed"] = np.array([episode.crashed for episode in team])
    return out if team[0].target is None else out | {"target": team[0].target}


def _stack_ragged(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
    longest = max(len(array) for array in arrays)
    fill = np.nan if np.issubdtype(arrays[0].dtype, np.floating) else 0
    out = np.full((len(arrays), longest, *arrays[0].shape[1:]), fill, dtype=arrays[0].dtype)
    for row, array in zip(out, arrays, strict=True):
        row[: len(array)] = array
    return out
