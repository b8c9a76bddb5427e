"""`FilterAndRescale`: the environment as learners need it, and what is trained under it."""

import copy
import json
import pickle

import gymnasium as gym
import numpy as np
import pytest

from baselines import CheckpointError, check_policy, evaluate, export_policy, make_policy, sb3
from baselines.__main__ import main
from quad_envs import formation_v0
from quad_envs.observations.features import entry_names
from quad_envs.registration import TRACKING
from quad_envs.wrappers import FilterAndRescale, vector
from quad_envs.wrappers.encoded_space import encoder_of

HELIX, CORRIDOR = "quad/HelixTracking-v0", "quad/CorridorTracking-v0"


def outputs_for(seed, rows=1, size=4):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (rows, size)).astype(np.float32)


@pytest.mark.parametrize("env_id", TRACKING)
def test_six_stages_and_the_own_state_are_seen_scaled(env_id):
    plain, env = gym.make(env_id), FilterAndRescale(gym.make(env_id))
    observation, seen = plain.reset(seed=3)[0], env.reset(seed=3)[0]
    layout = plain.unwrapped.task.layout
    kept = [name for name in entry_names(layout) if not name.startswith("preview")]
    kept += [f"preview[{stage}][{k}]" for stage in (0, 2, 5, 10, 15, 25) for k in range(8)]
    features = env.encoder.encoding.features
    assert list(features.names) == kept and env.observation_space.shape == seen.shape == (len(kept),)
    wanted = (observation[features.columns(layout)] - np.array(features.mean)) / np.array(features.scale)
    np.testing.assert_allclose(seen, wanted, rtol=1e-5, atol=1e-6)  # roundings of float32
    assert seen.dtype == np.float32 and env.observation_space.contains(seen)
    assert np.abs(seen).max() < 4.0


@pytest.mark.parametrize("kappa", [1.0, 0.3125, (1.0, 0.5, 0.3, 0.9)])
def test_outputs_command_an_eighth_of_the_weight_about_hover_within_the_box(kappa):
    env = FilterAndRescale(gym.make(HELIX, kappa=kappa))
    task, outputs = env.unwrapped.task, outputs_for(0, 50)
    env.reset(seed=0)
    for row in outputs:
        seen = env.step(row)[0]
        # The last command stands in the features, scaled.
        names = env.encoder.encoding.features.names
        first = names.index("last_command[0]")
        command = 1.96 + 2.0 * seen[first : first + 4]
        wanted = np.minimum(task.hover_force + task.params.weight / 8.0 * row, task.force_max)
        np.testing.assert_allclose(command, wanted, atol=2e-6)  # float32


def test_rows_of_a_vector_are_single_environments():
    single = [FilterAndRescale(gym.make(HELIX, time_limit=1.0)) for _ in range(3)]
    many = vector.FilterAndRescale(gym.make_vec(HELIX, num_envs=3, time_limit=1.0))
    seen, _ = many.reset(seed=7)
    np.testing.assert_array_equal(seen, [env.reset(seed=7 + i)[0] for i, env in enumerate(single)])
    assert many.single_observation_space == single[0].observation_space
    for k in range(20):
        outputs = outputs_for(k, 3)
        seen, rewards, terminated, truncated, infos = many.step(outputs)
        rows = [env.step(row) for env, row in zip(single, outputs, strict=True)]
        np.testing.assert_array_equal(seen, [row[0] for row in rows])
        np.testing.assert_array_equal(rewards, [row[1] for row in rows])
        np.testing.assert_array_equal(terminated | truncated, [row[2] or row[3] for row in rows])
        np.testing.assert_array_equal(infos["cost"], [row[4]["cost"] for row in rows])
    assert truncated.all() and many.observation_space.contains(seen)


def test_the_last_observation_of_an_episode_is_features_too():
    make = dict(num_envs=2, time_limit=0.5)
    many = vector.FilterAndRescale(gym.make_vec(HELIX, autoreset_mode="SameStep", **make))
    plain = gym.make_vec(HELIX, autoreset_mode="SameStep", **make)
    many.reset(seed=0), plain.reset(seed=0)
    for k in range(10):
        outputs = outputs_for(k, 2)
        infos = many.step(outputs)[4]
        expected = plain.step(many.encoder.act(outputs))[4]
    for row, raw in zip(infos["final_obs"], expected["final_obs"], strict=True):
        np.testing.assert_array_equal(row, many.encoder.see(raw))


def test_gymnasium_makes_it_again_from_its_spec():
    env = FilterAndRescale(gym.make(HELIX, preview=10), stages=(0, 10), command_range=0.25)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    np.testing.assert_array_equal(again.reset(seed=1)[0], env.reset(seed=1)[0])
    row = outputs_for(0)[0]
    np.testing.assert_array_equal(again.step(row)[0], env.step(row)[0])
    rows = gym.make_vec(HELIX, num_envs=2, vectorization_mode="sync", wrappers=[FilterAndRescale])
    assert rows.reset(seed=0)[0].shape == (2, 66)


def test_a_shorter_preview_has_fewer_stages():
    assert FilterAndRescale(gym.make(HELIX, preview=6)).observation_space.shape == (18 + 3 * 8,)


def test_its_space_says_in_json_what_was_done():
    space = FilterAndRescale(gym.make(CORRIDOR), command_range=0.25).observation_space
    for same in (copy.deepcopy(space), pickle.loads(pickle.dumps(space))):
        encoder = encoder_of(json.loads(json.dumps(same.encoding)))
        assert encoder.size == 69 and encoder.encoding.command_range == 0.25
        assert encoder.task.limits.kappas == (0.3125,) * 4 and encoder.task.layout.position


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: FilterAndRescale(gym.make(HELIX), stages=(0, 30)), "stages must be some of 0 to 25"),
        (lambda: FilterAndRescale(gym.make(HELIX), stages=()), "stages must be some of 0 to 25"),
        (lambda: FilterAndRescale(gym.make(HELIX), command_range=0.0), "command_range .* above 0 .* got 0.0"),
        (lambda: FilterAndRescale(gym.make(HELIX), command_range=2), "at most 1, got 2"),
        (lambda: FilterAndRescale(gym.make("CartPole-v1")), "wraps a tracking environment .* the task None"),
        (lambda: FilterAndRescale(formation_v0.parallel_env()), "PettingZoo teams have wrappers"),
    ],
)
def test_what_it_cannot_do_is_refused(make, said):
    with pytest.raises((ValueError, AssertionError), match=said):
        make()


def test_controllers_are_refused_under_it():
    env = FilterAndRescale(gym.make(HELIX))
    with pytest.raises(ValueError, match="a wrapper changed the observation to shape"):
        make_policy("lmpc", env)
    with pytest.raises(ValueError, match="the wrapper FilterAndRescale changes observations or actions"):
        evaluate(make_policy("lmpc", HELIX), env, episodes=1)
    rows = vector.FilterAndRescale(gym.make_vec(HELIX, num_envs=2))
    with pytest.raises(ValueError, match="the wrapper FilterAndRescale changes observations or actions"):
        evaluate(make_policy("lmpc", HELIX), rows, episodes=1)


def trained(env, algorithm="PPO", **more):
    """A model whose outputs reach the edges of their box."""
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    import torch

    kind = getattr(stable_baselines3, algorithm)
    model = kind("MlpPolicy", env, seed=0, device="cpu", policy_kwargs={"net_arch": [16]}, **more)
    last = model.policy.action_net if algorithm == "PPO" else model.actor.mu
    with torch.no_grad():
        last.weight.mul_(100.0 if algorithm == "PPO" else 5.0)
    return model


def fly(model, env, seed, steps=60):
    """Return of a model in the environment that it was trained in."""
    seen, total = env.reset(seed=seed)[0], 0.0
    for _ in range(steps):
        seen, reward, terminated, truncated, _ = env.step(model.predict(seen, deterministic=True)[0])
        total += reward
        if terminated or truncated:
            break
    return total / steps


@pytest.mark.parametrize(("env_id", "algorithm"), [(HELIX, "PPO"), (CORRIDOR, "PPO"), (HELIX, "SAC")])
def test_a_model_trained_under_it_flies_the_environment_as_it_is(env_id, algorithm, tmp_path, capsys):
    env = FilterAndRescale(gym.make(env_id, time_limit=3.0))
    model = trained(env, algorithm, **({"buffer_size": 100} if algorithm == "SAC" else {}))
    expected = [fly(model, env, seed) for seed in (0, 1)]
    model.save(tmp_path / "model.zip")
    assert main(["export", str(tmp_path / "model.zip"), str(tmp_path / "net"), "--env", env_id]) == 0
    assert capsys.readouterr().out.startswith(algorithm.lower())
    plain = gym.make(env_id, time_limit=3.0)
    policies = [sb3(model), sb3(tmp_path / "model.zip"), make_policy(tmp_path / "net", plain)]
    for policy in policies:
        check_policy(policy, plain)
        found = [record.score for record in evaluate(policy, plain, episodes=2).records]
        # The checkpoint folds the scaling into its first layer: other roundings, which flights amplify.
        assert found == pytest.approx(expected, abs=1e-4)
    said = json.loads((tmp_path / "net" / "policy.json").read_text())
    assert said["command_range"] == 0.5 and said["commands"] == "hover" and said["format"] == 3
    itself = evaluate(model, env, episodes=2)  # the model in its own environment
    assert [record.score for record in itself.records] == pytest.approx(expected, abs=1e-6)


def test_the_statistics_of_vecnormalize_stand_after_it(tmp_path):
    common = pytest.importorskip("stable_baselines3.common.vec_env")
    env = common.VecNormalize(common.DummyVecEnv([lambda: FilterAndRescale(gym.make(HELIX))]), clip_obs=1.5)
    model = trained(env, n_steps=64, batch_size=64, n_epochs=1)
    model.learn(128)
    model.save(tmp_path / "model.zip")
    env.save(tmp_path / "stats.pkl")
    wrapped = env.venv.envs[0]
    rows = np.stack([wrapped.unwrapped.reset(seed=seed)[0] for seed in range(20)])
    seen = env.normalize_obs(wrapped.encoder.see(rows))
    assert (np.abs(seen) == 1.5).any()
    expected = wrapped.encoder.act(model.predict(seen.astype(np.float32), deterministic=True)[0])
    trusted = sb3(tmp_path / "model.zip", tmp_path / "stats.pkl")
    export_policy(model, tmp_path / "net", env=wrapped, vecnormalize=tmp_path / "stats.pkl")
    for policy in (trusted, make_policy(tmp_path / "net", HELIX)):
        assert np.abs(policy.predict(rows)[0] - expected).max() < 1e-5


def test_a_model_of_another_vehicle_or_layout_is_refused(tmp_path):
    model = trained(FilterAndRescale(gym.make(HELIX)))
    with pytest.raises(ValueError, match=r"limits\.kappa is 1\.0 for the policy and 0\.4 in the environment"):
        evaluate(sb3(model), gym.make(HELIX, kappa=0.4), episodes=1)
    short = gym.make(HELIX, preview=3)
    with pytest.raises(ValueError, match=r"layout\.preview is 25 for the policy and 3"):
        evaluate(sb3(model), short, episodes=1)
    with pytest.raises(CheckpointError, match=r"of another task than .*the network sees preview\[5\]"):
        export_policy(model, tmp_path / "net", env=short)
    assert evaluate(make_policy(export_policy(model, tmp_path / "net"), HELIX), HELIX, 1).flights == 1


def test_an_encoding_that_something_else_wrote_is_refused(tmp_path):
    env = FilterAndRescale(gym.make(HELIX))
    for change in ({"kappa": [0.1]}, {"names": ["V_B[0]"]}, {"layout": {"sight": 3}}):
        model = trained(env)
        model.observation_space.encoding = {**env.observation_space.encoding, **change}
        with pytest.raises(CheckpointError, match="encoding"):
            export_policy(model, tmp_path / "net")


def test_stable_baselines3_makes_vectors_of_it():
    tools = pytest.importorskip("stable_baselines3.common.env_util")
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    checker.check_env(FilterAndRescale(gym.make(HELIX)))
    rows = tools.make_vec_env(HELIX, n_envs=3, wrapper_class=FilterAndRescale)
    model = trained(rows, n_steps=8, batch_size=8, n_epochs=1).learn(24)
    assert evaluate(sb3(model), HELIX, episodes=1).flights == 1
