"""References from functions: jumps, corners, and when the function is asked."""

import gymnasium as gym
import numpy as np
import pytest

import quad_envs
from quad_envs import target_tracking_v0
from quad_envs.references import from_function

HELIX = "quad/HelixTracking-v0"


def table_of(function, **kwargs):
    return gym.make(HELIX, reference=from_function(function), **kwargs).unwrapped.reference


@pytest.mark.parametrize("jump", [1e-3, 0.3, 5.0])
@pytest.mark.parametrize("when", [0.05, 2.0, 2.0005, 2.01, 9.95])
def test_a_jump_has_no_velocity(jump, when):
    found = table_of(lambda t: (0, 0, 0) if t < when else (jump, 0, 0))
    # A millimetre within a millisecond is a slow motion as well.
    assert np.abs(found[:, 3:6]).max() <= (0.5 if jump == 1e-3 else 0.0)


def test_beside_a_jump_a_path_keeps_the_velocity_of_its_smooth_side():
    before_it = table_of(lambda t: (0.5 * t, 0, 0) if t <= 2.0 else (0.5 * t + 1.0, 0, 0))
    after_it = table_of(lambda t: (0.5 * t, 0, 0) if t < 2.0 else (0.5 * t + 1.0, 0, 0))
    for found in (before_it, after_it):
        np.testing.assert_allclose(found[:, 3], 0.5, atol=1e-9)


def test_at_a_corner_the_sample_has_the_velocity_of_the_way_on():
    found = table_of(lambda t: (2.0 * (t if t < 5.0 else 10.0 - t), 0, 0))
    np.testing.assert_allclose(found[:100, 3], 2.0, atol=1e-9)
    np.testing.assert_allclose(found[100:200, 3], -2.0, atol=1e-9)


def test_a_single_sample_elsewhere_has_no_velocity():
    found = table_of(lambda t: (float(abs(t - 2.0) < 1e-9), 0, 0))
    assert np.abs(found[:, 3:6]).max() == 0.0


def test_the_function_is_asked_within_the_episode_only():
    asked = []

    def line(t):
        asked.append(t)
        return (t, 0.5 * t * t, 0)

    found = table_of(line, time_limit=2.0, preview=30)
    assert min(asked) == 0.0 and max(asked) == 2.0
    # The differences at both ends are of second order, exact for a parabola but for round-off.
    np.testing.assert_allclose(found[[0, 40], 3:5], [[1, 0], [1, 2]], atol=1e-8)
    # The preview beyond goes on with the last velocity.
    np.testing.assert_allclose(found[60, :2], [3.0, 4.0], atol=1e-8)
    np.testing.assert_allclose(found[40:, 3:5], np.tile([1, 2], (31, 1)), atol=1e-8)


def test_functions_inside_of_others_and_of_targets_are_asked_within_the_episode_too():
    asked = []

    def line(t):
        asked.append(t)
        return (t, 0, 0)

    gym.make(HELIX, reference=quad_envs.Heading(from_function(line), rate=0.1))
    assert min(asked) == 0.0 and max(asked) == 10.0
    asked.clear()
    target_tracking_v0.parallel_env(target=quad_envs.target_from_function(line), time_limit=1.0)
    assert min(asked) == 0.0 and max(asked) <= 1.0


def test_a_velocity_that_no_vehicle_flies_is_refused_by_name():
    with pytest.raises(ValueError, match=r"moves at 500 m/s at t = [\d.]+ s; no quadrotor flies faster"):
        table_of(lambda t: (500.0 * t, 0, 0))
    with pytest.raises(ValueError, match="moves at 1000 m/s"):
        gym.make(HELIX, reference=quad_envs.Line((1000.0, 0.0, 0.0)))


def test_velocities_that_contradict_the_positions_are_said():
    with pytest.warns(UserWarning, match="the reference function: the velocities contradict"):
        table_of(lambda t: (np.sin(t), 0, 0, np.sin(t), 0, 0))
    table_of(lambda t: (float(t > 5.0), 0, 0, 0, 0, 0))  # a step of the set point is meant


@pytest.mark.parametrize("bad", [lambda t: [0, [], 0], lambda t: [0.0] * (3 + (t > 5)), lambda t: "abc"])
def test_results_that_are_no_numbers_are_refused(bad):
    with pytest.raises(ValueError, match="a reference function must return 3"):
        table_of(bad)


def test_errors_of_the_function_itself_are_not_hidden():
    with pytest.raises(ZeroDivisionError):
        table_of(lambda t: (1 / 0, 0, 0))
