"""Threads that share the teams of a vector environment."""

import copy

import numpy as np
import pytest

from quad_envs import cooperative_estimation_v0, formation_v0, target_tracking_v0

TEAMS = 5


@pytest.mark.parametrize("threads", [2, 3, 64])
@pytest.mark.parametrize(
    ("module", "options"),
    [
        (
            formation_v0,
            {
                "start": "box",
                "terminate": "agent",
                "disturbance": "gusts",
                "randomize": 0.1,
                "tilt_limit": 0.1,
            },
        ),
        (target_tracking_v0, {"drop_out": 0.3, "delay": 1, "sensor_noise": 0.01}),
        (cooperative_estimation_v0, {"drop_out": 0.1}),
    ],
)
def test_teams_do_not_depend_on_the_number_of_threads(module, options, threads):
    one, many = (module.vector_env(TEAMS, threads=count, time_limit=1.0, **options) for count in (1, threads))
    many = copy.deepcopy(many)
    rng, ended = np.random.default_rng(0), 0
    for first, second in zip(one.reset(seed=3), many.reset(seed=3), strict=True):
        np.testing.assert_equal(first, second)
    for _ in range(45):
        actions = rng.uniform(-0.9, 0.9, one.action_space.shape).astype(np.float32)
        for first, second in zip(steps := one.step(actions), many.step(actions), strict=True):
            np.testing.assert_equal(first, second)
        ended += int((steps[2] | steps[3]).sum())
    assert ended >= 2 * one.num_envs


def test_an_action_that_is_no_number_moves_no_team_on_any_thread():
    env = formation_v0.vector_env(4, threads=2)
    env.reset(seed=0)
    before, actions = env.plants, np.zeros(env.action_space.shape, np.float32)
    actions[-1, 2] = np.nan
    with pytest.raises(ValueError, match=r"action\[2\] of vehicle 5 \(team 3\) is nan"):
        env.step(actions)
    assert np.array_equal(env.plants, before)


@pytest.mark.parametrize("threads", [0, 1.5, True])
def test_a_number_of_threads_of_teams_that_is_none_is_refused(threads):
    with pytest.raises(ValueError, match="threads"):
        formation_v0.vector_env(2, threads=threads)
