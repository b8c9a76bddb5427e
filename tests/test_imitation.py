"""Imitation and the analytic policy gradient: labels, who flies, and the scores that both reach."""

from dataclasses import replace

import numpy as np
import pytest

from baselines import evaluate, make_policy, train
from baselines.policies.environments import make_env, task_of
from baselines.policies.network import Network
from baselines.training import imitation
from baselines.training.held_out import CHOOSING, HELD_OUT, training_options
from baselines.training.imitation import DaggerOptions, LabelledFlights, Labels, make_expert
from baselines.training.imitation import train as dagger
from baselines.training.policy_gradient import PolicyGradientOptions
from baselines.training.policy_gradient import train as policy_gradient
from quad_envs.observations.features import default_features
from quad_envs.wrappers.encoding import hover_actions

pytest.importorskip("torch", reason="what imitates and the gradient learn with it")

HELIX, RANDOM, FORMATION = "quad/HelixTracking-v0", "quad/RandomTracking-v0", "quad/Formation-v0"
TARGET, CORRIDOR = "quad/TargetTracking-v0", "quad/CorridorTracking-v0"


def still(task, outputs=4):
    """A network that hovers."""
    features = default_features(task.layout)
    weights = np.zeros((len(features.names), outputs), np.float32)
    return Network(features, (weights,), (np.zeros(outputs, np.float32),))


def flights_of(env_id, expert, rows, seed=0, **kwargs):
    options = training_options(env_id, kwargs)
    return LabelledFlights(options, make_policy(expert, options.task), rows, seed)


@pytest.mark.parametrize(("env_id", "expert", "rows"), [(HELIX, "lqr", 5), (FORMATION, "consensus-mpc", 12)])
def test_labels_are_what_the_expert_does_in_what_was_seen(env_id, expert, rows):
    flights = flights_of(env_id, expert, rows)
    seen = flights._observations.copy()
    x, y, reward = flights.collect(still(flights.task), 1.0, 1)
    wanted, _ = make_policy(expert, flights.task).predict(seen)
    # The expert asks for more than twice the hover force nowhere here, so that nothing is cut off.
    inside = np.abs(y) < 1.0
    assert np.allclose(hover_actions(y, flights.task)[inside], wanted[inside], atol=1e-6)
    np.testing.assert_array_equal(x, flights.encoder.see(seen))
    assert len(x) == rows and 0.0 < reward < 1.0


def test_the_share_of_rows_that_the_expert_flies_is_beta():
    expert, learner = flights_of(HELIX, "lmpc", 20, seed=3), flights_of(HELIX, "lmpc", 20, seed=3)
    rewards = [
        expert.collect(still(expert.task), 1.0, 60)[2],
        learner.collect(still(learner.task), 0.0, 60)[2],
    ]
    assert rewards[0] > 3.0 * rewards[1]


def test_episodes_begin_anew_and_their_first_state_is_no_label_of_the_last_step():
    flights = flights_of(HELIX, "lqr", 4, time_limit=0.5)  # 10 steps
    x, _, _ = flights.collect(still(flights.task), 1.0, 22)
    assert len(x) == 4 * 20  # in 2 of the 22 steps rows begin anew


def test_rows_of_vehicles_that_crashed_give_no_labels():
    flights = flights_of(FORMATION, "hover", 12, terminate="agent", time_limit=3.0)
    flipping = still(flights.task)
    flipping = Network(flipping.features, flipping.weights, (np.array([-1, -1, 1, 1], np.float32),))
    x, _, _ = flights.collect(flipping, 0.5, 40)
    assert 6 * 10 < len(x) < 12 * 40 and np.abs(x).max() < 100.0


def test_labels_grow_and_are_all_drawn_from():
    labels, rng = Labels(2, 1), np.random.default_rng(0)
    for k in range(3):
        labels.add(np.full((3000, 2), k, np.float32), np.full((3000, 1), k, np.float32))
    x, y = labels.draw(1000, rng)
    assert labels.count == 9000 and set(y[:, 0].tolist()) == {0.0, 1.0, 2.0} and bool((x[:, :1] == y).all())


@pytest.mark.parametrize(
    ("name", "env_id", "message"),
    [
        ("", "quad/CooperativeEstimation-v0", "no expert for estimation tasks, whose actions are estimates"),
        ("central-mpc", FORMATION, "decides from the whole truth"),
        ("nmcp", HELIX, "did you mean 'nmpc'"),
        ("lmpc", FORMATION, "for tracking tasks, not for formation"),
    ],
)
def test_who_cannot_be_imitated_is_refused(name, env_id, message):
    with pytest.raises(ValueError, match=message):
        make_expert(name, task_of(env_id))


def test_an_expert_keeps_the_distance_that_it_is_told():
    env = make_env(FORMATION, vehicles=2, formation=((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), graph="chain")
    experts = make_expert("", env.task), make_expert("", env.task, 0.9)
    plants = np.zeros((2, 12))
    plants[1, 1], plants[1, 4] = -0.95, 2.0  # on its way through the leader, who is told to move
    observations, _ = env.reset(seed=0, options={"state": plants})
    rows = np.stack(list(observations.values()))
    near, far = (expert.predict(rows)[0] for expert in experts)
    assert np.abs(near - far).max() > 0.05


def test_an_expert_has_the_options_that_it_is_given():
    task = task_of(HELIX)
    rows = flights_of(HELIX, "hover", 8)._observations
    plain = make_expert("nmpc", task).predict(rows)[0]
    assert np.abs(make_expert("nmpc", task, options={"R": 0.01}).predict(rows)[0] - plain).max() > 0.01
    with pytest.raises(ValueError, match="did you mean 'margin'"):
        hyper = {"expert": "nmpc", "expert_options": {"magrin": 0.2}}
        train(CORRIDOR, "dagger", hyper=hyper, steps=1)
    with pytest.raises(
        ValueError, match=r"expert_options of 'dagger' must be a mapping from names to values"
    ):
        train(CORRIDOR, "dagger", hyper={"expert_options": 0.2}, steps=1)


@pytest.mark.parametrize(("env_id", "separation"), [(HELIX, 0.5), (FORMATION, 0.3)])
def test_a_distance_without_a_team_or_below_its_own_is_refused(env_id, separation):
    with pytest.raises(ValueError, match=r"separation is for teams, and at least their own, got 0\.\d m"):
        make_expert("", task_of(env_id), separation)


def test_networks_do_not_see_slots_that_nobody_fills():
    options = training_options(FORMATION, {"formation": "hexagon"})  # each hears one other
    flights = LabelledFlights(options, make_policy("hover", options.task), 12, 0, (0, 2))
    names = flights.encoder.encoding.features.names
    assert {name.split("]")[0] for name in names if name.startswith("comm")} == {"comm[0"}
    assert {name.split("]")[0] for name in names if name.startswith("preview")} == {"preview[0", "preview[2"}
    seen = [name for name in default_features(options.task.layout, (0, 2)).names if name not in names]
    assert seen == [f"comm[{k}][{i}]" for k in range(1, 5) for i in range(15)]


def test_ppo_goes_on_from_what_imitated():
    pytest.importorskip("stable_baselines3")
    from baselines.training.sb3 import PpoOptions, train_ppo

    options, steps = training_options(FORMATION, {"vehicles": 3, "formation": "triangle"}), iter([0.0, 1.0])
    small = DaggerOptions(
        n_envs=6,
        n_steps=3,
        gradient_steps=1,
        final_gradient_steps=1,
        net_arch=(8,),
        squash="clip",
        stages=(0, 2),
    )
    ((_, start),) = dagger(options, small, 0, lambda: next(steps))
    given = PpoOptions(
        n_envs=6, n_steps=8, batch_size=64, n_epochs=1, net_arch=(8,), stages=(0, 2), critic_updates=1
    )
    _, network = next(train_ppo(options, given, 0, lambda: 0.0, start))
    np.testing.assert_array_equal(network.weights[0], start.weights[0])
    assert network.features == start.features and network.squash == "clip"


@pytest.mark.parametrize(
    ("algorithm", "options"),
    [
        (dagger, DaggerOptions(expert="lqr", n_envs=8, n_steps=5, gradient_steps=2, final_gradient_steps=4)),
        (policy_gradient, PolicyGradientOptions(n_envs=8, n_steps=5)),
    ],
)
def test_equal_seeds_give_equal_networks(algorithm, options):
    def learn(seed, start=None):
        count = iter(range(5))
        updates = algorithm(training_options(HELIX, {}), options, seed, lambda: next(count) / 4, start)
        return list(updates)

    first, second, other = learn(1), learn(1), learn(2)
    assert len(first) == 4 and first[-1][0] == second[-1][0]
    for a, b, c in zip(first[-1][1].weights, second[-1][1].weights, other[-1][1].weights, strict=True):
        assert np.array_equal(a, b) and not np.array_equal(a, c)
    onward = learn(1, first[-1][1])[0][1].weights[0]
    # Adam moves each weight by the learning rate and no more in an update.
    assert np.abs(onward - first[-1][1].weights[0]).max() < 4.0 * 1.1e-2


def test_the_policy_gradient_goes_on_from_what_imitated_a_team():
    task = training_options(FORMATION, {"vehicles": 3, "formation": "triangle", "time_limit": 2.0})
    shared = {"n_envs": 7, "net_arch": (8,), "squash": "clip", "stages": (0, 2)}
    imitating = DaggerOptions(n_steps=3, gradient_steps=1, final_gradient_steps=1, **shared)
    steps = iter([0.0, 1.0])
    ((_, start),) = dagger(task, imitating, 0, lambda: next(steps))

    def learn(seed):
        count = iter(range(4))
        options = PolicyGradientOptions(n_steps=4, final_n_steps=6, penalty=1.0, separation=0.5, **shared)
        return list(policy_gradient(task, options, seed, lambda: next(count) / 3, start))

    (*_, (progress, network)), again = learn(0), learn(0)
    assert progress.steps == 6 * (4 + 5 + 5) and network.features == start.features  # two teams of three
    for before, a, b in zip(start.weights, network.weights, again[-1][1].weights, strict=True):
        np.testing.assert_array_equal(a, b)
        assert 0.0 < np.abs(a - before).max() < 4 * 1.1e-2


@pytest.mark.parametrize("name", ["stages", "separation", "episode_steps"])
def test_hyperparameters_of_teams_are_refused_for_one_vehicle(name):
    given = PolicyGradientOptions(**{name: (0,) if name == "stages" else 1})
    with pytest.raises(ValueError, match=rf"hyperparameter {name} = .* is for teams: leave it out"):
        next(policy_gradient(training_options(HELIX, {}), given, 0, lambda: 0.0))


@pytest.mark.parametrize(
    ("env_kwargs", "start", "message"),
    [
        (
            {"graph": "complete"},
            None,
            r"sees rows 0 of 'comm', where .* rows 0, 1, 2, 3, 4: choose a graph in",
        ),
        ({"formation": "lattice", "vehicles": 8}, None, r"rows 0, 1, 2, 3, 4 of 'sensed', .*: pass sensed=5"),
        ({}, "apg-helix", "'apg-helix' was trained on 'quad/HelixTracking-v0', .* the same kind"),
        ({"comm": "plan"}, None, "choose comm='state'"),
        ({"graph": lambda k: np.eye(6) + np.random.default_rng().random((6, 6))}, None, "drawn at random"),
        ({"reward": "quadratic"}, None, "reward='bounded', got 'quadratic'"),
    ],
)
def test_a_team_or_a_start_that_does_not_fit_is_refused_before_anything_is_written(
    tmp_path, env_kwargs, start, message
):
    given = {"formation": "hexagon"} | env_kwargs
    with pytest.raises(ValueError, match=message):
        train(
            FORMATION, "apg", env_kwargs=given, start_from=start or "dagger-formation", steps=1, out=tmp_path
        )
    assert not (tmp_path / "config.json").exists()


@pytest.mark.parametrize(
    ("env_id", "given", "message"),
    [
        (HELIX, {"hyper": {"expert": "nmcp"}}, "did you mean 'nmpc'"),
        (HELIX, {"hyper": {"episode_steps": 20}}, "episode_steps = 20 is for teams"),
        (HELIX, {"start_from": "dagger-random", "hyper": {"net_arch": [8]}}, "give the same net_arch"),
        (
            TARGET,
            {"start_from": "dagger-formation"},
            "of the kind 'formation', and no training on .* same kind",
        ),
        (HELIX, {"start_from": "dagger-random", "hyper": {"stages": [0]}}, "give the same stages"),
    ],
)
def test_what_dagger_cannot_do_is_refused_before_anything_is_written(tmp_path, env_id, given, message):
    with pytest.raises(ValueError, match=message):
        train(env_id, "dagger", steps=1, out=tmp_path, **given)
    assert not (tmp_path / "config.json").exists()


@pytest.mark.parametrize("flown_by_expert", [0.2, 1e-9])
def test_an_expert_that_answers_nan_is_named(monkeypatch, flown_by_expert):
    class Silent:
        name = "silent"

        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.full((len(observation), 4), np.nan, dtype=np.float32), state

    monkeypatch.setattr(imitation, "make_expert", lambda *_, **__: Silent())
    options = DaggerOptions(expert="lqr", expert_flies=flown_by_expert)
    with pytest.raises(ValueError, match=r"the expert 'silent' answers with actions that are not finite"):
        list(dagger(training_options(HELIX, {}), options, 0, lambda: 0.5))


def test_a_network_with_other_layers_is_no_start():
    wrong, steps = still(task_of(HELIX)), iter([0.0, 1.0])
    with pytest.raises(ValueError, match="give the same net_arch"):
        next(dagger(training_options(HELIX, {}), DaggerOptions(expert="lqr"), 0, lambda: next(steps), wrong))


def test_a_network_that_sees_something_else_is_no_start():
    options, steps = (
        DaggerOptions(expert="lqr", net_arch=(8,), n_envs=4, n_steps=1, gradient_steps=1),
        iter([0.0, 1.0]),
    )
    _, own = next(dagger(training_options(HELIX, {}), options, 0, lambda: next(steps)))
    scaled = replace(own, features=replace(own.features, scale=tuple(2.0 * s for s in own.features.scale)))
    with pytest.raises(ValueError, match="sees other features"):
        next(dagger(training_options(HELIX, {}), options, 0, lambda: 0.0, scaled))


def test_training_flies_from_no_start_that_is_held_out():
    flights = flights_of(HELIX, "hover", 64)
    env = make_env(HELIX)
    held_out = [
        env.reset(seed=seed)[0] for first in (HELD_OUT, CHOOSING) for seed in range(first, first + 20)
    ]
    gap = np.abs(flights._observations[:, None] - np.stack(held_out)[None]).max(axis=2)
    assert gap.min() > 1e-4


def score(policy, env_id, flights=50):
    return evaluate(make_policy(policy, env_id), env_id, flights, HELD_OUT).summary()["score"].mean


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_dagger_is_within_one_percent_of_its_expert(tmp_path, seed):
    train(HELIX, "dagger", seed=seed, steps=48_000, out=tmp_path)  # about 15 CPU-seconds
    assert score(tmp_path, HELIX) > 0.99 * score("sdc-nmpc", HELIX)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_the_policy_gradient_passes_lmpc(tmp_path, seed):
    train(HELIX, "apg", seed=seed, steps=700_000, out=tmp_path)  # about 13 CPU-seconds
    assert score(tmp_path, HELIX) > score("lmpc", HELIX)


@pytest.mark.slow
def test_dagger_holds_the_triangle_without_a_crash(tmp_path):
    triangle = {"formation": "triangle", "vehicles": 3}
    # About 30 CPU-seconds, and as many to judge it.
    train(FORMATION, "dagger", seed=0, steps=180_000, out=tmp_path, env_kwargs=triangle)
    env = make_env(FORMATION, **triangle)
    found = evaluate(make_policy(tmp_path, env), env, 100, HELD_OUT)
    assert not any(np.any(record.crashed) for record in found.records)
    expert = evaluate(make_policy("consensus-mpc", env), env, 20, HELD_OUT)
    # It imitates an expert that keeps 0.6 m, which costs 2 % of the score.
    assert found.summary()["score"].mean > 0.95 * expert.summary()["score"].mean
