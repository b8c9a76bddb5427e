"""The gain of the disturbance estimator: from the noise of the sensors, the best one for its structure."""

import itertools

import gymnasium as gym
import numpy as np
import pytest

import quad_envs  # noqa: F401  registers the ids
from baselines import evaluate, make_policy
from controllers import LinearMPC
from controllers.disturbance import ESTIMATOR_GAIN
from controllers.mpc.estimator_gain import error_variance, estimator_gains
from quad_envs.tasks import Task


def simulated_variance(gain, wander, differenced, white, steps=200_000):
    """Of d_hat - d for a scalar channel: a random walk seen through both kinds of noise."""
    rng = np.random.default_rng(0)
    n = np.sqrt(differenced) * rng.standard_normal(steps + 1)
    seen = np.diff(n) + np.sqrt(white) * rng.standard_normal(steps)
    walk = np.sqrt(wander) * rng.standard_normal(steps)
    error, errors = 0.0, np.empty(steps)
    for k in range(steps):
        error += gain * (seen[k] - error)  # the residual is d - d_hat + noise
        error -= walk[k]
        errors[k] = error
    return errors[steps // 10 :].var()


@pytest.mark.parametrize("gain", [0.05, 0.2, 0.5])
@pytest.mark.parametrize("channel", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.1, 0.5, 0.2)])
def test_the_error_of_the_estimate_is_as_stated(gain, channel):
    """Two hundred thousand samples of a process that remembers 20: 3 % of the variance."""
    assert simulated_variance(gain, *channel) == pytest.approx(error_variance(gain, *channel), rel=0.05)


def test_without_noise_the_gain_is_the_largest_and_noise_lowers_it():
    gains = [estimator_gains(Task(sensor_noise=(0.0, s, s, s))) for s in (0.0, 0.001, 0.01, 0.1)]
    np.testing.assert_array_equal(gains[0], ESTIMATOR_GAIN)
    for more, less in itertools.pairwise(gains):
        assert (less <= more).all() and (less < more).any()
    assert (gains[-1] >= 1e-3).all()


def test_noise_of_the_position_alone_changes_nothing():
    """The estimator compares velocities and rates only."""
    np.testing.assert_array_equal(estimator_gains(Task(sensor_noise=(0.1, 0.0, 0.0, 0.0))), ESTIMATOR_GAIN)


def test_a_number_is_the_gain_of_every_channel():
    mpc = LinearMPC(Task(sensor_noise=(0.1,) * 4), reject_disturbance=True, estimator_gain=0.3)
    np.testing.assert_array_equal(mpc._data.gain, 0.3)
    with pytest.raises(ValueError, match=r"estimator_gain must be 'auto' or lie in \(0, 1\], got 2"):
        LinearMPC(Task(), estimator_gain=2)


def test_a_scale_multiplies_the_gain_that_follows_the_noise_up_to_one():
    task = Task(sensor_noise=(0.0, 0.01, 0.01, 0.01))
    auto = estimator_gains(task)

    def gain(task, **options):
        return LinearMPC(task, reject_disturbance=True, **options)._data.gain

    np.testing.assert_allclose(gain(task, estimator_gain_scale=1.5), 1.5 * auto)
    np.testing.assert_array_equal(gain(Task(), estimator_gain_scale=10.0), 1.0)
    for scale in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match="estimator_gain_scale must be a finite number > 0"):
            LinearMPC(task, estimator_gain_scale=scale)
    with pytest.raises(ValueError, match="give the product as estimator_gain"):
        LinearMPC(task, estimator_gain=0.3, estimator_gain_scale=2.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lmpc", "sdc-nmpc", "nmpc"])
def test_under_sensor_noise_the_estimator_costs_little_and_keeps_what_it_gains_in_gusts(name):
    def score(policy, **options):
        env = gym.make_vec("quad/HelixTracking-v0", num_envs=20, sensor_noise=0.01, **options)
        return evaluate(make_policy(name, env, **policy), env, episodes=20).summary()["score"].mean

    assert score({"reject_disturbance": True}) > score({}) - 0.02
    gusts = {"disturbance": "gusts"}
    assert score({"reject_disturbance": True}, **gusts) > score({}, **gusts) + 0.02
