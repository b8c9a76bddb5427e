"""Threads that share the rows of a batched decision."""

from __future__ import annotations

import pickle

import gymnasium as gym
import numpy as np
import pytest

import quad_envs  # noqa: F401  registers the ids
from baselines import make_policy
from quad_envs.compilation.threads import Threads

MPCS = ("lmpc", "sdc-nmpc", "nmpc")
TIGHT = {"kappa": 0.3125, "rate_limit": 5.0, "start_box": 3.0}


def fly(policies, rows, steps):
    """Decisions of each policy along one flight of many vehicles, which the first one flies."""
    envs = gym.make_vec("quad/Regulation-v0", num_envs=rows, **TIGHT)
    observations, _ = envs.reset(seed=0)
    states, start, found = [None] * len(policies), np.ones(rows, np.bool_), []
    for _ in range(steps):
        both = zip(policies, states, strict=True)
        pairs = [policy.predict(observations, state, start) for policy, state in both]
        states, start = [state for _, state in pairs], np.zeros(rows, np.bool_)
        found.append(pairs)
        observations, *_ = envs.step(pairs[0][0])
    envs.close()
    return found


@pytest.mark.parametrize("name", MPCS)
@pytest.mark.parametrize("rows", [1, 3, 70])
def test_decisions_do_not_depend_on_the_number_of_threads(name, rows):
    env = gym.make("quad/Regulation-v0", **TIGHT)
    policies = [make_policy(name, env, horizon=10, threads=threads) for threads in (1, 2, 5)]
    for pairs in fly(policies, rows, 4):
        (actions, state), *others = pairs
        for other_actions, other_state in others:
            np.testing.assert_array_equal(other_actions, actions)
            for one, other in zip(other_state, state, strict=True):
                np.testing.assert_array_equal(one, other)


def test_a_disturbance_estimator_is_shared_alike():
    env = gym.make("quad/Regulation-v0", **TIGHT)
    policies = [make_policy("lmpc", env, horizon=5, threads=k, reject_disturbance=True) for k in (1, 3)]
    for (actions, _), (other, _) in fly(policies, 20, 4):
        np.testing.assert_array_equal(other, actions)


def test_a_row_that_is_not_finite_is_named_as_by_one_thread():
    env = gym.make("quad/Regulation-v0")
    controller = make_policy("lmpc", env, horizon=5, threads=3).controller
    arguments = [np.zeros((90, size)) for size in (16, 4, 6, controller.memory_size)]
    windows = np.zeros((90, 6, 8))
    windows[:, :, 7] = 1.0
    for row in (80, 41):  # both are bad at last: the first one counts
        arguments[0][row, 2] = np.nan
        with pytest.raises(ValueError, match=f"plant of vehicle {row} is not finite"):
            controller.decide(arguments[0], windows, *arguments[1:])


def test_a_pickled_policy_with_threads_decides_alike():
    env = gym.make("quad/Regulation-v0", **TIGHT)
    policy = make_policy("sdc-nmpc", env, horizon=5, threads=2)
    observations = np.repeat(env.reset(seed=1)[0][None], 6, axis=0)
    expected, _ = policy.predict(observations)
    actions, _ = pickle.loads(pickle.dumps(policy)).predict(observations)
    np.testing.assert_array_equal(actions, expected)


@pytest.mark.parametrize("threads", [0, -1, 1.5, 10**6])
def test_a_number_of_threads_that_cannot_be_is_refused(threads):
    with pytest.raises(ValueError, match="threads must be a whole number"):
        make_policy("lmpc", "quad/Regulation-v0", threads=threads)


def test_what_goes_wrong_in_a_thread_is_raised():
    def work(thread, begin, end):
        if begin >= 8:
            raise RuntimeError(f"row {begin}")
        return -1

    with pytest.raises(RuntimeError, match="row"):
        Threads(2).run(40, work)
