"""Estimates of the disturbance in teams: each agent from its own row, in training and in flight."""

from dataclasses import replace

import numpy as np
import pytest
from training_estimates import assert_seen_as_in_flight

from baselines import check_policy, evaluate, make_policy
from baselines.policies.disturbance_estimate import DisturbanceEstimator, with_estimate
from baselines.policies.environments import task_of
from baselines.policies.network import Network
from baselines.policies.network_policies import EstimatingPolicy, network_policy
from baselines.policies.trained import load_policy
from baselines.training.beginning import require_continuable, with_estimate_inputs
from baselines.training.features import training_features
from baselines.training.held_out import training_options
from baselines.training.imitation import LabelledFlights, make_expert
from baselines.training.team_flights import DifferentiableTeams
from controllers.disturbance import ESTIMATOR_SIZE
from quad_envs import formation_v0, target_tracking_v0
from quad_envs.observations.features import default_features
from quad_envs.wrappers.encoding import hover_actions

FORMATION, TARGET = "quad/Formation-v0", "quad/TargetTracking-v0"
BLOWN = {"vehicles": 3, "formation": "triangle", "disturbance": "gusts"}


def listening(options, size=0.05):
    """A small random network that sees what networks in training see, and an estimate of the disturbance."""
    features = training_features(options, disturbance_estimate=True)
    W = size * np.random.default_rng(0).normal(size=(len(features.names), 4))
    return Network(features, (W.astype(np.float32),), (np.zeros(4, np.float32),))


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_it_is_the_estimate_of_a_team_of_mpcs_that_reject_disturbances(noise):
    env = formation_v0.vector_env(2, sensor_noise=noise, **BLOWN)
    mpc = make_policy("consensus-mpc", env.task, reject_disturbance=True)
    estimator = DisturbanceEstimator(env.task)
    obs, _ = env.reset(seed=3)
    state, memory, start = None, np.zeros((6, estimator.memory_size)), np.ones(6, dtype=np.bool_)
    behind = 6 * mpc.controller.horizon  # planned positions and velocities
    for _ in range(30):
        seen, memory = estimator.extend(obs, memory, start)
        actions, state = mpc.predict(obs, state)
        start = np.zeros(6, dtype=np.bool_)
        theirs = state.memory[:, -behind - ESTIMATOR_SIZE :][:, 1:7]
        # the MPC knows its command in float64, an observation in float32
        np.testing.assert_allclose(seen[:, -6:], theirs, atol=2e-4)
        obs = env.step(actions)[0]
    assert np.abs(theirs[:, 3:]).max() > 0.1


def test_the_part_of_the_estimate_is_the_last_and_has_a_name():
    task = task_of(FORMATION)
    seen = with_estimate(task).layout
    assert seen.slices["disturbance_estimate"] == slice(task.layout.size, task.layout.size + 6)
    assert default_features(seen).names[-6:] == tuple(f"disturbance_estimate[{k}]" for k in range(6))
    assert replace(seen, disturbance_estimate=False) == task.layout


def test_every_agent_estimates_from_its_own_row_alone():
    options = training_options(FORMATION, BLOWN)
    env = formation_v0.vector_env(2, **BLOWN)
    policy = network_policy(listening(options), env.task, "mine")
    rows, alone = env.reset(seed=0)[0], network_policy(listening(options), env.task, "mine")
    state = kept = None
    for _ in range(10):
        actions, state = policy.predict(rows, state)
        action, kept = alone.predict(rows[4], kept)
        # layers of one row are summed in another order, in float32
        np.testing.assert_allclose(action, actions[4], atol=1e-6)
        rows = env.step(actions)[0]
    np.testing.assert_array_equal(kept.memory[0], state.memory[4])
    assert np.abs(kept.memory).max() > 0.0


@pytest.mark.parametrize("env_id", [FORMATION, TARGET])
def test_a_network_that_listens_keeps_to_the_protocol(env_id):
    module = {FORMATION: formation_v0, TARGET: target_tracking_v0}[env_id]
    env = module.parallel_env(max_cycles=30, disturbance="gusts")
    policy = network_policy(listening(training_options(env_id, {})), env.task, "mine")
    assert isinstance(policy, EstimatingPolicy)
    check_policy(policy, env)


def test_beside_a_target_a_network_may_have_both_estimates():
    options = training_options(TARGET, {})
    both, task = listening(options), options.task
    target = Network(training_features(options), (both.weights[0][:-6].copy(),), both.biases)
    deaf = replace(both, weights=(np.concatenate([both.weights[0][:-6], np.zeros((6, 4), np.float32)]),))
    env = target_tracking_v0.vector_env(1, disturbance=(0.5, 0.0, 0.0))
    policies = [network_policy(network, task, "mine") for network in (both, deaf, target)]
    states, rows = [None] * 3, env.reset(seed=0)[0]
    for _ in range(10):
        made = [policy.predict(rows, state) for policy, state in zip(policies, states, strict=True)]
        states, actions = [state for _, state in made], [action for action, _ in made]
        rows = env.step(actions[2])[0]
    np.testing.assert_allclose(actions[1], actions[2], atol=1e-6)
    assert np.abs(actions[0] - actions[2]).max() > 1e-3
    np.testing.assert_array_equal(states[0].estimates.r, states[2].estimates.r)


def test_where_an_estimate_of_the_target_stands_the_gradient_knows_beside_that_of_the_disturbance():
    options = training_options(TARGET, {})
    flights = DifferentiableTeams(options, 6, 0, training_features(options, disturbance_estimate=True))
    flights.begin_window(1)
    step = flights.advance(np.zeros((6, 4), np.float32))
    bar = np.zeros((6, len(flights.features.names)), np.float32)
    at = [flights.features.names.index(f"estimate[0][{k}]") for k in (1, 2, 3)]
    bar[:, at] = np.random.default_rng(0).normal(size=(6, 3))
    bar[:, -6:] = 1.0  # through the estimate of the disturbance no gradient passes
    plants, commands = flights.observe_vjp(step, bar)
    expected = np.zeros((6, 16))
    expected[:, :3] = -bar[:, at] / np.asarray(flights.features.scale)[at]
    assert np.allclose(plants, expected) and not commands.any()


def test_teams_in_training_see_what_they_see_in_flight():
    options = training_options(FORMATION, BLOWN)
    flights = DifferentiableTeams(options, 9, 0, training_features(options, disturbance_estimate=True))
    flights._cut[:] = [3, 6, 100]
    flights.begin_window(15)
    assert_seen_as_in_flight(flights)
    assert np.abs(flights.observe()[:, -3:]).max() > 0.1


def test_labels_are_of_an_expert_that_rejects_what_the_network_sees():
    options = training_options(FORMATION, BLOWN)
    expert = make_expert("", options.task, reject_disturbance=True)
    flights = LabelledFlights(options, expert, 6, 0, disturbance_estimate=True)
    mpc, seen, state = make_policy("consensus-mpc", options.task, reject_disturbance=True), None, None
    estimator = DisturbanceEstimator(options.task)
    memory, start = np.zeros((6, estimator.memory_size)), np.ones(6, dtype=np.bool_)
    for _ in range(15):
        seen = flights._observations
        wanted, state = mpc.predict(seen, state, start)
        x, labels, _ = flights.collect(listening(options, 0.0), 1.0, 1)
        found, memory = estimator.extend(seen, memory, start)
        np.testing.assert_allclose(x[:, -6:], found[:, -6:] / flights.encoder.encoding.features.scale[-6:])
        inside = np.abs(labels) < 1.0
        assert np.allclose(hover_actions(labels, flights.task)[inside], wanted[inside], atol=1e-6)
        start = np.zeros(6, dtype=np.bool_)


@pytest.mark.parametrize("algorithm", ["apg", "dagger", "ppo", "mappo"])
def test_every_learner_of_teams_trains_with_it_in_gusts(tmp_path, algorithm):
    pytest.importorskip("stable_baselines3")
    from baselines import train

    hyper = {"disturbance_estimate": True, "n_envs": 9, "net_arch": [8]}
    kwargs = BLOWN | {"disturbance": "varied-gusts", "max_cycles": 20, "sensor_noise": 0.005}
    result = train(FORMATION, algorithm, steps=2_000, env_kwargs=kwargs, hyper=hyper, out=tmp_path / "run")
    env = formation_v0.vector_env(1, **kwargs)
    policy = load_policy(result.folder, env)
    assert isinstance(policy, EstimatingPolicy)
    assert policy.network.features.names[-1] == "disturbance_estimate[5]"
    assert evaluate(policy, env, 1).records[0].steps > 0


def test_a_training_goes_on_from_a_network_that_does_not_listen_yet(tmp_path):
    pytest.importorskip("torch")
    from baselines import train

    kwargs = {"formation": "hexagon", "disturbance": "gusts", "max_cycles": 20}
    env = formation_v0.vector_env(2, **kwargs)
    deaf = load_policy("dagger-formation", env)
    more = network_policy(with_estimate_inputs(deaf.network, env.task), env.task, "more")
    rows, state = env.reset(seed=0)[0], None
    for _ in range(5):
        actions, state = more.predict(rows, state)
        np.testing.assert_allclose(actions, deaf.predict(rows)[0], atol=1e-6)
        rows = env.step(actions)[0]
    assert with_estimate_inputs(more.network, env.task) is more.network
    hyper = {"disturbance_estimate": True, "n_envs": 12}
    found = train(
        FORMATION, "apg", steps=2_000, env_kwargs=kwargs, hyper=hyper, start_from="dagger-formation",
        out=tmp_path / "run",
    )  # fmt: skip
    learned = load_policy(found.folder, env).network
    assert learned.features == more.network.features and np.abs(learned.weights[0][-6:]).max() > 0.0
    with pytest.raises(ValueError, match=r"disturbance_estimate', where .*let the training see it, too"):
        plain = training_features(training_options(FORMATION, kwargs), (0, 2, 5))
        require_continuable(learned, plain, (128, 128), 4, "clip")
