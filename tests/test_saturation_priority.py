"""Where rotors saturate, yaw gives way: thrust, roll and pitch keep a vehicle in the air."""

import gymnasium as gym
import numpy as np
import pytest

import quad_envs
from baselines import make_policy, run_episodes
from controllers.fallback import yield_yaw
from quad_envs.parameters import QuadrotorParams

BOX = np.full(4, 7.84)
PARAMS = {"plus": QuadrotorParams(), "x": QuadrotorParams(frame="x")}


HOVERING = np.full(4, 1.96)


def yielded(F, last=HOVERING, rate_step=np.inf):
    out = np.array(F, dtype=float)
    yield_yaw(out, last, rate_step, BOX)
    return out


def wrench(F, params):
    """Angular accelerations and climb that rotor forces make."""
    return params.input_matrix()[[5, 9, 10, 11]] @ F


@pytest.mark.parametrize("frame", PARAMS)
def test_thrust_roll_and_pitch_stay_and_the_rotors_come_into_the_box(frame):
    rng = np.random.default_rng(0)
    yaw = np.array([-1.0, 1.0, -1.0, 1.0])
    for _ in range(200):
        base = rng.uniform(0.5, 5.0, 4)
        base -= yaw * (yaw @ base) / 4.0
        base = np.clip(base, 0.1, 7.0)
        base -= yaw * (yaw @ base) / 4.0
        if (base < 0.0).any() or (base > BOX).any():
            continue
        wanted = base + rng.uniform(-20.0, 20.0) * yaw
        found = yielded(wanted)
        assert (found >= -1e-12).all() and (found <= BOX + 1e-12).all()
        before, after = wrench(wanted, PARAMS[frame]), wrench(found, PARAMS[frame])
        np.testing.assert_allclose(after[:3], before[:3], atol=1e-9)
        assert 0.0 <= after[3] / before[3] <= 1.0, "less of the same yaw torque"


def test_the_yaw_that_is_left_touches_the_box():
    found = yielded([1.96 - 9.0, 1.96 + 9.0, 1.96 - 9.0, 1.96 + 9.0])
    np.testing.assert_allclose(found, [0.0, 3.92, 0.0, 3.92], atol=1e-12)


def test_a_wish_within_the_box_stays_bit_for_bit():
    for F in np.random.default_rng(1).uniform(0.0, 7.84, (100, 4)):
        np.testing.assert_array_equal(yielded(F), F)


def test_a_rate_limit_is_room_as_well():
    last = np.array([2.0, 2.1, 1.9, 2.0])
    found = yielded([1.5, 2.5, 1.5, 2.5], last, 0.25)
    np.testing.assert_allclose(found.sum(), 8.0)
    assert (np.abs(found - last) <= 0.25 + 1e-12).all()


@pytest.mark.parametrize("degrees", [90, 135, 179])
def test_a_large_yaw_step_costs_feedback_linearization_no_vehicle(degrees):
    def step(t):
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0 if t < 2.0 else np.radians(degrees)

    env = gym.make("quad/HelixTracking-v0", reference=quad_envs.from_function(step))
    policy = make_policy("feedback-linearization", env)
    assert not any(episode.crashed for episode in run_episodes(policy, env, 3, seed=0))
