"""Training with stable-baselines3: its rows are those of our environments, its export is exact."""

from __future__ import annotations

import itertools
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

pytest.importorskip("stable_baselines3")

import torch

from baselines import evaluate
from baselines.errors import TrainingError
from baselines.policies.environments import make_env
from baselines.policies.network import NetworkPolicy
from baselines.training.held_out import training_options
from baselines.training.hyperparameters import hyperparameters, recorded_hyperparameters
from baselines.training.lagrangian import (
    CostCritic,
    LagrangianBuffer,
    LagrangianEnv,
    Multiplier,
    Probe,
    cost_advantages,
)
from baselines.training.learner import RowBuffer
from baselines.training.sb3 import (
    PpoLagrangianOptions,
    PpoOptions,
    SacOptions,
    export,
    make_flights,
    make_ppo,
    make_sac,
    train_ppo,
    train_ppo_lagrangian,
    train_sac,
)
from baselines.training.vec_env import TrainingVecEnv
from quad_envs.envs.team.options import EstimationOptions, FormationOptions, TargetTrackingOptions
from quad_envs.envs.team.vector import TeamVectorEnv
from quad_envs.envs.tracking.options import TrackingOptions
from quad_envs.envs.tracking.vector import TrackingVectorEnv
from quad_envs.registration import TRACKING
from quad_envs.wrappers import FilterAndRescale
from quad_envs.wrappers.encoding import hover_actions

pytestmark = pytest.mark.usefixtures("one_thread")
HELIX, SPIRAL = "quad/HelixTracking-v0", "quad/SpiralTracking-v0"
SHORT = {"reference": "random", "time_limit": 1.0, "preview": 3}
SMALL = PpoOptions(n_envs=8, n_steps=16, batch_size=64, n_epochs=2, net_arch=(16, 16))


def random_outputs(rng, rows, size=4):
    return rng.uniform(-1.0, 1.0, (rows, size)).astype(np.float32)


def scaled(env, observations):
    columns = env.features.columns(env.task.layout)
    return (observations[:, columns] - np.array(env.features.mean)) / np.array(env.features.scale)


def first_updates(generator, n):
    return list(itertools.islice(generator, n))


def test_rows_are_those_of_the_vector_environment_step_by_step():
    options = TrackingOptions.from_kwargs(SHORT)
    seeds = list(range(5))
    env = TrainingVecEnv(options, 5, seeds, staggered=False)
    vector = TrackingVectorEnv(5, autoreset_mode="SameStep", **SHORT)
    rng = np.random.default_rng(0)
    expected, _ = vector.reset(seed=0)
    # float32 features: one rounding of the difference, one of the product.
    np.testing.assert_allclose(env.reset(), scaled(env, expected), rtol=1e-5, atol=1e-6)
    ended = 0
    for _ in range(45):
        outputs = random_outputs(rng, 5)
        seen, rewards, dones, infos = env.step(outputs)
        expected, r, terminated, truncated, info = vector.step(hover_actions(outputs, env.task))
        np.testing.assert_allclose(seen, scaled(env, expected), rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(rewards, r.astype(np.float32))
        np.testing.assert_array_equal(dones, terminated | truncated)
        for i in np.flatnonzero(dones):
            last = scaled(env, info["final_obs"][i][None])[0]
            np.testing.assert_allclose(infos[i]["terminal_observation"], last, rtol=1e-5, atol=1e-6)
            assert infos[i]["TimeLimit.truncated"] == truncated[i]
        ended += dones.sum()
    assert ended >= 10


@pytest.mark.parametrize("teams", [1, 2])
def test_rows_are_the_vehicles_of_the_vector_environment_of_teams(teams):
    options = FormationOptions.from_kwargs({"vehicles": 3, "time_limit": 1.0})
    env = TrainingVecEnv(options, teams, [4, 5][:teams], staggered=False)
    vector = TeamVectorEnv(options, teams)
    rng = np.random.default_rng(0)
    expected, _ = vector.reset(seed=4)
    np.testing.assert_allclose(env.reset(), scaled(env, expected), rtol=1e-5, atol=1e-6)
    for _ in range(45):
        outputs = random_outputs(rng, env.num_envs)
        seen, rewards, dones, infos = env.step(outputs)
        expected, r, terminated, truncated, _ = vector.step(hover_actions(outputs, env.task))
        np.testing.assert_array_equal(rewards, r.astype(np.float32))
        np.testing.assert_array_equal(dones, terminated | truncated)
        if dones.any():
            first = infos[int(np.flatnonzero(dones)[0])]
            last = scaled(env, expected)[np.flatnonzero(dones)[0]]
            np.testing.assert_allclose(first["terminal_observation"], last, rtol=1e-5, atol=1e-6)
            if teams > 1:  # the vector environment begins anew one step later: the teams part there
                return
            expected, *_ = vector.step(np.zeros((3, 4), dtype=np.float32))
        np.testing.assert_allclose(seen, scaled(env, expected), rtol=1e-5, atol=1e-6)


def test_a_crash_is_no_truncation():
    env = TrainingVecEnv(TrackingOptions.from_kwargs({}), 1, 0, staggered=False)
    env.reset()
    for _ in range(200):
        _, _, dones, infos = env.step(np.full((1, 4), -1.0, dtype=np.float32))  # it falls
        if dones[0]:
            break
    assert dones[0]
    assert infos[0]["TimeLimit.truncated"] is False


def test_a_team_ends_as_a_whole_when_vehicles_crash():
    options = FormationOptions.from_kwargs({"vehicles": 3, "terminate": "agent"})
    env = TrainingVecEnv(options, 1, 0, staggered=False)
    env.reset()
    outputs = np.zeros((3, 4), dtype=np.float32)
    outputs[1] = [0.9, -0.9, -0.9, 0.9]  # one vehicle turns over
    for _ in range(100):
        _, rewards, dones, infos = env.step(outputs)
        if dones.any():
            break
    assert dones.all()
    assert not any(info["TimeLimit.truncated"] for info in infos)
    assert (rewards == 0.0).all()


def test_staggered_flights_do_not_end_together():
    env = TrainingVecEnv(TrackingOptions.from_kwargs({"time_limit": 5.0}), 64, 0)
    env.reset()
    ends = []
    for _ in range(40):
        _, _, dones, infos = env.step(np.zeros((64, 4), dtype=np.float32))
        ends.append(int(dones.sum()))
        assert all(infos[i]["TimeLimit.truncated"] in (True, False) for i in np.flatnonzero(dones))
    assert max(ends) < 16
    assert sum(ends) > 5


def test_short_episodes_in_training_are_truncations():
    env = TrainingVecEnv(TrackingOptions.from_kwargs({}), 2, 0, staggered=False, episode_steps=7)
    env.reset()
    ends = []
    for k in range(1, 22):
        _, _, dones, infos = env.step(np.zeros((2, 4), dtype=np.float32))
        if dones.any():
            ends.append(k)
            assert all(info["TimeLimit.truncated"] for info in infos)
    assert ends == [7, 14, 21]


def test_infos_of_rows_where_nothing_ended_cannot_be_written():
    env = TrainingVecEnv(TrackingOptions.from_kwargs({}), 2, 0, staggered=False)
    env.reset()
    infos = env.step(np.zeros((2, 4), dtype=np.float32))[3]
    with pytest.raises(TypeError):
        infos[0]["note"] = 1
    assert infos[0].get("TimeLimit.truncated", False) is False


@pytest.mark.parametrize(("algorithm", "env_id"), [("ppo", HELIX), ("ppo", SPIRAL), ("sac", HELIX)])
def test_a_learner_sees_and_commands_what_the_wrapper_shows_and_takes(algorithm, env_id):
    options = training_options(env_id, {"preview": 12})
    flights = make_flights(options, replace(hyperparameters(algorithm, env_id), n_envs=1), [5])
    wrapper = FilterAndRescale(gym.make(env_id, preview=12))
    assert flights.encoder.encoding == wrapper.encoder.encoding
    np.testing.assert_array_equal(flights.reset()[0], wrapper.reset(seed=5)[0])
    outputs = random_outputs(np.random.default_rng(1), 1)
    np.testing.assert_array_equal(flights.step(outputs)[0][0], wrapper.step(outputs[0])[0])


def test_what_earlier_versions_recorded_keeps_their_range_of_commands():
    old = {"n_envs": 64, "n_epochs": 5}
    assert recorded_hyperparameters("ppo", old)["command_range"] == 1.0
    assert recorded_hyperparameters("ppo", {**old, "command_range": 0.25})["command_range"] == 0.25
    assert "command_range" not in recorded_hyperparameters("apg", {"n_envs": 64})


def test_equal_seeds_draw_equal_starts_and_others_do_not():
    options = TrackingOptions.from_kwargs({})
    first, same, other = (TrainingVecEnv(options, 4, seed).reset() for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, same)
    assert not np.array_equal(first, other)


def test_training_starts_are_not_starts_of_evaluation():
    options = TrackingOptions.from_kwargs({})
    trained = TrainingVecEnv(options, 2, 10_000).reset()
    judged = TrainingVecEnv(options, 2, [10_000, 10_001]).reset()
    assert not np.isclose(trained[0], judged[0]).all()


def test_costs_and_violations_of_the_last_step_are_there():
    options = TrackingOptions.from_kwargs(TRACKING["quad/CorridorTracking-v0"])
    env = TrainingVecEnv(options, 16, 0)
    env.reset()
    rng, shares = np.random.default_rng(0), []
    for _ in range(20):
        env.step(random_outputs(rng, 16))
        assert ((env.costs > 0.0) == env.violated).all()
        shares.append(env.violated.mean())
    tally = env.tally()
    assert tally.violation_share == pytest.approx(np.mean(shares))
    assert env.tally() == (0.0, 0.0)


def test_a_multiplier_rises_above_its_limit_and_falls_to_zero_below():
    multiplier = Multiplier(limit=0.1, proportional=1.0, integral=2.0)
    multiplier.update(0.15)
    multiplier.update(0.9)  # counts as twice the limit
    assert multiplier.value == pytest.approx(1.0 + 2.0 * (0.5 + 1.0))
    for _ in range(20):
        multiplier.update(0.0)
    assert multiplier.value == 0.0


def test_a_limit_of_zero_is_refused():
    with pytest.raises(ValueError, match=r"limit is a share of steps, above 0 and at most 1, got 0"):
        Multiplier(0.0, 1.0, 1.0)


def corridor(rows, seed=0):
    return TrainingVecEnv(TrackingOptions.from_kwargs(TRACKING["quad/CorridorTracking-v0"]), rows, seed)


def test_violating_steps_and_crashes_cost_and_rewards_stay_what_they_are():
    plain, env, crashes = corridor(32), LagrangianEnv(corridor(32), 0.95), 0
    plain.reset()
    env.reset()
    for step in range(80):
        outputs = np.full((32, 4), -0.9, dtype=np.float32)  # all fall
        _, rewards, dones, infos = plain.step(outputs)
        _, same, _, _ = env.step(outputs)
        np.testing.assert_array_equal(same, rewards)
        crashed = np.array([done and not infos[i]["TimeLimit.truncated"] for i, done in enumerate(dones)])
        # A crash counts as violating for ever after: 1 / (1 - 0.95).
        np.testing.assert_allclose(env.costs[-1], np.where(crashed, 20.0, plain.violated), rtol=1e-6)
        cut = [row for at, row, _ in env.truncations if at == step]
        assert cut == np.flatnonzero(dones & ~crashed).tolist()
        crashes += crashed.sum()
    assert crashes > 0 and env.truncations


def test_advantages_of_costs_are_those_of_stable_baselines3():
    rng = np.random.default_rng(0)
    T, rows, gamma, trace = 12, 5, 0.97, 0.9
    buffer = RowBuffer(
        T, spaces.Box(-1, 1, (2,)), spaces.Box(-1, 1, (1,)), gae_lambda=trace, gamma=gamma, n_envs=rows
    )
    last, dones = torch.from_numpy(rng.random(rows).astype(np.float32)), rng.random(rows) < 0.3
    buffer.rewards[:], buffer.values[:] = rng.random((2, T, rows))
    buffer.episode_starts[:] = rng.random((T, rows)) < 0.2
    buffer.compute_returns_and_advantage(last, dones)
    ours = cost_advantages(
        buffer.rewards, buffer.values, last.numpy(), buffer.episode_starts, dones, gamma, trace
    )
    np.testing.assert_allclose(ours, buffer.advantages, rtol=1e-5, atol=1e-6)  # float32


@pytest.mark.parametrize("m", [0.0, 3.0])
def test_the_policy_follows_rewards_less_what_violations_cost(m):
    env, multiplier = LagrangianEnv(corridor(4), 0.95), Multiplier(0.1, 0.0, 1.0)
    multiplier.value = m
    box = spaces.Box(-1, 1, (env.observation_space.shape[0],)), spaces.Box(-1, 1, (4,))
    plain = RowBuffer(3, *box, gae_lambda=0.9, gamma=0.95, n_envs=4)
    paying = LagrangianBuffer(
        3, *box, gae_lambda=0.9, gamma=0.95, n_envs=4, env=env, multiplier=multiplier, n_epochs=0
    )
    features, zeros = env.reset(), torch.zeros(4)
    for buffer in (plain, paying):
        buffer.reset()
    for _ in range(3):
        seen = features
        features, rewards, dones, _ = env.step(np.full((4, 4), -0.9, dtype=np.float32))
        for buffer in (plain, paying):
            buffer.add(seen, np.zeros((4, 4)), rewards, np.zeros(4), zeros, zeros)
    plain.compute_returns_and_advantage(zeros, dones)
    values, last = paying.critic(plain.observations), paying.critic(features)
    costs = cost_advantages(np.stack(env.costs), values, last, plain.episode_starts, dones, 0.95, 0.9)
    assert not env.truncations and np.abs(costs).min() > 0.0
    paying.compute_returns_and_advantage(zeros, dones)
    np.testing.assert_allclose(
        paying.advantages, (plain.advantages - m * costs) / (1.0 + m), rtol=1e-5, atol=1e-6
    )


def test_a_critic_of_costs_learns_what_follows():
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    features = rng.normal(size=(2048, 3)).astype(np.float32)
    returns = 2.0 + features[:, 0]
    critic = CostCritic(3)
    critic.fit(features, returns, 400)
    assert np.abs(critic(features) - returns).mean() < 0.1  # of a standard deviation of 1


def test_violations_are_measured_without_the_noise_of_training():
    task = TrackingOptions.from_kwargs(TRACKING["quad/CorridorTracking-v0"])
    options = replace(SMALL, log_std_init=0.0)
    model = make_ppo(make_flights(task, options, 0), options, 0, lambda: 0.0)
    # A new network hovers without noise, which keeps the rate limit; with noise nothing does.
    assert Probe(make_flights(task, replace(options, n_envs=16), 1)).share(model, 10) < 0.5
    noisy = make_flights(task, replace(options, n_envs=16), 1)
    features = noisy.reset()
    for _ in range(10):
        features = noisy.step(model.predict(features)[0])[0]
    assert noisy.tally().violation_share > 0.9


def test_the_multiplier_rests_while_training_is_free(monkeypatch):
    seen = []
    monkeypatch.setattr(Multiplier, "update", lambda self, share: seen.append(share))
    task = TrackingOptions.from_kwargs(TRACKING["quad/CorridorTracking-v0"])
    options = PpoLagrangianOptions(n_envs=4, n_steps=8, batch_size=32, n_epochs=1, net_arch=(8,), free=0.5)
    share = [0.0]
    generator = train_ppo_lagrangian(task, options, 0, lambda: share[0])
    next(generator)
    assert not seen
    share[0] = 0.6
    next(generator)
    assert len(seen) == 1


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_an_exported_network_decides_as_the_learner_without_noise(algorithm):
    options = TrackingOptions.from_kwargs({})
    if algorithm == "ppo":
        env = make_flights(options, SMALL, 0)
        model = make_ppo(env, replace(SMALL, learning_rate=0.05), 0, lambda: 0.0)
    else:
        small = SacOptions(n_envs=8, batch_size=32, learning_starts=16, net_arch=(16, 16), learning_rate=0.05)
        env = make_flights(options, small, 0)
        model = make_sac(env, small, 0, lambda: 0.0)
    model.learn(8 * 32)
    policy = NetworkPolicy(export(model, env.encoder.encoding), env.task, "learned")
    vector = TrackingVectorEnv(50)
    observations, _ = vector.reset(seed=0)
    observations += np.random.default_rng(0).normal(0.0, 0.5, observations.shape).astype(np.float32)
    features = scaled(env, observations).astype(np.float32)
    outputs, _ = model.predict(features, deterministic=True)
    actions, _ = policy.predict(observations)
    assert np.abs(outputs).max() > 0.3
    # The scaling is folded into the first layer: other roundings in float32.
    np.testing.assert_allclose(actions, env.encoder.act(outputs), atol=1e-5)


@pytest.mark.parametrize(
    ("train", "options"),
    [
        (train_ppo, SMALL),
        (
            train_ppo_lagrangian,
            PpoLagrangianOptions(n_envs=8, n_steps=16, batch_size=64, n_epochs=2, net_arch=(16, 16)),
        ),
        (
            train_sac,
            SacOptions(
                n_envs=8,
                progress_steps=8,
                learning_starts=32,
                batch_size=32,
                net_arch=(16, 16),
                buffer_size=1000,
            ),
        ),
    ],
    ids=["ppo", "ppo-lagrangian", "sac"],
)
def test_equal_seeds_give_equal_runs(train, options):
    task = TrackingOptions.from_kwargs(TRACKING["quad/CorridorTracking-v0"])
    runs = [first_updates(train(task, options, seed, lambda: 0.0), 6) for seed in (1, 1, 2)]
    for (p, a), (q, b) in zip(runs[0], runs[1], strict=True):
        assert p == q
        for W, V in zip((*a.weights, *a.biases), (*b.weights, *b.biases), strict=True):
            np.testing.assert_array_equal(W, V)
    assert not np.array_equal(runs[0][-1][1].weights[0], runs[2][-1][1].weights[0])
    assert [p.update for p, _ in runs[0]] == [1, 2, 3, 4, 5, 6]
    assert runs[0][-1][0].steps == 6 * 8 * getattr(options, "n_steps", 8)


@pytest.mark.parametrize("options", [FormationOptions(vehicles=3), TargetTrackingOptions()])
def test_vehicles_of_teams_share_one_network(options):
    ((progress, network),) = first_updates(train_ppo(options, SMALL, 0, lambda: 0.0), 1)
    teams = max(1, 8 // options.vehicles)
    assert progress.steps == teams * options.vehicles * 16
    assert network.outputs == 4


def test_training_ends_with_its_budget():
    shares = iter([0.0, *[0.5] * 100])
    task = TrackingOptions.from_kwargs({})
    generator = train_ppo(task, SMALL, 0, lambda: next(shares))
    next(generator)
    shares = iter([1.0] * 10)
    assert next(generator, None) is None


def test_a_loss_that_is_not_a_number_stops_training_and_names_the_update():
    options = replace(SMALL, learning_rate=1e30)
    found = []
    with pytest.raises(TrainingError, match=r"at update \d+: the last good policy is kept"):
        for _, network in train_ppo(TrackingOptions.from_kwargs({}), options, 0, lambda: 0.0):
            found.append(network)  # a Network is finite, or it is none
            assert len(found) < 10


def test_training_goes_on_from_a_policy_which_stands_still_while_the_critic_learns():
    task, options = TrackingOptions.from_kwargs({}), replace(SMALL, critic_updates=2)
    _, start = first_updates(train_ppo(task, options, 0, lambda: 0.0), 3)[-1]
    later = [network for _, network in first_updates(train_ppo(task, options, 1, lambda: 0.0, start), 3)]
    np.testing.assert_array_equal(later[1].weights[0], start.weights[0])
    np.testing.assert_array_equal(later[1].biases[-1], start.biases[-1])
    assert not np.array_equal(later[2].weights[0], start.weights[0])


def test_a_policy_with_other_layers_is_refused_as_a_start():
    task = TrackingOptions.from_kwargs({})
    _, start = first_updates(train_ppo(task, SMALL, 0, lambda: 0.0), 1)[-1]
    with pytest.raises(ValueError, match=r"layers \[.*16.*\].*go on with the algorithm"):
        next(train_ppo(task, replace(SMALL, net_arch=(8, 8)), 0, lambda: 0.0, start))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_envs": 0}, r"n_envs must be finite and > 0, got 0"),
        ({"learning_rate": float("nan")}, r"learning_rate must be finite and > 0, got nan"),
        ({"gamma": 1.5}, r"gamma must be at most 1, got 1.5"),
        ({"net_arch": ()}, r"net_arch needs at least one layer"),
    ],
)
def test_senseless_hyperparameters_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(SMALL, **changes)


def test_stages_beyond_the_preview_are_refused():
    with pytest.raises(ValueError, match=r"the preview has stages 0 to 25, got \(0, 30\)"):
        make_flights(TrackingOptions.from_kwargs({}), replace(SMALL, stages=(0, 30)), 0)


def test_sac_is_refused_where_there_are_several_vehicles():
    with pytest.raises(ValueError, match=r"sac cannot act in quad/Formation-v0.*ppo and ppo-lagrangian"):
        next(train_sac(FormationOptions(), SacOptions(), 0, lambda: 0.0))


def test_ppo_is_refused_where_actions_are_estimates():
    with pytest.raises(ValueError, match=r"CooperativeEstimation-v0 are estimates.*TargetTracking"):
        next(train_ppo(EstimationOptions(), SMALL, 0, lambda: 0.0))


def test_ppo_lagrangian_is_refused_where_there_are_no_limits():
    with pytest.raises(ValueError, match=r"has no limits that ppo-lagrangian could keep"):
        next(
            train_ppo_lagrangian(
                TrackingOptions.from_kwargs({}), PpoLagrangianOptions(n_envs=8), 0, lambda: 0
            )
        )


@pytest.mark.slow
def test_ppo_learns_the_shared_reward_from_scratch():
    env_id, updates, last = "quad/HelixTracking-v0", 80, None
    task = TrackingOptions.from_kwargs({"env_id": env_id, **TRACKING[env_id]})
    done = iter(range(updates * 1000))
    for k, (_, network) in enumerate(train_ppo(task, PpoOptions(), 0, lambda: min(next(done) / 1e4, 0.99))):
        last = network
        if k + 1 == updates:
            break
    env = make_env(env_id)
    found = evaluate(NetworkPolicy(last, env.unwrapped.task, "ppo"), env, 10, 10_000)
    score = found.summary()["score"].mean
    assert score > 0.1  # hover scores 0.01, a network before training 0.005
