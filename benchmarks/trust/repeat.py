"""The same seed gives the same bits: in another process, order, number of rows, threads or jobs."""

from __future__ import annotations

import hashlib
import json
import random
import subprocess
import sys
import warnings
from collections.abc import Iterator
from functools import partial
from itertools import count
from typing import Any

import numpy as np

from baselines import run_benchmark
from baselines.evaluation.evaluate import Evaluation
from quad_envs.parameters import Array
from quad_envs.registration import TRACKING

from . import drawn
from .found import Found, tried

_STEPS = 60
_CONTROLLERS = ("random", "hover", "lqr", "lmpc", "sdc-nmpc", "nmpc", "sdre", "feedback-linearization")
_NETWORKS = ("apg-helix", "dagger-helix", "ppo-helix", "apg-generalist")


def repeat(seed: int) -> Iterator[Found]:
    """Comparisons without end, of each kind in turn."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for k in count():
            rng = random.Random(f"{seed} {k}")
            last = ("beside others", _blocks) if k % 60 != 5 else ("jobs 1 = 2", _jobs)
            kinds = (
                ("single = vector", partial(_single_is_vector, rng)),
                ("rows in another order", partial(_order, rng)),
                ("single = vector", partial(_single_is_vector, rng)),
                ("threads 1 = 3", partial(_threads, rng)),
                ("again", partial(_again, rng)),
                (last[0], partial(last[1], rng)),
            )
            if k % 60 == 11:
                yield tried("another process", partial(_process, rng))
            else:
                yield tried(*kinds[k % len(kinds)])


def _actions(rng: np.random.Generator, env: Any) -> Array:
    return rng.uniform(-1.1, 1.1, env.action_space.shape).astype(np.float32)


def _flight(env: Any, seeds: Any, actions: list[Array]) -> list[Array]:
    """Observations, rewards and ends of a vector, step by step."""
    found = [np.asarray(env.reset(seed=seeds)[0]).copy()]
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        found += [np.copy(part) for part in (observation, reward, terminated, truncated)]
    return found


def _alike(what: str, one: list[Array], other: list[Array]) -> str:
    for k, (a, b) in enumerate(zip(one, other, strict=True)):
        if a.tobytes() != b.tobytes():
            return f"{what}: differs at part {k % 4} of step {(k + 3) // 4}"
    return ""


def _drawn(rng: random.Random, ids: Any, copies: int) -> drawn.Drawn:
    return drawn.draw(rng, rng.choice(list(ids)), copies)


def _again(rng: random.Random) -> str:
    """The same environment, made twice."""
    one = _drawn(rng, drawn.IDS, rng.choice([1, 2, 5]))
    other, numbers = drawn.make(*one[:3]), np.random.default_rng(rng.randrange(2**32))
    actions = [_actions(numbers, one.env) for _ in range(_STEPS)]
    return _alike(one.what, *(_flight(env, 7, actions) for env in (one.env, other)))


def _threads(rng: random.Random) -> str:
    one = _drawn(rng, drawn.IDS, rng.choice([8, 13, 40]))
    other = drawn.make(*one[:3], threads=3)
    numbers = np.random.default_rng(rng.randrange(2**32))
    actions = [_actions(numbers, one.env) for _ in range(_STEPS)]
    return _alike(one.what, *(_flight(env, 7, actions) for env in (one.env, other)))


def _order(rng: random.Random) -> str:
    """Vehicles of a vector in another order."""
    one = _drawn(rng, TRACKING, rng.choice([2, 5, 9]))
    other, n = drawn.make(*one[:3]), one.copies
    numbers = np.random.default_rng(rng.randrange(2**32))
    order, seeds = numbers.permutation(n), [int(x) for x in numbers.integers(0, 1000, n)]
    actions = [_actions(numbers, one.env) for _ in range(_STEPS)]
    first = _flight(one.env, seeds, actions)
    second = _flight(other, [seeds[i] for i in order], [action[order] for action in actions])
    return _alike(one.what, [part[order] for part in first], second)


def _single_is_vector(rng: random.Random) -> str:
    """A row of a vector beside the environment alone, until its first end."""
    one = _drawn(rng, TRACKING, rng.choice([1, 3, 6]))
    alone, row = drawn.make(one.env_id, one.kwargs, 0), rng.randrange(one.copies)
    numbers = np.random.default_rng(rng.randrange(2**32))
    seen, (mine, _) = one.env.reset(seed=11)[0], alone.reset(seed=11 + row)
    for k in range(_STEPS):
        if seen[row].tobytes() != mine.tobytes():
            return f"{one.what}: row {row} differs in the observation of step {k}"
        action = _actions(numbers, one.env)
        seen, rewards, terminated, truncated, _ = one.env.step(action)
        mine, reward, ended, cut, _ = alone.step(action[row])
        if (rewards[row], terminated[row], truncated[row]) != (reward, ended, cut):
            return f"{one.what}: row {row} differs in what step {k} gives"
        if ended or cut:
            break
    return ""


def _suite(
    rng: random.Random, episodes: int, policies: tuple[str, ...] = (*_CONTROLLERS, *_NETWORKS)
) -> dict[str, Any]:
    envs = [{"id": env_id, "kwargs": {"time_limit": 1.0}} for env_id in rng.sample(list(TRACKING), 2)]
    chosen = rng.sample(policies, 3)
    return {"envs": envs, "policies": chosen, "episodes": episodes, "seed": rng.randrange(1000)}


def _flown(suite: dict[str, Any], jobs: int = 1) -> list[str]:
    """What is found, as texts; without times."""
    return [_timeless(one) for one in run_benchmark(suite, jobs=jobs).evaluations]


def _timeless(found: Evaluation) -> str:
    plain = found.to_plain()
    records = [
        {name: value for name, value in record.items() if not name.startswith("decision")}
        for record in plain["records"]
    ]
    return json.dumps([plain["policy"], records])


def _jobs(rng: random.Random) -> str:
    suite = _suite(rng, 3)
    return "" if _flown(suite) == _flown(suite, jobs=2) else f"{suite}: differs with two processes"


def _blocks(rng: random.Random, policies: tuple[str, ...] = _CONTROLLERS) -> str:
    """A flight beside others, and among fewer."""
    suite = _suite(rng, 6, policies)
    many = [json.loads(one)[1][:2] for one in _flown(suite)]
    few = [json.loads(one)[1] for one in _flown({**suite, "episodes": 2})]
    return "" if repr(many) == repr(few) else f"{suite}: a flight depends on those beside it"


def rows(seed: int) -> Iterator[Found]:
    """Flights of networks among 6 and among 2, without end."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for k in count():
            yield tried("networks beside others", partial(_blocks, random.Random(f"{seed} {k}"), _NETWORKS))


def digest(seed: int) -> str:
    """Of flights of some environments, for a process that compares it."""
    rng, found = random.Random(seed), hashlib.sha256()
    for _ in range(5):
        one = _drawn(rng, drawn.IDS, 4)
        numbers = np.random.default_rng(rng.randrange(2**32))
        for part in _flight(one.env, 3, [_actions(numbers, one.env) for _ in range(_STEPS)]):
            found.update(part.tobytes())
    found.update(repr(_flown(_suite(rng, 2))).encode())
    return found.hexdigest()


def _process(rng: random.Random) -> str:
    seed = rng.randrange(10**6)
    code = f"from benchmarks.trust.repeat import digest; print(digest({seed}))"
    other = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=True
    )
    return "" if other.stdout.split()[-1] == digest(seed) else f"seed {seed}: another process has other bits"
