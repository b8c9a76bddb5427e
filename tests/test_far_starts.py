"""Starts that the environments accept are flown, however far: the target is governed towards the vehicle."""

import gymnasium as gym
import numpy as np
import pytest

import quad_envs  # noqa: F401  registers the ids
from baselines import evaluate, make_policy
from controllers.frame import GOVERNOR_REACH, set_references

POLICIES = ["lmpc", "sdc-nmpc", "nmpc", "lqr", "feedback-linearization"]


@pytest.mark.slow
@pytest.mark.parametrize("name", POLICIES)
@pytest.mark.parametrize("start", [(15.0, 0.0, 0.0), (0.0, -45.0, 0.0), (12.0, 9.0, 8.0)])
def test_a_far_start_is_no_crash(name, start):
    env = gym.make("quad/Regulation-v0", start=start, start_box=0.0, time_limit=30.0)
    (record,) = evaluate(make_policy(name, env), env, episodes=1).records
    assert not record.crashed


@pytest.mark.parametrize("heading", [True, False])
def test_a_far_window_is_moved_as_a_whole_and_a_near_one_is_left_alone(heading):
    plant = np.zeros(16)
    plant[:3], plant[8] = (1.0, -2.0, 3.0), 0.7 if heading else 0.0
    for distance in (GOVERNOR_REACH - 0.1, 40.0):
        window = np.zeros((4, 8))
        window[:, :3] = plant[:3] + np.array([0.6, 0.0, -0.8]) * distance
        window[:, 0] += [0.0, 0.1, 0.2, 0.4]
        window[:, 7] = 1.0
        r = np.empty((4, 12))
        set_references(plant, window, np.zeros(12), heading, False, False, 4, 0.05, r)
        own = np.zeros(3) if heading else plant[:3]
        wanted = min(distance, GOVERNOR_REACH) if heading else distance
        assert np.linalg.norm(r[0, :3] - own) == pytest.approx(wanted, abs=1e-12)
        steps = np.linalg.norm(r[1:, :3] - r[0, :3], axis=1)
        np.testing.assert_allclose(steps, [0.1, 0.2, 0.4], atol=1e-12)
