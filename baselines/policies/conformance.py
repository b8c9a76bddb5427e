"""The conformance test of policies: whoever writes one can run it."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from ..errors import PolicyCheckError
from .environments import is_parallel, make_env
from .pairing import require_pair
from .protocol import Policy

_STEPS = 12  # of each flight
_ROWS = 3  # flights, from different seeds
_BATCH_TOLERANCE = 1e-5  # matrix products of torch and numpy round differently for another number of rows

Flights = NDArray[Any]  # (steps, rows, d), observations


def check_policy(policy: Policy, env: Any, seed: int = 0) -> None:
    """Test that a policy keeps the protocol: actions, state, independent rows, no hidden memory, pickling.

    Rows are the observations of vehicles: of several flights of a Gymnasium environment, or of all agents of
    a ParallelEnv. Those of a privileged policy are `env.state()`, a team each.

    Args:
        policy: To be tested; it flies a few steps.
        env: A Gymnasium environment, a PettingZoo ParallelEnv or an id; it is reset.
        seed: Of the first flight.

    Raises:
        PolicyCheckError: If a test fails, or the policy was made for another task; the message says which
            and what was expected.
    """
    if not callable(getattr(policy, "predict", None)):
        raise PolicyCheckError(f"{policy!r} has no predict(observation, state, episode_start, deterministic)")
    env = make_env(env) if isinstance(env, str) else env
    try:
        require_pair(policy, env)
    except ValueError as error:
        raise PolicyCheckError(str(error)) from error
    if not is_parallel(env):
        space, flights = env.action_space, _collect(policy, env, seed)
    else:
        space = env.action_space(env.possible_agents[0])
        if getattr(policy, "privileged", False):
            n = len(env.possible_agents)
            space = Box(np.tile(space.low, (n, 1)), np.tile(space.high, (n, 1)))
            flights = _collect_states(policy, env, space, seed)
        else:
            flights = _collect_agents(policy, env, space, seed)
    _check_determinism(policy, flights)
    _check_single(policy, space, flights)
    _check_no_mutation(policy, flights)
    _check_rows(policy, flights)
    _check_episode_start(policy, flights)
    _check_interleaving(policy, flights)
    _check_pickling(policy, flights)


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise PolicyCheckError(message)


def _starts(n: int, value: bool) -> NDArray[np.bool_]:
    return np.full(n, value, dtype=np.bool_)


def _check_action(action: Any, shape: tuple[int, ...], space: Any) -> None:
    low, high = space.low, space.high
    _require(isinstance(action, np.ndarray), f"the action must be a numpy array, got {type(action).__name__}")
    _require(action.shape == shape, f"the action must have shape {shape}, got {action.shape}")
    _require(action.dtype == np.float32, f"the action must be float32, got {action.dtype}")
    _require(bool(np.isfinite(action).all()), f"the action must be finite, got {action.tolist()}")
    inside = bool((action >= low).all() and (action <= high).all())
    _require(inside, f"the action must lie in {space}, got {action.tolist()}")


def _answer(policy: Policy, observations: NDArray[Any], state: Any, start: bool) -> tuple[Any, Any]:
    """What predict returns, after a test that it is a pair."""
    answer = policy.predict(observations, state, _starts(len(observations), start), deterministic=True)
    _require(
        isinstance(answer, tuple) and len(answer) == 2,
        f"predict must return (actions, state), got {type(answer).__name__}",
    )
    return answer


def _collect(policy: Policy, env: Any, seed: int) -> Flights:
    """Observations of a few flights of this policy, and the test of its actions on the way."""
    flights = []
    for row in range(_ROWS):
        observation, _ = env.reset(seed=seed + row)
        seen, state = [], None
        for k in range(_STEPS):
            seen.append(observation)
            action, state = _answer(policy, observation[None], state, k == 0)
            _check_action(action, (1, *env.action_space.shape), env.action_space)
            observation, _, terminated, truncated, _ = env.step(action[0])
            if terminated or truncated:
                break
        flights.append(seen)
    steps = min(map(len, flights))
    return np.stack([np.stack(seen[:steps]) for seen in flights], axis=1)


def _collect_agents(policy: Policy, env: Any, space: Any, seed: int) -> Flights:
    """Observations of all agents of a flight, as long as all of them fly."""
    seen, _ = env.reset(seed=seed)
    agents, state, flights = list(env.agents), None, []
    for k in range(_STEPS):
        observations = np.stack([seen[name] for name in agents])
        flights.append(observations)
        actions, state = _answer(policy, observations, state, k == 0)
        _check_action(actions, (len(agents), *space.shape), space)
        seen, *_ = env.step(dict(zip(agents, actions, strict=True)))
        if env.agents != agents:
            break
    return np.stack(flights)


def _collect_states(policy: Policy, env: Any, space: Any, seed: int) -> Flights:
    """States of a few flights of a privileged policy; a row is a team."""
    flights = []
    for row in range(_ROWS):
        env.reset(seed=seed + row)
        agents, state = list(env.agents), None
        seen: list[NDArray[Any]] = []
        for k in range(_STEPS):
            seen.append(env.state())
            actions, state = _answer(policy, seen[-1][None], state, k == 0)
            _check_action(actions, (1, *space.shape), space)
            env.step(dict(zip(agents, actions[0], strict=True)))
            if env.agents != agents:
                break
        flights.append(seen)
    steps = min(map(len, flights))
    return np.stack([np.stack(seen[:steps]) for seen in flights], axis=1)


def _fly(policy: Policy, flights: Flights) -> NDArray[np.float32]:
    """Actions on recorded observations, with the state threaded through, (steps, rows, ...)."""
    state, actions = None, []
    for k, observations in enumerate(flights):
        action, state = policy.predict(
            observations, state, _starts(len(observations), k == 0), deterministic=True
        )
        actions.append(action)
    return np.stack(actions)


def _check_single(policy: Policy, space: Any, flights: Flights) -> None:
    """One observation without a batch axis."""
    action, _ = policy.predict(flights[0, 0], None, None, deterministic=True)
    _check_action(action, space.shape, space)
    batched, _ = policy.predict(flights[0, :1], None, None, deterministic=True)
    _require(
        bool(np.allclose(action, batched[0], rtol=0.0, atol=_BATCH_TOLERANCE)),
        "an observation (d,) must get the action that it gets as a batch (1, d)",
    )


def _check_determinism(policy: Policy, flights: Flights) -> None:
    _require(
        bool(np.array_equal(_fly(policy, flights), _fly(policy, flights))),
        "the same observations, from state None, must give the same actions: the policy keeps something in "
        "attributes, or draws from a generator; what it remembers belongs in state",
    )


def _check_no_mutation(policy: Policy, flights: Flights) -> None:
    rows = flights.shape[1]
    _, state = policy.predict(flights[0].copy(), None, _starts(rows, True), deterministic=True)
    observations, start, kept = flights[-1].copy(), _starts(rows, False), copy.deepcopy(state)
    policy.predict(observations, state, start, deterministic=True)
    _require(bool(np.array_equal(observations, flights[-1])), "predict must not change the observation")
    _require(not start.any(), "predict must not change episode_start")
    _require(_same(state, kept), "predict must not change the state it is given; return a new one")


def _same(a: Any, b: Any) -> bool:
    """Equality of nested states."""
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(_same(a[key], b[key]) for key in a)
    if isinstance(a, tuple | list):
        return isinstance(b, tuple | list) and len(a) == len(b) and all(map(_same, a, b))
    if hasattr(a, "__array__"):
        return bool(np.array_equal(np.asarray(a), np.asarray(b), equal_nan=True))
    return bool(a == b)


def _check_episode_start(policy: Policy, flights: Flights) -> None:
    """A flag resets its own row, and no other."""
    rows = flights.shape[1]
    state: Any = None
    for k, observations in enumerate(flights):
        _, state = policy.predict(observations, state, _starts(rows, k == 0), deterministic=True)
    fresh, _ = policy.predict(flights[0], None, _starts(rows, True), deterministic=True)
    again, _ = policy.predict(flights[0], state, _starts(rows, True), deterministic=True)
    _require(
        bool(np.array_equal(fresh, again)),
        "episode_start = True must make a row forget: its action depends on before",
    )
    kept, _ = policy.predict(flights[-1], state, _starts(rows, False), deterministic=True)
    only_first = np.arange(rows) == 0
    mixed, _ = policy.predict(
        np.where(only_first[:, None], flights[0], flights[-1]), state, only_first, deterministic=True
    )
    _require(
        bool(np.array_equal(mixed[0], fresh[0]) and np.array_equal(mixed[1:], kept[1:])),
        "episode_start must reset the rows it flags and leave the others as they are",
    )


def _check_rows(policy: Policy, flights: Flights) -> None:
    together = _fly(policy, flights)
    for row in range(flights.shape[1]):
        alone = _fly(policy, flights[:, row : row + 1])
        worst = float(np.abs(alone[:, 0] - together[:, row]).max())
        _require(
            worst <= _BATCH_TOLERANCE,
            f"a row must get the action that it gets alone: row {row} differs by {worst:.3g}",
        )


def _check_interleaving(policy: Policy, flights: Flights) -> None:
    """Two episodes in turn, each with its own state, are as if the other did not exist."""
    expected = [_fly(policy, flights[:, row : row + 1]) for row in range(2)]
    states: list[Any] = [None, None]
    for k in range(len(flights)):
        for row in range(2):
            action, states[row] = policy.predict(
                flights[k, row : row + 1], states[row], _starts(1, k == 0), deterministic=True
            )
            _require(
                bool(np.array_equal(action, expected[row][k])),
                f"episodes flown in turn must not influence each other: the action of step {k} changed; "
                "the policy remembers outside state",
            )


def _check_pickling(policy: Policy, flights: Flights) -> None:
    try:
        twin = pickle.loads(pickle.dumps(policy))
    except Exception as error:
        raise PolicyCheckError(f"a policy must pickle, so that processes can share it: {error!r}") from error
    _require(
        bool(np.array_equal(_fly(policy, flights), _fly(twin, flights))),
        "a pickled policy must give the same actions",
    )
    _, state = policy.predict(flights[0], None, _starts(flights.shape[1], True), deterministic=True)
    _require(_same(pickle.loads(pickle.dumps(state)), state), "the state must pickle")
