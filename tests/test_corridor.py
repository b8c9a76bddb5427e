"""CorridorTracking: constraints bind there for long, and only those who plan for them keep them."""

import gymnasium as gym
import numpy as np
import pytest

from baselines import make_policy, measure, run_episodes

EPISODES = 3


@pytest.fixture(scope="module")
def env():
    return gym.make("quad/CorridorTracking-v0")


def records(env, name, **options):
    return [measure(episode) for episode in run_episodes(make_policy(name, env, **options), env, EPISODES)]


@pytest.mark.parametrize(("name", "options"), [("lqr", {}), ("lmpc", {"soft_weight": 0.0})])
def test_without_its_state_rows_a_controller_violates_in_a_large_share_of_steps(env, name, options):
    assert np.mean([record.violation_share for record in records(env, name, **options)]) > 0.3


@pytest.mark.parametrize("name", ["lmpc", "sdc-nmpc", "nmpc"])
def test_the_mpcs_keep_the_limits(env, name):
    flown = records(env, name)
    assert not any(record.crashed for record in flown)
    assert [record.violation_share for record in flown] == [0.0] * EPISODES


def test_planning_for_the_limits_pays_in_score(env):
    blind = np.mean([record.score for record in records(env, "lmpc", soft_weight=0.0)])
    assert np.mean([record.score for record in records(env, "lmpc")]) > blind + 0.1
