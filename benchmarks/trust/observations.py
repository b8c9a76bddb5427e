"""Observations that no flight gives, to every policy: a command in bounds, or an error that names the row."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from baselines.evaluation.rollout import is_privileged
from baselines.policies.environments import make_env
from baselines.policies.registry import TEAM_POLICIES, TRACKING_POLICIES, make_policy
from baselines.policies.trained import shipped_policies
from quad_envs.parameters import Array
from quad_envs.registration import TEAMS

from .found import Found, tried

Flags = NDArray[np.bool_]

_ENVS = {
    "tracking": "quad/CorridorTracking-v0",
    "formation": "quad/Formation-v0",
    "target-tracking": "quad/TargetTracking-v0",
    "estimation": "quad/CooperativeEstimation-v0",
}
_HUGE = (1e2, 1e4, 1e8, 1e20, 1e37)
_BAD = (np.nan, np.inf, -np.inf)
_ROWS = (1, 2, 4, 5, 16, 33)  # of a batch: four are a tile of a network's kernel, and a block of the solver's
_STARTS = 4


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
    """A wild observation (entries,) made from a usual one, and whether it is finite."""
    kind = rng.integers(6)
    found = usual.astype(np.float64)
    if kind == 0:  # some entries are huge
        share = rng.random(found.shape) < rng.choice([0.02, 0.2, 1.0])
        found = np.where(share, rng.choice(_HUGE) * rng.normal(size=found.shape), found)
    elif kind == 1:  # all of them are of other sizes
        found = rng.normal(size=found.shape) * 10.0 ** rng.uniform(-3.0, 6.0)
    elif kind == 2:  # tilted as far as no model holds, and turning
        found[3:5] = rng.uniform(-np.pi, np.pi, 2)
        found[7:10] = 10.0 ** rng.uniform(0.0, 4.0) * rng.normal(size=3)
    elif kind == 3:  # nothing at all
        found[:] = rng.choice([0.0, -0.0, 1e-300])
    elif kind == 4:  # on the edge of float32
        found[:] = rng.choice([-1.0, 1.0], len(found)) * float(np.finfo(np.float32).max)
    else:
        found[rng.integers(len(found))] = rng.choice(_BAD)
    with np.errstate(over="ignore"):
        found = found.astype(np.float32)
    return found, bool(np.isfinite(found).all())


class Usual(NamedTuple):
    """Observations at starts, and what follows from them."""

    rows: Array  # (rows, entries)
    state: Any  # after a first decision
    decided: Array  # by the next one


class Flier(NamedTuple):
    """A policy and usual observations of it, for batches of each size."""

    what: str
    policy: Any
    usual: dict[int, Usual]


def flier(name: str, env_id: str, seed: int) -> Flier:
    """A policy with what it sees at some starts: rows of agents, or of whole teams if it sees the truth."""
    env, options = make_env(env_id), {}
    if is_privileged(make_policy(name, env)):  # one program over a whole team: small, and soon given up
        env, options = make_env(env_id, vehicles=3, formation="lattice"), {"max_iter": 1000}
    policy, seen = make_policy(name, env, **options), []
    for k in range(_STARTS):
        first = env.reset(seed=seed + k)[0]
        if env_id not in TEAMS:
            seen.append(first)
        elif is_privileged(policy):
            seen.append(env.state())
        else:
            seen += list(first.values())
    sizes = {n: np.resize(np.array(seen, dtype=np.float32), (n, len(seen[0]))) for n in _ROWS}
    return Flier(f"{name} in {env_id}", policy, {n: _usual(policy, rows) for n, rows in sizes.items()})


def _usual(policy: Any, rows: Array) -> Usual:
    _, state = policy.predict(rows, None, np.ones(len(rows), dtype=np.bool_))
    return Usual(rows, state, policy.predict(rows, state, np.zeros(len(rows), dtype=np.bool_))[0])


class Batch(NamedTuple):
    """Observations of which some are wild."""

    rows: Array  # (rows, entries)
    wild: Flags  # (rows,)
    finite: Flags  # (rows,)


def batch(rng: np.random.Generator, usual: Array, wild_rows: int) -> Batch:
    """Usual rows of which so many have become wild."""
    rows, places = usual.copy(), rng.permutation(len(usual))[:wild_rows]
    is_wild, finite = np.zeros(len(rows), dtype=np.bool_), np.ones(len(rows), dtype=np.bool_)
    for j in places:
        rows[j], finite[j] = wild(rng, rows[j])
    is_wild[places] = True
    return Batch(rows, is_wild, finite)


def observations(seed: int) -> Iterator[Found]:
    """Wild observations without end, alone or in a batch, as many to every policy in turn."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        made = [flier(name, env_id, seed) for name, env_id in fliers()]
    rng = np.random.default_rng(seed)
    while True:
        rows = int(rng.choice(_ROWS))
        wild_rows = int(rng.integers(rows // 2, rows)) + 1
        for what, policy, usual in made:
            some = batch(rng, usual[rows].rows, wild_rows)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found = tried(f"{what}, {rows} rows", partial(answered, policy, usual[rows], some))
            yield found._replace(tried=wild_rows)


def answered(policy: Any, usual: Usual, some: Batch) -> str:
    """What is wrong with the answer to wild rows after a usual decision, and with the one that follows."""
    given, left = some.rows.copy(), some.wild.copy()
    goes_on = np.zeros(len(given), dtype=np.bool_)
    while True:  # every error takes a row
        try:
            action, state = policy.predict(given, usual.state, goes_on)
            break
        except ValueError as error:
            wrong, row = _refused(str(error), left)
            if wrong:
                return wrong
            given[row], left[row] = usual.rows[row], False
    if not some.finite[left].all():
        return "what is not finite was decided"
    if not np.array_equal(action[~left], usual.decided[~left]):
        return "a wild row changes what is decided for those beside it"
    after, _ = policy.predict(usual.rows, state, goes_on)
    return _outside(action) or _outside(after, "afterwards ")


def _refused(said: str, left: Flags) -> tuple[str, int]:
    """What is wrong with an error, and of which row it speaks: one of those that are left."""
    named = re.search(r"\bobservation (\d+)\b", said)
    if not 0 < len(said) < 2000 or not named:
        return f"an error that names no row: {said[:200]}", -1
    row = int(named[1])
    if row >= len(left) or not left[row]:
        return f"an error of row {row}, which is not wild: {said[:200]}", -1
    return "", row


def _outside(action: Array, when: str = "") -> str:
    """What is wrong with actions: they are finite, and from -1 to 1."""
    if np.isfinite(action).all() and (np.abs(action) <= 1.0).all():
        return ""
    return f"{when}the action is {np.asarray(action).min()} to {np.asarray(action).max()}"
