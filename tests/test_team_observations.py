"""What each agent of a team is told: own block, messages, sensing, measurements, plans, the whole state."""

import numpy as np
import pytest
from team_steps import DT, column, fly, inertial_velocity

from quad_envs import Switching, formation_v0, target_tracking_v0
from quad_envs.constraints import forces_from_actions
from quad_envs.sensors import range_azimuth_elevation


def test_observations_have_the_documented_sizes():
    assert formation_v0.parallel_env().task.layout.size == 177
    assert target_tracking_v0.parallel_env().task.layout.size == 210
    assert formation_v0.parallel_env().state_space.shape == (187,)
    sizes = {formation_v0.parallel_env(vehicles=n).task.layout.size for n in (7, 20, 200)}
    assert len(sizes) == 1, "beyond six vehicles the size does not depend on their number"


def test_the_own_block_is_that_of_the_tracking_layout():
    view, _, _, plants, actions = fly(formation_v0.parallel_env())[-1]
    assert np.allclose(view.V_B, plants[:, 3:6], atol=1e-5)  # float32
    assert np.allclose(view.Theta, plants[:, 6:9], atol=1e-6)
    assert np.allclose(view.Omega, plants[:, 9:12], atol=1e-6)
    assert np.allclose(view.F, plants[:, 12:16], atol=1e-5)
    assert np.allclose(view.last_command, forces_from_actions(actions, 1.96, 7.84), atol=1e-5)


def test_only_the_leader_sees_the_reference():
    env = formation_v0.parallel_env(reference="slow-helix")
    for k, (view, _, _, plants, _) in enumerate(fly(env, 10)):
        assert view.leader.tolist() == [True] + [False] * 5
        expected = env.references[0, k : k + 6].copy()
        expected[:, :3] -= plants[0, :3]
        assert np.allclose(view.preview[0], expected, atol=1e-6)
        assert not view.preview[1:].any()


@pytest.mark.parametrize("delay", [0, 3])
@pytest.mark.parametrize("drop_out", [0.0, 0.4])
def test_a_message_holds_the_senders_motion_of_when_it_was_sent(delay, drop_out):
    env = formation_v0.parallel_env(graph="strong", delay=delay, drop_out=drop_out, message_lifetime=0.4)
    record, slots, heard_late = fly(env), env.references[:, 0, :3], False
    for k, (view, _, infos, plants, _) in enumerate(record):
        for i in range(6):
            for s, j in enumerate(env.senders[i]):
                slot = view.comm[i, s]
                if j < 0 or slot[0] == 0.0:
                    assert not slot.any()
                    continue
                sent = k - round(slot[1] / DT)
                assert delay <= k - sent <= 8
                heard_late |= k - sent > delay
                then, velocity = record[sent][3], inertial_velocity(record[sent][3])
                assert slot[0] == env._batch.graph(sent)[i, j]
                assert np.allclose(slot[2:5], then[j, :3] - plants[i, :3], atol=1e-5)
                assert np.allclose(slot[5:8], velocity[j] - inertial_velocity(plants)[i], atol=1e-5)
                assert np.allclose(slot[8:10], then[j, 6:8], atol=1e-6)
                assert np.allclose(slot[10:12], [np.sin(then[j, 8]), np.cos(then[j, 8])], atol=1e-6)
                assert np.allclose(slot[12:15], slots[i] - slots[j], atol=1e-6)
        if drop_out == 0.0 and k >= delay:
            assert (view.comm[..., 0] > 0.0).sum(axis=1).tolist() == [0, 5, 5, 4, 4, 4]
            assert column(infos, "messages").tolist() == [0, 5, 5, 4, 4, 4]
    assert heard_late == (drop_out > 0.0)


def test_a_message_expires():
    env = formation_v0.parallel_env(
        graph=Switching(["weak", np.eye(6)], dwell_steps=20), message_lifetime=0.5
    )
    for k, (view, *_) in enumerate(fly(env, 60)):
        since = k % 40 - 19  # steps since the last message
        assert bool(view.comm[1, 0, 0]) == (since <= 10)


def test_links_toward_the_leader_weigh_more_unless_the_user_gave_weights():
    weights = formation_v0.parallel_env(graph="strong")._batch.graph(0)
    assert weights[1, 0] == 10.0 and weights[1, 2] == 1.0 and weights[3, 1] == 10.0 and weights[3, 4] == 1.0
    own = np.eye(6) + np.diag(np.full(5, 2.5), -1)
    assert formation_v0.parallel_env(graph=own)._batch.graph(0)[3, 2] == 2.5


def test_sensed_vehicles_are_the_most_urgent_within_the_radius():
    env = formation_v0.parallel_env(
        vehicles=12, formation="lattice", sensed=3, start="box", sensing_radius=2.5
    )
    for view, _, _, plants, _ in fly(env, 30, scale=0.4):
        p, v = plants[:, :3], inertial_velocity(plants)
        for i in range(12):
            d, w = p - p[i], v - v[i]
            distance = np.linalg.norm(d, axis=1)
            parting = np.einsum("nc,nc->n", d, w)
            with np.errstate(all="ignore"):
                contact = np.maximum(distance - 0.4, 0.0) * distance / -parting
            key = np.where(parting < 0.0, contact, 1e6 + distance)
            key[i] = np.inf
            key[distance >= 2.5] = np.inf
            expected = [j for j in np.argsort(key) if np.isfinite(key[j])][:3]
            for s in range(3):
                slot = view.sensed[i, s]
                assert slot[0] == (s < len(expected))
                if s < len(expected):
                    j = expected[s]
                    assert np.allclose(slot[1:], [*d[j], *w[j]], atol=1e-4)
                else:
                    assert not slot.any()


@pytest.mark.parametrize("sensor", ["range", "range-azimuth-elevation"])
def test_measurements_are_the_sensors_and_travel_with_the_messages(sensor):
    env = target_tracking_v0.parallel_env(
        sensor=sensor, sensor_sigma=(1e-7, 1e-7, 1e-7), measuring=(0, 2), graph="case-2", delay=2
    )
    record = fly(env, 12)
    for k, (view, _, _, plants, _) in enumerate(record):
        z = range_azimuth_elevation(env.target[k, :3] - plants[:, :3])
        expected = np.stack([np.ones(6), z[:, 0], np.sin(z[:, 1]), np.cos(z[:, 1]), z[:, 2]], axis=1)
        if sensor == "range":
            expected[:, 2:] = 0.0
        expected[[1, 3, 4, 5]] = 0.0
        assert np.allclose(view.measured[:, 0], expected, atol=1e-5)
        if k < 2:
            assert not view.measured[:, 1:].any()
            continue
        earlier = record[k - 2][0].measured[:, 0]
        for i in range(6):
            for s, j in enumerate(env.senders[i]):
                assert np.allclose(view.measured[i, 1 + s], earlier[j] if j >= 0 else 0.0, atol=1e-6)


def test_a_measurement_that_was_heard_once_is_not_told_again():
    env = target_tracking_v0.parallel_env(drop_out=0.5)
    for view, _, infos, _, _ in fly(env, 40):
        assert np.array_equal(view.measured[:, 1:, 0].sum(axis=1), column(infos, "messages"))


def test_noise_and_detection_have_their_statistics():
    env = target_tracking_v0.parallel_env(detection=0.7, target="static", time_limit=20.0)
    errors, found = [], []
    for seed in range(5):
        for k, (view, _, _, plants, _) in enumerate(fly(env, 100, seed, scale=0.0)):
            z = range_azimuth_elevation(env.target[k, :3] - plants[:, :3])
            own = view.measured[:, 0]
            found.append(own[:, 0])
            hit = own[:, 0] > 0.0
            turn = np.arctan2(own[hit, 2], own[hit, 3]) - z[hit, 1]
            errors.append(np.stack([own[hit, 1] - z[hit, 0], turn, own[hit, 4] - z[hit, 2]], axis=1))
    error, n = np.concatenate(errors), np.concatenate(found).size
    assert abs(np.concatenate(found).mean() - 0.7) < 4.0 * np.sqrt(0.21 / n)
    assert np.allclose(error.std(axis=0), env.task.sensor_sigma, rtol=4.0 / np.sqrt(2.0 * len(error)))


def test_plans_arrive_one_step_later():
    env = formation_v0.parallel_env(comm="plan", graph="chain")
    record = fly(env, 6)
    for k in range(1, 7):
        view, _, _, plants, actions = record[k]
        before, velocity = record[k - 1][3], inertial_velocity(plants)
        for i in range(1, 6):
            tail = 5.0 * actions[i - 1, 4:].reshape(5, 6).astype(np.float64)
            expected = tail.copy()
            expected[:, :3] += before[i - 1, :3] - plants[i, :3]
            expected[:, 3:] -= velocity[i]
            assert np.allclose(view.comm[i, 0, 15:].reshape(5, 6), expected, atol=1e-5)
    first = record[0][0].comm[1, 0, 15:].reshape(5, 6)
    assert np.allclose(first[:, :3], record[0][0].comm[1, 0, 2:5], atol=1e-6), "at rest: it stays where it is"


def test_the_whole_state_has_named_parts():
    env = target_tracking_v0.parallel_env(graph="case-2")
    fly(env, 7)
    state, where = env.state(), env.state_slices
    assert np.array_equal(state[where["plants"]].reshape(6, 16), env.plants)
    assert np.array_equal(state[where["target"]], env.target[7])
    assert np.array_equal(state[where["graph"]].reshape(6, 6), env._batch.graph(7))
    assert not state[where["preview"]].any()
    assert state[where["time"]] == 7 / 400


def test_the_state_of_a_batch_is_that_of_its_teams():
    schedule = Switching(["chain", "star"], dwell_steps=4)
    kwargs = {"vehicles": 3, "reference": "random", "graph": schedule, "terminate": "agent"}
    for module, given in ((formation_v0, kwargs), (target_tracking_v0, {"target_spread": (0.5, 0.1)})):
        batch, singles = module.vector_env(3, **given), [module.parallel_env(**given) for _ in range(3)]
        batch.reset(seed=4)
        for i, env in enumerate(singles):
            env.reset(seed=4 + i)
        rng, over = np.random.default_rng(0), np.zeros(3, dtype=bool)
        for _ in range(40):
            states = np.stack([env.state() for env in singles])
            assert np.array_equal(batch.state()[~over], states[~over])
            actions = rng.uniform(-1.0, 1.0, batch.action_space.shape).astype(np.float32)
            batch.step(actions)
            for env, own in zip(singles, np.split(actions, 3), strict=True):
                env.step({name: own[env.possible_agents.index(name)] for name in env.agents})
            over |= [not env.agents for env in singles]  # the batch begins these anew
