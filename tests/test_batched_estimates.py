"""Estimates in rows: the wrapper for vectors of teams, learners that see them, and networks that fly so."""

import numpy as np
import pytest

from baselines import (
    EstimateVectorWrapper,
    EstimateWrapper,
    check_policy,
    evaluate,
    load_policy,
    make_policy,
    train,
)
from baselines.errors import CheckpointError
from baselines.policies.checkpoints import save_checkpoint
from baselines.policies.network import Network, NetworkPolicy
from baselines.policies.network_policies import EstimatingPolicy, network_policy
from baselines.training.features import training_features
from baselines.training.held_out import training_options
from baselines.training.imitation import LabelledFlights, make_expert
from baselines.training.team_flights import DifferentiableTeams
from quad_envs import cooperative_estimation_v0, formation_v0, target_tracking_v0
from quad_envs.wrappers.encoding import hover_actions

TARGET = "quad/TargetTracking-v0"
LOSSY = {"delay": 1, "drop_out": 0.3, "detection": 0.7, "graph": "complete", "terminate": "agent"}


def seeing_estimates(outputs=4, size=0.05, **env_kwargs):
    """A small network that sees what networks in training see."""
    features = training_features(training_options(TARGET, env_kwargs))
    W = size * np.random.default_rng(0).normal(size=(len(features.names), outputs))
    return Network(features, (W.astype(np.float32),), (np.zeros(outputs, np.float32),))


@pytest.mark.parametrize("fusion", ["trace", "none"])
@pytest.mark.parametrize("module", [target_tracking_v0, cooperative_estimation_v0])
def test_rows_of_a_vector_of_teams_are_parallel_environments(fusion, module):
    options = {**LOSSY, "max_cycles": 25} if module is target_tracking_v0 else {"max_cycles": 12}
    together = EstimateVectorWrapper(module.vector_env(2, **options), fusion)
    singles = [EstimateWrapper(module.parallel_env(**options), fusion) for _ in range(2)]
    rows, infos = together.reset(seed=3)
    seen = [env.reset(seed=3 + t) for t, env in enumerate(singles)]
    n, rng, crashed = together.task.vehicles, np.random.default_rng(0), 0
    for _ in range(32):
        for t, env in enumerate(singles):
            for name, row in seen[t][0].items():
                j = t * n + env.possible_agents.index(name)
                np.testing.assert_array_equal(rows[j], row)
                told = seen[t][1][name]
                for key in ("nees", "nis", "nis_rows"):
                    assert infos[key][j] == pytest.approx(told[key], rel=1e-9, nan_ok=True)
        actions = rng.uniform(-0.9, 0.9, together.action_space.shape).astype(np.float32)
        rows, *_, infos = together.step(actions)
        for t, env in enumerate(singles):
            if not env.agents:
                seen[t] = env.reset()
                continue
            crashed += len(env.agents) < n
            first, own = t * n, dict(zip(env.possible_agents, actions[t * n : t * n + n], strict=True))
            assert first == t * n
            seen[t] = env.step({name: own[name] for name in env.agents})[::4]
    assert module is cooperative_estimation_v0 or crashed > 3


def test_a_reset_of_some_teams_leaves_the_filters_of_the_others_alone():
    env = EstimateVectorWrapper(target_tracking_v0.vector_env(2))
    rows, _ = env.reset(seed=0)
    for _ in range(5):
        rows, *_ = env.step(np.zeros(env.action_space.shape, np.float32))
    again, _ = env.reset(seed=9, options={"reset_mask": np.array([False, True])})
    np.testing.assert_array_equal(again[:6], rows[:6])
    fresh, _ = EstimateVectorWrapper(target_tracking_v0.vector_env(1)).reset(seed=10)
    np.testing.assert_array_equal(again[6:], fresh)


def test_a_vector_without_a_target_has_nothing_to_estimate():
    with pytest.raises(ValueError, match="there is no target to estimate"):
        EstimateVectorWrapper(formation_v0.vector_env(1))
    with pytest.raises(ValueError, match=r"needs the vector_env of quad_envs\.target_tracking_v0"):
        EstimateVectorWrapper(target_tracking_v0.parallel_env())


def test_a_network_with_its_own_filter_flies_as_one_that_is_told():
    network, options = seeing_estimates(**LOSSY), LOSSY
    told = EstimateVectorWrapper(target_tracking_v0.vector_env(2, **options), "none")
    plain = target_tracking_v0.vector_env(2, **options)
    own, inner = network_policy(network, plain.task, "mine"), network_policy(network, told.task, "mine")
    assert isinstance(own, EstimatingPolicy) and isinstance(inner, NetworkPolicy)
    rows, seen, state = told.reset(seed=1)[0], plain.reset(seed=1)[0], None
    start, done, begun = np.ones(12, np.bool_), np.zeros(2, np.bool_), 0
    for _ in range(40):
        wanted, (actions, state) = inner.predict(rows)[0], own.predict(seen, state, start)
        np.testing.assert_allclose(actions, wanted, rtol=0, atol=1e-6)
        rows, (seen, _, terminated, truncated, _) = told.step(actions)[0], plain.step(actions)
        start, begun = np.repeat(done, 6), begun + done.sum()
        done = (terminated | truncated).reshape(2, 6).all(axis=1)
    assert begun > 0 and state.estimates.P.shape == (12, 6, 6)


def test_a_network_with_its_own_filter_keeps_to_the_protocol():
    env = target_tracking_v0.parallel_env(max_cycles=30)
    check_policy(network_policy(seeing_estimates(), env.task, "mine"), env)


def test_evaluations_of_a_vector_with_estimates_are_those_of_single_teams():
    options = {"max_cycles": 30}
    together = EstimateVectorWrapper(target_tracking_v0.vector_env(2, **options))
    single = EstimateWrapper(target_tracking_v0.parallel_env(**options))
    rows = evaluate(make_policy("cooperative-mpc", together.task), together, 2, 5).records
    alone = evaluate(make_policy("cooperative-mpc", single), single, 2, 5).records
    for a, b in zip(rows, alone, strict=True):
        assert a.score == pytest.approx(b.score, rel=1e-6)
        assert a.estimate_rmse == pytest.approx(b.estimate_rmse, rel=1e-4)


def test_labels_are_what_the_expert_does_with_the_estimate_that_the_network_sees():
    options = training_options(TARGET, {"drop_out": 0.2})
    flights = LabelledFlights(options, make_expert("", options.task), 6, 0)
    names, scale = flights.encoder.encoding.features.names, flights.encoder.encoding.features.scale
    at = [names.index(f"estimate[0][{k}]") for k in range(1, 7)]
    assert not any(name.startswith(("measured", "estimate[1]")) for name in names)
    expert, seen, state = make_policy("cooperative-mpc", options.task), flights._observations, None
    for _ in range(10):
        wanted, state = expert.predict(seen, state)
        x, labels, _ = flights.collect(seeing_estimates(size=0.0), 1.0, 1)
        believed = np.concatenate([state.estimates.r, state.estimates.v], axis=1)
        np.testing.assert_allclose(x[:, at] * np.asarray(scale)[at], believed, rtol=0, atol=1e-5)
        inside = np.abs(labels) < 1.0
        assert np.allclose(hover_actions(labels, flights.task)[inside], wanted[inside], atol=1e-6)
        seen = flights._observations


def test_rows_in_training_see_the_estimates_of_their_filters():
    pytest.importorskip("stable_baselines3")
    from baselines.training.vec_env import TrainingVecEnv
    from quad_envs.wrappers.encoding import Encoding

    options = training_options(TARGET, {"max_cycles": 12, "delay": 1})
    encoding = Encoding(training_features(options))
    training = TrainingVecEnv(options, 2, [4, 5], encoding=encoding, staggered=False)
    env = EstimateVectorWrapper(target_tracking_v0.vector_env(2, max_cycles=12, delay=1), "none")
    rows, x = env.reset(seed=[4, 5])[0], training.reset()
    still = np.zeros((12, 4), np.float32)
    for _ in range(20):
        np.testing.assert_array_equal(x, training.encoder.see(rows))
        rows, _, _, truncated, _ = env.step(still)
        x, _, done, _ = training.step(still)
        if truncated.any():  # the vector begins in the step after, the rows in training at once
            assert done.all()
            rows, *_ = env.step(still)


def test_where_an_estimate_is_relative_to_the_vehicle_the_gradient_knows_it():
    flights = DifferentiableTeams(training_options(TARGET, {}), 6, 0)
    flights.begin_window(1)
    step = flights.advance(np.zeros((6, 4), np.float32))
    bar = np.zeros((6, len(flights.features.names)), np.float32)
    at = [flights.features.names.index(f"estimate[0][{k}]") for k in (1, 2, 3)]
    bar[:, at] = np.random.default_rng(0).normal(size=(6, 3))
    plants, commands = flights.observe_vjp(step, bar)
    expected = np.zeros((6, 16))
    expected[:, :3] = -bar[:, at] / np.asarray(flights.features.scale)[at]
    assert np.allclose(plants, expected) and not commands.any()


def test_a_network_of_another_sensor_is_refused_with_the_remedy(tmp_path):
    about = {"env_id": TARGET, "mission": "target-tracking", "env_kwargs": {"sensor": "range"}}
    save_checkpoint(tmp_path, seeing_estimates(), about)
    ranging = target_tracking_v0.parallel_env(sensor="range")
    assert isinstance(load_policy(tmp_path, ranging), EstimatingPolicy)
    with pytest.raises(CheckpointError, match=r"with the sensor 'range'.*pass sensor='range', or train one"):
        load_policy(tmp_path, TARGET)


def test_no_training_goes_on_from_a_network_of_another_sensor(tmp_path):
    pytest.importorskip("torch", reason="without it the training is refused for that")
    about = {"env_id": TARGET, "mission": "target-tracking", "env_kwargs": {"sensor": "range"}}
    save_checkpoint(tmp_path, seeing_estimates(), about)
    with pytest.raises(CheckpointError, match=r"with the sensor 'range'.*pass sensor='range', or train one"):
        train(TARGET, "dagger", start_from=tmp_path, steps=100, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_target_that_nobody_measures_is_nothing_to_learn_from():
    with pytest.warns(UserWarning, match="no spanning tree"):
        options = training_options(TARGET, {"detection": 0.0})
    with pytest.raises(ValueError, match="no estimate of it ever becomes valid: let somebody measure"):
        DifferentiableTeams(options, 6, 0)
