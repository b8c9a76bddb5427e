"""What stands between a policy and its task: wrappers, names, and the models of Stable-Baselines3."""

import gymnasium as gym
import numpy as np
import pytest

from baselines import check_policy, evaluate, make_policy


@pytest.mark.parametrize(
    "wrap",
    [
        gym.wrappers.NormalizeObservation,
        lambda env: gym.wrappers.TransformObservation(env, lambda obs: 2.0 * obs, env.observation_space),
        lambda env: gym.wrappers.RescaleAction(env, np.float32(-2.0), np.float32(2.0)),
        lambda env: gym.wrappers.RecordEpisodeStatistics(gym.wrappers.NormalizeObservation(env)),
    ],
)
def test_a_wrapper_that_changes_the_numbers_above_a_controller_is_refused_by_name(wrap):
    env = gym.make("quad/HelixTracking-v0")
    with pytest.raises(ValueError, match=r"the wrapper \w+ changes .*policy 'lmpc'.*env\.unwrapped"):
        evaluate(make_policy("lmpc", env), wrap(env), episodes=1)


def test_the_same_holds_for_vector_environments():
    env = gym.make_vec("quad/HelixTracking-v0", num_envs=2)
    with pytest.raises(ValueError, match="the wrapper NormalizeObservation changes"):
        evaluate(make_policy("lqr", env), gym.wrappers.vector.NormalizeObservation(env), episodes=2)


@pytest.mark.parametrize(
    "wrap",
    [
        gym.wrappers.RecordEpisodeStatistics,
        gym.wrappers.NormalizeReward,
        gym.wrappers.FlattenObservation,
    ],
)
def test_wrappers_that_leave_the_numbers_alone_change_no_score(wrap):
    env = gym.make("quad/HelixTracking-v0")
    plain = evaluate("lqr", env, episodes=1).records[0]
    wrapped = evaluate(make_policy("lqr", env), wrap(env), episodes=1).records[0]
    assert wrapped.position_rms == plain.position_rms


def test_evaluate_takes_the_name_of_a_policy():
    by_name = evaluate("lqr", "quad/HelixTracking-v0", episodes=2)
    env = gym.make("quad/HelixTracking-v0")
    made = evaluate(make_policy("lqr", env), env, episodes=2)
    assert [r.score for r in by_name.records] == [r.score for r in made.records]
    with pytest.raises(ValueError, match="lqr"):
        evaluate("lqrr", "quad/HelixTracking-v0")


@pytest.mark.parametrize("algorithm", ["PPO", "SAC"])
def test_models_of_stable_baselines3_pass_the_check_and_fly_deterministically(algorithm):
    """They draw by default: two evaluations agree only if `deterministic=True` is passed."""
    sb3 = pytest.importorskip("stable_baselines3")
    env = gym.make("quad/RandomTracking-v0")
    model = getattr(sb3, algorithm)("MlpPolicy", env, seed=0, device="cpu")
    check_policy(model, env)
    first, second = (evaluate(model, env, episodes=1).records[0] for _ in range(2))
    assert first.score == second.score


def test_a_model_under_the_wrapper_it_was_trained_with_flies():
    sb3 = pytest.importorskip("stable_baselines3")
    env = gym.wrappers.NormalizeObservation(gym.make("quad/RandomTracking-v0"))
    model = sb3.PPO("MlpPolicy", env, seed=0, device="cpu")
    assert evaluate(model, env, episodes=1).flights == 1
