"""Observations that no flight gives, to every policy: a command in bounds, or an error that names the row."""

from __future__ import annotations

import random
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np

from baselines.policies.environments import make_env
from baselines.policies.registry import TEAM_POLICIES, TRACKING_POLICIES, make_policy
from baselines.policies.trained import shipped_policies
from quad_envs.parameters import Array
from quad_envs.registration import TEAMS

from .found import Found

_ENVS = {
    "tracking": "quad/CorridorTracking-v0",
    "formation": "quad/Formation-v0",
    "target-tracking": "quad/TargetTracking-v0",
    "estimation": "quad/CooperativeEstimation-v0",
}
_HUGE = (1e2, 1e4, 1e8, 1e20, 1e37)
_BAD = (np.nan, np.inf, -np.inf)


def fliers() -> list[tuple[str, str]]:
    """(policy, id) of every policy in an environment of each of its missions."""
    found = [
        (name, _ENVS[mission])
        for table in (TRACKING_POLICIES, TEAM_POLICIES)
        for name, entry in table.items()
        for mission in entry.missions
        if not (table is TEAM_POLICIES and mission == "tracking")
    ]
    found += [(name, _place(name)) for name in shipped_policies()]
    return [*found, ("safe:random", _ENVS["tracking"]), ("safe:lmpc", _ENVS["tracking"])]


def _place(network: str) -> str:
    """The id for which a network was trained."""
    ending = network.rsplit("-", 1)[1]
    named = {"formation": "quad/Formation-v0", "regulation": "quad/Regulation-v0"}
    return named.get(ending, f"quad/{'Helix' if ending == 'generalist' else ending.title()}Tracking-v0")


def wild(rng: np.random.Generator, usual: Array) -> tuple[Array, bool]:
    """Wild observations (rows, entries) of the shape of usual ones, and whether all are finite."""
    kind = rng.integers(6)
    found = usual.astype(np.float64)
    row, share = rng.integers(len(found)), rng.random(found.shape) < rng.choice([0.02, 0.2, 1.0])
    if kind == 0:  # some entries are huge
        found = np.where(share, rng.choice(_HUGE) * rng.normal(size=found.shape), found)
    elif kind == 1:  # all of them are of other sizes
        found = rng.normal(size=found.shape) * 10.0 ** rng.uniform(-3.0, 6.0)
    elif kind == 2:  # tilted as far as no model holds, and turning
        found[row, 3:5] = rng.uniform(-np.pi, np.pi, 2)
        found[row, 7:10] = 10.0 ** rng.uniform(0.0, 4.0) * rng.normal(size=3)
    elif kind == 3:  # nothing at all
        found[:] = rng.choice([0.0, -0.0, 1e-300])
    elif kind == 4:  # on the edge of float32
        found[row] = rng.choice([-1.0, 1.0], found.shape[1]) * float(np.finfo(np.float32).max)
    else:
        found[row, rng.integers(found.shape[1])] = rng.choice(_BAD)
    with np.errstate(over="ignore"):
        found = found.astype(np.float32)
    return found, bool(np.isfinite(found).all())


def observations(seed: int) -> Iterator[Found]:
    """Wild observations without end, to every policy in turn."""
    made: list[tuple[str, Any, Array]] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, env_id in fliers():
            env = make_env(env_id)
            first = env.reset(seed=seed)[0]
            usual = np.array(list(first.values())) if env_id in TEAMS else first[None]
            made.append((f"{name} in {env_id}", make_policy(name, env), usual))
    rng = np.random.default_rng(seed)
    random.seed(seed)
    while True:
        for what, policy, usual in made:
            found, finite = wild(rng, usual)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                wrong = _answered(policy, usual, found, finite)
            yield Found(1, (f"{what}: {wrong}",) if wrong else ())


def _answered(policy: Any, usual: Array, found: Array, finite: bool) -> str:
    """What is wrong with the answer: at once, or after a usual decision and followed by another."""
    try:
        _, state = policy.predict(usual, None, np.ones(len(usual), dtype=np.bool_))
        action, state = policy.predict(found, state, np.zeros(len(usual), dtype=np.bool_))
    except ValueError as error:
        said = str(error)
        return "" if 0 < len(said) < 2000 else f"an error of {len(said)} characters"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    if not finite:
        return "what is not finite was decided"
    if not (np.isfinite(action).all() and (np.abs(action) <= 1.0).all()):
        return f"the action is {np.asarray(action).min()} to {np.asarray(action).max()}"
    try:
        action, _ = policy.predict(usual, state, np.zeros(len(usual), dtype=np.bool_))
    except Exception as error:
        return f"afterwards {type(error).__name__}: {error}"
    return "" if np.isfinite(action).all() else "it does not recover"
