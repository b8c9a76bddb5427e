"""What networks are told of disturbances: the MPCs' own estimate, in training, wrappers and flight."""

import json
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from training_estimates import assert_seen_as_in_flight

import quad_envs  # noqa: F401
from baselines import (
    CheckpointError,
    DisturbanceEstimateWrapper,
    VectorDisturbanceEstimateWrapper,
    check_policy,
    evaluate,
    make_policy,
)
from baselines.policies.checkpoints import save_checkpoint
from baselines.policies.disturbance_estimate import DisturbanceEstimator, sees_estimate, with_estimate
from baselines.policies.environments import task_of
from baselines.policies.network import Network
from baselines.policies.network_policies import EstimatingPolicy
from controllers.disturbance import ESTIMATOR_SIZE
from quad_envs.observations.features import default_features

RANDOM, CORRIDOR = "quad/RandomTracking-v0", "quad/CorridorTracking-v0"
BLOWN = {"disturbance": "gusts", "randomize": 0.2}


def network_for(task, seed=0):
    """A random network, nearly hover, that listens to the estimate."""
    features, rng = default_features(with_estimate(task).layout), np.random.default_rng(seed)
    weights = [0.02 * rng.normal(size=(len(features.names), 8)), 0.2 * rng.normal(size=(8, 4))]
    return Network(
        features,
        tuple(W.astype(np.float32) for W in weights),
        (np.zeros(8, np.float32), np.zeros(4, np.float32)),
    )


@pytest.fixture
def folder(tmp_path):
    about = {"env_id": RANDOM, "mission": "tracking", "algorithm": "apg", "kind": "model-based", "score": 0.1}
    save_checkpoint(tmp_path / "net", network_for(task_of(RANDOM)), about)
    return tmp_path / "net"


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_it_is_the_estimate_of_an_mpc_that_rejects_disturbances(noise):
    env = gym.make_vec(RANDOM, num_envs=4, sensor_noise=noise, **BLOWN)
    mpc = make_policy("lmpc", env, reject_disturbance=True)
    estimator = DisturbanceEstimator(env.unwrapped.task)
    obs, _ = env.reset(seed=3)
    state, memory, start = None, np.zeros((4, estimator.memory_size)), np.ones(4, dtype=np.bool_)
    for _ in range(30):
        seen, memory = estimator.extend(obs, memory, start)
        actions, state = mpc.predict(obs, state)
        start = np.zeros(4, dtype=np.bool_)
        theirs = state.memory[:, -ESTIMATOR_SIZE:][:, 1:7]
        # the MPC knows its command in float64, an observation in float32
        np.testing.assert_allclose(seen[:, -6:], theirs, atol=2e-4)
        obs = env.step(actions)[0]
    assert np.abs(theirs[:, 3:]).max() > 0.1


def test_a_steady_disturbance_is_found():
    env = DisturbanceEstimateWrapper(gym.make(RANDOM, disturbance=(0.3, -0.2, 0.4, 0.01, -0.02, 0.001)))
    first, _ = env.reset(seed=0)
    assert env.task.layout.slices["disturbance_estimate"] == slice(len(first) - 6, len(first))
    np.testing.assert_array_equal(first[-6:], 0.0)
    for _ in range(25):
        obs = env.step(np.zeros(4, dtype=np.float32))[0]
    # torque in body axes, then force in inertial ones
    np.testing.assert_allclose(obs[-6:], [0.01, -0.02, 0.001, 0.3, -0.2, 0.4], atol=0.02)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_a_vector_of_estimates_is_that_of_single_environments(mode):
    kwargs = {**BLOWN, "time_limit": 0.5}
    many = VectorDisturbanceEstimateWrapper(gym.make_vec(RANDOM, num_envs=3, autoreset_mode=mode, **kwargs))
    singles = [DisturbanceEstimateWrapper(gym.make(RANDOM, **kwargs)) for _ in range(3)]
    rows, _ = many.reset(seed=5)
    ones = [env.reset(seed=5 + i)[0] for i, env in enumerate(singles)]
    rng, finals = np.random.default_rng(0), 0
    for _ in range(24):
        np.testing.assert_array_equal(rows, ones)
        actions = rng.uniform(-0.1, 0.1, (3, 4)).astype(np.float32)
        again = many.env._any_done if mode is AutoresetMode.NEXT_STEP else False
        rows, _, _, truncated, infos = many.step(actions)
        ones = [
            env.reset()[0] if again else env.step(action)[0]
            for env, action in zip(singles, actions, strict=True)
        ]
        if "final_obs" in infos:
            np.testing.assert_array_equal(np.stack(infos["final_obs"].tolist()), ones)
            ones, finals = [env.reset()[0] for env in singles], finals + 1
    assert finals == (2 if mode is AutoresetMode.SAME_STEP else 0) and not truncated.any()


def test_a_network_flies_with_the_estimate_wherever_it_is_named(folder):
    assert json.loads((folder / "policy.json").read_text())["format"] == 4
    policy = make_policy(str(folder), RANDOM)
    assert isinstance(policy, EstimatingPolicy) and sees_estimate(policy.network.features)
    check_policy(policy, RANDOM)
    env = DisturbanceEstimateWrapper(gym.make(RANDOM, **BLOWN))
    seen, _ = env.reset(seed=1)
    own = EstimatingPolicy(network_for(env.unwrapped.task), env.unwrapped.task, "own")
    state = None
    for step in range(10):
        action, state = own.predict(seen[:-6], state, np.array([step == 0]))
        expected = own._network.predict(seen)[0]
        np.testing.assert_array_equal(action, expected)
        seen = env.step(action)[0]
    found = evaluate(make_policy(str(folder), RANDOM), RANDOM, 2)
    assert len(found.records) == 2


def test_a_safety_filter_stands_before_it_too(folder):
    found = evaluate(f"safe:{folder}", CORRIDOR, 1)
    assert found.records[0].violation_share == 0.0


def test_the_rows_of_a_batch_are_estimated_one_by_one():
    task = task_of(RANDOM)
    estimator, rng = DisturbanceEstimator(task), np.random.default_rng(0)
    obs = rng.normal(size=(2, 3, task.layout.size)).astype(np.float32)
    zeros, starts = np.zeros((3, estimator.memory_size)), np.array([True, False, True])
    _, kept = estimator.extend(obs[0], zeros, np.ones(3, dtype=np.bool_))
    together, _ = estimator.extend(obs[1], kept, starts)
    for j in range(3):
        alone, _ = estimator.extend(obs[1][j : j + 1], kept[j : j + 1], starts[j : j + 1])
        np.testing.assert_array_equal(alone[0], together[j])
    np.testing.assert_array_equal(together[starts, -6:], 0.0)
    assert np.abs(together[1, -6:]).max() > 0.0 and not zeros.any()


def test_what_is_revealed_is_not_estimated_again():
    env = gym.make(RANDOM, disturbance=(0.4, 0.0, 0.0), reveal_disturbance=True)
    wrapped = DisturbanceEstimateWrapper(env)
    wrapped.reset(seed=0)
    for _ in range(20):
        obs = wrapped.step(np.zeros(4, dtype=np.float32))[0]
    assert np.abs(obs[-6:]).max() < 0.01


def test_vehicles_on_rails_and_other_environments_have_no_estimate():
    with pytest.raises(ValueError, match="of vehicles that fly, and quad/CooperativeEstimation-v0 is a task"):
        DisturbanceEstimator(task_of("quad/CooperativeEstimation-v0"))
    with pytest.raises(ValueError, match="in a tracking environment of this suite"):
        DisturbanceEstimateWrapper(gym.make("CartPole-v1"))


@pytest.mark.parametrize("algorithm", ["apg", "dagger", "ppo", "sac"])
def test_every_learner_of_one_vehicle_trains_with_it_under_conditions(tmp_path, algorithm):
    pytest.importorskip("stable_baselines3")
    from baselines import train

    conditions = {"reference": "mixture", "sensor_noise": 0.005, "kappa": 0.6, "time_limit": 2.0, **BLOWN}
    hyper = {"disturbance_estimate": True, "n_envs": 8, "net_arch": [8]}
    steps = 6_000 if algorithm == "sac" else 2_000
    result = train(RANDOM, algorithm, steps=steps, env_kwargs=conditions, hyper=hyper, out=tmp_path / "run")
    policy = make_policy(result.folder, RANDOM)
    assert (
        isinstance(policy, EstimatingPolicy)
        and policy.network.features.names[-1] == "disturbance_estimate[5]"
    )
    assert evaluate(policy, RANDOM, 1).records[0].steps > 0


def test_training_flights_show_networks_what_they_see_in_flight():
    pytest.importorskip("torch")
    from baselines.training.features import training_features
    from baselines.training.flights import DifferentiableFlights
    from baselines.training.held_out import training_options

    options = training_options(RANDOM, {"randomize": 0.2})
    flights = DifferentiableFlights(options, 6, 0, training_features(options, disturbance_estimate=True))
    flights._cut[:] = [3, 5, 7, 9, 11, 100]
    assert_seen_as_in_flight(flights)


def test_a_team_is_not_trained_in_axes_of_a_heading():
    pytest.importorskip("torch")
    from baselines.training.features import training_features
    from baselines.training.held_out import training_options

    with pytest.raises(ValueError, match="hyperparameter heading_axes is for one vehicle"):
        training_features(training_options("quad/Formation-v0", {}), heading_axes=True)


def test_a_model_of_sb3_under_both_wrappers_flies_from_its_checkpoint(tmp_path):
    pytest.importorskip("stable_baselines3")
    from stable_baselines3 import PPO

    from baselines import export_policy, sb3
    from quad_envs.wrappers import FilterAndRescale

    env = FilterAndRescale(DisturbanceEstimateWrapper(gym.make(RANDOM, **BLOWN)))
    model = PPO("MlpPolicy", env, n_steps=16, batch_size=16, seed=0)
    model.save(tmp_path / "model.zip")
    with pytest.raises(CheckpointError, match="quad-envs export"):
        sb3(tmp_path / "model.zip")
    export_policy(tmp_path / "model.zip", tmp_path / "net", env=RANDOM)
    plain, state = gym.make(RANDOM, **BLOWN), None
    policy = make_policy(tmp_path / "net", plain)
    (obs, _), (raw, _) = env.reset(seed=0), plain.reset(seed=0)
    for _ in range(10):
        output = model.predict(obs, deterministic=True)[0]
        action, state = policy.predict(raw, state)
        np.testing.assert_allclose(action, env.action(output), atol=1e-5)
        obs, raw = env.step(output)[0], plain.step(env.action(output))[0]


def test_features_without_the_estimate_are_as_before():
    task = task_of(RANDOM)
    assert not sees_estimate(default_features(task.layout))
    assert replace(with_estimate(task).layout, disturbance_estimate=False) == task.layout
