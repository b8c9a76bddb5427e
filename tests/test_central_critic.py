"""MAPPO: the critic sees the state of the team, the actor does not, and a crash ends who crashed."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

import torch

from baselines import evaluate, make_policy, train
from baselines.policies.environments import make_env
from baselines.policies.network import NetworkPolicy
from baselines.training import central_critic
from baselines.training.algorithm_options import MappoOptions
from baselines.training.central_critic import CriticView, make_central_flights, make_mappo
from baselines.training.held_out import training_options
from baselines.training.hyperparameters import hyperparameters
from quad_envs import formation_v0, target_tracking_v0
from quad_envs.envs.team.options import FormationOptions, TargetTrackingOptions
from quad_envs.envs.tracking.options import TrackingOptions

TEAM = FormationOptions(vehicles=3, time_limit=2.0)
SMALL = MappoOptions(n_envs=6, n_steps=24, batch_size=48, n_epochs=2, net_arch=(16,), critic_arch=(24, 8))
FORMATION = "quad/Formation-v0"
pytestmark = pytest.mark.usefixtures("one_thread")
LIKE = {"net_arch": [128, 128], "stages": [0, 2, 5]}
TURN_OVER = np.array([0.9, -0.9, -0.9, 0.9], dtype=np.float32)


def inertial(plant):
    """What a critic should see of one vehicle apart from places, before scaling."""
    angles = [*plant[6:8], np.sin(plant[8]), np.cos(plant[8])]
    return np.array([*plant[3:6], *angles, *plant[9:12], *(plant[12:] / 1.96 - 1.0)])


@pytest.mark.parametrize("module", [formation_v0, target_tracking_v0])
def test_the_critic_sees_the_state_of_the_team_from_each_vehicle(module):
    env = module.parallel_env(vehicles=3, formation="lattice")
    env.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(9):
        env.step({name: rng.uniform(-0.3, 0.3, 4).astype(np.float32) for name in env.agents})
    view = CriticView(env.task)
    seen = view(env.state()[None])
    assert seen.shape == (3, view.size)
    plants, wanted = env.plants, env.references[:, 9, :3]
    for i in range(3):
        rows = seen[i, :60].reshape(3, 20)
        for place, j in enumerate([i, (i + 1) % 3, (i + 2) % 3]):
            np.testing.assert_allclose(2.0 * rows[place, :3], plants[j, :3] - wanted[j], atol=1e-5)
            np.testing.assert_allclose(2.0 * rows[place, 3:6], plants[j, :3] - plants[i, :3], atol=1e-5)
            scale = [3.0] * 3 + [0.5, 0.5, 1.0, 1.0] + [3.0] * 3 + [1.0] * 4
            np.testing.assert_allclose(rows[place, 6:] * scale, inertial(plants[j]), atol=1e-5)
        assert seen[i, 60 + 9 : 60 + 12].tolist() == np.eye(3)[i].tolist()
        assert seen[i, -1] == np.float32(9 / env.task.episode_steps)


def test_the_critic_of_the_hexagon_sees_who_is_heard_by_whom():
    env = formation_v0.parallel_env()
    env.reset(seed=0)
    graph = env.state()[env.state_slices["graph"]].reshape(6, 6)
    seen = CriticView(env.task)(env.state()[None])[2, 120:156].reshape(6, 6)
    order = [2, 3, 4, 5, 0, 1]
    np.testing.assert_allclose(10.0 * seen, graph[np.ix_(order, order)], atol=1e-6)


def test_the_value_depends_on_the_state_and_the_action_does_not():
    flights = make_central_flights(TEAM, SMALL, 0)
    model = make_mappo(flights, SMALL, 0, lambda: 0.0)
    rows = torch.from_numpy(flights.reset())
    other = rows.clone()
    other[:, flights.encoder.size :] += 0.5
    mean = [model.policy.get_distribution(x).mode() for x in (rows, other)]
    assert torch.equal(*mean)
    assert not torch.isclose(*[model.policy.predict_values(x) for x in (rows, other)]).any()


def test_a_crash_ends_those_that_crashed_and_cuts_the_others():
    flights = make_central_flights(TEAM, replace(SMALL, n_envs=3), 0)
    flights.reset()
    outputs = np.zeros((3, 4), dtype=np.float32)
    outputs[1] = TURN_OVER
    for _ in range(40):
        _, rewards, dones, infos = flights.step(outputs)
        crashed = [done and not info["TimeLimit.truncated"] for done, info in zip(dones, infos, strict=True)]
        if any(crashed):
            break
    assert dones.all()
    assert crashed == [False, True, False]
    assert rewards[1] == 0.0 and (rewards[[0, 2]] > 0.0).all()


def plain_advantages(buffer, rewards, last_values, dones, cuts, gamma, trace):
    """Generalised advantages of one row after another; `cuts` has (step, row) -> value of what was cut."""
    steps, rows = buffer.rewards.shape
    out = np.zeros((steps, rows))
    for row in range(rows):
        following = 0.0
        for t in reversed(range(steps)):
            ends = dones[row] if t == steps - 1 else buffer.episode_starts[t + 1, row]
            then = last_values[row] if t == steps - 1 else buffer.values[t + 1, row]
            if ends:
                then, following = cuts.get((t, row), 0.0), 0.0
            delta = rewards[t][row] + gamma * then - buffer.values[t, row]
            following = delta + gamma * trace * following
            out[t, row] = following
    return out


def test_advantages_are_those_of_a_plain_loop_over_vehicles(monkeypatch):
    options = replace(SMALL, log_std_init=0.0, n_steps=60, gamma=0.95, gae_lambda=0.9)
    flights = make_central_flights(TEAM, options, 1)
    model = make_mappo(flights, options, 1, lambda: 0.0)
    ends, told, paid, step = [], {}, [], type(flights).step_wait

    def noted(self):
        seen, rewards, dones, infos = step(self)
        for row in np.flatnonzero(dones):
            ends.append((len(paid), int(row), bool(infos[row]["TimeLimit.truncated"])))
            if infos[row]["TimeLimit.truncated"]:
                told[len(paid), int(row)] = infos[row]["terminal_observation"]
        paid.append(rewards.copy())
        noted.last = seen, dones
        return seen, rewards, dones, infos

    monkeypatch.setattr(type(flights), "step_wait", noted)
    monkeypatch.setattr(type(model), "train", lambda self: None)
    model.learn(6 * 60)
    mixed = [
        {cut for at, row, cut in ends if (at, row // 3) == end} for end in {(e[0], e[1] // 3) for e in ends}
    ]
    assert {True, False} in mixed, "somebody crashed, and others were cut"
    with torch.no_grad():

        def value(rows):
            return model.policy.predict_values(torch.from_numpy(np.atleast_2d(rows))).numpy()[:, 0]

        cuts = {key: float(value(row)[0]) for key, row in told.items()}
        last = value(noted.last[0])
    wanted = plain_advantages(model.rollout_buffer, paid, last, noted.last[1], cuts, 0.95, 0.9)
    np.testing.assert_allclose(model.rollout_buffer.advantages.reshape(60, 6), wanted, rtol=1e-4, atol=1e-5)


def test_equal_seeds_give_equal_actors_and_a_start_is_kept_while_the_critic_learns():
    options = replace(SMALL, critic_updates=1)

    def updates(seed, start=None):
        found = central_critic.train(TEAM, options, seed, lambda: 0.0, start)
        return [network for _, network in itertools.islice(found, 2)]

    first, again, other = updates(1), updates(1), updates(2)
    np.testing.assert_array_equal(first[1].weights[0], again[1].weights[0])
    assert not np.array_equal(first[1].weights[0], other[1].weights[0])
    assert first[0].outputs == 4
    later = updates(3, first[1])
    np.testing.assert_array_equal(later[0].weights[0], first[1].weights[0])
    assert not np.array_equal(later[1].weights[0], first[1].weights[0])


def test_a_trained_folder_is_a_checkpoint_as_any_other(tmp_path):
    small = {"n_envs": 6, "n_steps": 8, "net_arch": [8], "critic_arch": [8]}
    team = {"vehicles": 3, "formation": "triangle", "time_limit": 1.0}
    train(FORMATION, "mappo", steps=96, out=tmp_path / "run", env_kwargs=team, hyper=small)
    env = make_env(FORMATION, **team)
    assert len(evaluate(str(tmp_path / "run"), env, 2, 7).records) == 2 * 3


def test_it_trains_beside_a_target():
    ((progress, network),) = itertools.islice(
        central_critic.train(TargetTrackingOptions(time_limit=1.0), SMALL, 0, lambda: 0.0), 1
    )
    assert progress.steps == 6 * 24
    assert "estimate[0][1]" in network.features.names


def test_one_vehicle_is_refused_with_the_remedy(tmp_path):
    with pytest.raises(ValueError, match=r"mappo needs the state\(\) of a team.*train with ppo"):
        next(central_critic.train(TrackingOptions.from_kwargs({}), SMALL, 0, lambda: 0.0))
    with pytest.raises(ValueError, match=r"'mappo' trains on formation and target-tracking tasks.*take ppo"):
        train("quad/HelixTracking-v0", "mappo", out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.filterwarnings("ignore:the union of the graphs")
@pytest.mark.parametrize("algorithm", ["mappo", "ppo"])
@pytest.mark.parametrize(
    ("env_id", "team", "hyper", "start", "message"),
    [
        ("quad/TargetTracking-v0", {"detection": 0.0}, {}, None, r"nobody measures.*let somebody measure"),
        (FORMATION, {"graph": "complete"}, LIKE, "dagger-formation", r"'comm'.*choose a graph in which"),
        (FORMATION, {"sensed": 2}, LIKE, "dagger-formation", r"'sensed'.*pass sensed=5"),
        (FORMATION, {}, {"net_arch": [8]}, "dagger-formation", r"give the same net_arch"),
        (FORMATION, {}, LIKE, "apg-helix", r"no training on quad/Formation-v0.*can go on"),
    ],
)
def test_what_cannot_be_trained_in_a_team_is_refused_before_anything_is_written(
    tmp_path, algorithm, env_id, team, hyper, start, message
):
    with pytest.raises(ValueError, match=message):
        train(env_id, algorithm, out=tmp_path / "run", env_kwargs=team, hyper=hyper, start_from=start)
    assert not (tmp_path / "run").exists()


def test_a_network_that_sees_more_vehicles_names_the_argument():
    with pytest.raises(ValueError, match=r"the network sees sensed\[2\]\[0\].*pass sensed=5, or more"):
        make_policy("dagger-formation", make_env(FORMATION, sensed=2))


def test_a_network_is_refused_where_vehicles_send_plans_and_told_what_to_choose():
    with pytest.raises(ValueError, match=r"gives 4 numbers.*has 34: choose comm='state'"):
        make_policy("dagger-formation", make_env(FORMATION, comm="plan"))


def test_a_critic_without_end_is_refused():
    with pytest.raises(ValueError, match=r"a layer of hyperparameter critic_arch"):
        train(FORMATION, "mappo", hyper={"critic_arch": [10**9]})


@pytest.mark.slow
def test_it_learns_to_hold_a_triangle():
    task = training_options(FORMATION, {"vehicles": 3, "formation": "triangle"})
    options, done = hyperparameters("mappo", FORMATION), iter(range(10**6))
    *_, (_, network) = itertools.islice(
        central_critic.train(task, options, 0, lambda: min(next(done) / 1e4, 0.99)), 60
    )
    env = make_env(FORMATION, vehicles=3, formation="triangle")
    found = evaluate(NetworkPolicy(network, env.unwrapped.task, "mappo"), env, 5, 10_000)
    assert found.summary()["score"].mean > 0.3  # before training 0.02
