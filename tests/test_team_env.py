"""The multi-agent environments: what each agent is told, its reward, crashes, and the batched form."""

import pickle
import warnings

import numpy as np
import pettingzoo
import pytest
from pettingzoo.test import (
    api_test,
    max_cycles_test,
    parallel_api_test,
    parallel_seed_test,
    seed_test,
    state_test,
)

import quad_envs
from quad_envs import Switching, cooperative_estimation_v0, formation_v0, target_tracking_v0
from quad_envs.constraints import TOLERANCE, forces_from_actions
from quad_envs.dynamics import simulate
from quad_envs.reward import stage_cost
from quad_envs.rotations import rotation_body_from_inertial
from quad_envs.sensors import range_azimuth_elevation

MODULES = [formation_v0, target_tracking_v0, cooperative_estimation_v0]
DT = 0.05


def names(module):
    return module.__name__.rsplit(".", 1)[-1]


def fly(env, steps=40, seed=0, scale=0.15):
    """Per step: decoded observations, rewards, infos, plants (stacked over the agents), and actions."""
    rng = np.random.default_rng(seed)
    seen, infos = env.reset(seed=seed)
    out = [(env.task.layout.decode(np.stack(list(seen.values()))), None, infos, env.plants, None)]
    for _ in range(steps):
        actions = rng.uniform(-scale, scale, (env.task.vehicles, env.task.action_size)).astype(np.float32)
        seen, rewards, _, _, infos = env.step(dict(zip(env.possible_agents, actions, strict=True)))
        view = env.task.layout.decode(np.stack(list(seen.values())))
        out.append((view, np.array(list(rewards.values())), infos, env.plants, actions))
        if not env.agents:
            break
    return out


def column(infos, key):
    return np.array([info[key] for info in infos.values()])


def inertial_velocity(plants):
    return np.einsum("nji,nj->ni", rotation_body_from_inertial(plants[:, 6:9]), plants[:, 3:6])


# ------------ PettingZoo's own tests
@pytest.mark.parametrize("module", MODULES, ids=names)
@pytest.mark.parametrize("terminate", ["team", "agent"])
def test_the_parallel_form_passes_pettingzoos_tests(module, terminate):
    parallel_api_test(module.parallel_env(terminate=terminate), num_cycles=200)


@pytest.mark.parametrize("module", MODULES, ids=names)
def test_seeds_cycles_and_state_pass_pettingzoos_tests(module):
    parallel_seed_test(module.parallel_env)
    max_cycles_test(module)
    state_test(module.env(), module.parallel_env())


@pytest.mark.parametrize("module", MODULES, ids=names)
def test_the_turn_based_form_passes_pettingzoos_tests(module):
    api_test(module.env(), num_cycles=30)
    seed_test(module.env, num_cycles=5)


@pytest.mark.skipif(not hasattr(pettingzoo, "make"), reason="PettingZoo has a registry from 1.27 on")
@pytest.mark.parametrize("env_id", sorted(quad_envs.registration.TEAMS))
def test_ids_are_registered_with_pettingzoo(env_id):
    env = pettingzoo.make("parallel", env_id, time_limit=1.0)
    assert env.task.env_id == env_id
    assert env.task.episode_steps == 20
    assert pettingzoo.make("aec", env_id).possible_agents == env.possible_agents


# ------------ what agents are told
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


# ------------ motion and reward
def test_the_step_is_the_plant_held_over_the_control_period():
    env, before = formation_v0.parallel_env(vehicles=9), None
    for _, _, _, plants, actions in fly(env, 10):
        if before is not None:
            commands = forces_from_actions(actions, 1.96, 7.84)
            assert np.allclose(plants, simulate(before, commands, env.task.params), atol=1e-12)
        before = plants


def test_the_separation_is_the_smallest_over_the_substeps():
    env, state = formation_v0.parallel_env(vehicles=2, graph="chain"), np.zeros((2, 12))
    state[1, :3] = 0.1, 0.5, 0.0
    state[0, 3], state[1, 3] = 4.0, -4.0  # they pass each other within a step
    env.reset(seed=0, options={"state": state})
    plants, hover = env.plants, np.full((2, 4), env.task.hover_force)
    distances = []
    for _ in range(5):
        plants = simulate(plants, hover, env.task.params, duration=0.01, substeps=1)
        distances.append(np.linalg.norm(plants[0, :3] - plants[1, :3]))
    _, _, _, _, infos = env.step({name: np.zeros(4, np.float32) for name in env.agents})
    assert infos["quad_0"]["min_separation"] == pytest.approx(min(distances), abs=1e-12)
    assert min(distances) < distances[-1]


@pytest.mark.parametrize("module", MODULES[:2], ids=names)
def test_rewards_are_the_readable_formula(module):
    graph = "strong" if module is formation_v0 else "case-1"
    limits = {"tilt_limit": 0.05, "velocity_limit": 0.3, "rate_limit": 10.0}
    env = module.parallel_env(graph=graph, start="box", separation=0.8, formation_weight=2.0, **limits)
    G, slots, last = env._batch.graph(0), env._batch.slots, None
    scale = np.array([0.1, 0.5, 10.0 * DT, 0.8 - 0.33])
    violated = False
    for k, (_, rewards, infos, plants, actions) in enumerate(fly(env, 40, scale=0.3)):
        if k > 0:
            command = forces_from_actions(actions, 1.96, 7.84)
            loss = stage_cost(plants, env.references[:, k], command, 1.96, env.task.weights)
            p = plants[:, :3]
            for i in range(6):
                error = [
                    ((p[i] - p[j] - slots[i] + slots[j]) ** 2).sum() for j in range(6) if i != j and G[i, j]
                ]
                loss[i] += 2.0 * np.mean(error) if error else 0.0
            values = column(infos, "constraint_values")
            assert np.allclose(values[:, 0], np.abs(plants[:, 6:8]).max(axis=1) - 0.05)
            assert np.allclose(values[:, 2], np.abs(command - last).max(axis=1) - 0.5)
            assert np.allclose(values[:, 3], 0.8 - column(infos, "min_separation"))
            cost = (np.where(values > TOLERANCE, values, 0.0) / scale).sum(axis=1)
            assert np.allclose(column(infos, "stage_cost"), loss)
            assert np.allclose(column(infos, "cost"), cost)
            assert np.allclose(column(infos, "reward_terms")[:, :6].sum(axis=1), loss)
            assert np.allclose(column(infos, "reward_terms")[:, 6:].sum(axis=1), cost)
            assert np.allclose(rewards, (1.0 - np.minimum(cost, 1.0)) / (1.0 + loss))
            assert np.allclose(
                column(infos, "formation_error"), np.linalg.norm(p - env.references[:, k, :3], axis=1)
            )
            violated = violated or (values > TOLERANCE).any(axis=0).sum() >= 3
            last = command
        else:
            last = np.full((6, 4), 1.96)
    assert violated


def test_an_estimate_is_judged_at_the_time_of_its_observation():
    env = cooperative_estimation_v0.parallel_env()
    record = fly(env, 20, scale=1.0)
    for k in range(1, 21):
        _, rewards, infos, plants, actions = record[k]
        before = record[k - 1][3]
        r, v = before[:, :3] + 20.0 * actions[:, :3], 5.0 * actions[:, 3:]
        error = np.concatenate([r, v], axis=1) - env.target[k - 1]
        assert np.allclose(rewards, 1.0 / (1.0 + (error**2).sum(axis=1)))
        assert np.allclose(column(infos, "formation_error"), np.linalg.norm(error[:, :3], axis=1))
        assert np.allclose(plants[:, :3], record[0][3][:, :3] + k * DT * np.array([0.8, 0.3, -0.1]))


def test_the_target_of_the_estimation_task_starts_as_the_prior_says():
    env, errors = cooperative_estimation_v0.parallel_env(time_limit=0.1), []
    for seed in range(300):
        seen, _ = env.reset(seed=seed)
        slot = env.task.layout.decode(seen["quad_1"]).slot
        guess = [*(env.plants[1, :3] - slot), *env.task.prior_velocity]
        errors.append(env.target[0] - guess)
    assert np.allclose(np.std(errors, axis=0), 0.5, rtol=4.0 / np.sqrt(600.0))
    assert np.allclose(np.mean(errors, axis=0), 0.0, atol=4.0 * 0.5 / np.sqrt(300.0))


# ------------ crashes
def collide(terminate):
    """Vehicles 1 and 2 meet within a step; the others hover far away."""
    env = formation_v0.parallel_env(graph="strong", terminate=terminate)
    state = np.zeros((6, 12))
    state[:, 1] = [0.0, 10.0, 10.5, 20.0, 30.0, 40.0]
    state[1, 4], state[2, 4] = 3.0, -3.0
    env.reset(seed=0, options={"state": state})
    return env, env.step({name: np.zeros(4, np.float32) for name in env.agents})


def test_a_crash_ends_the_episode_of_the_whole_team_and_rewards_nobody():
    env, (_, rewards, terminated, _, infos) = collide("team")
    assert set(rewards.values()) == {0.0}
    assert all(terminated.values()) and env.agents == []
    assert all(info["crashed"] for info in infos.values())


def test_crashed_agents_leave_the_others_fly_on_without_them():
    env, (_, rewards, terminated, _, _) = collide("agent")
    assert [name for name, end in terminated.items() if end] == ["quad_1", "quad_2"]
    assert rewards["quad_1"] == 0.0 < rewards["quad_3"]
    assert env.agents == ["quad_0", "quad_3", "quad_4", "quad_5"]
    seen, rewards, *_ = env.step({name: np.zeros(4, np.float32) for name in env.agents})
    assert list(seen) == list(rewards) == env.agents
    comm = env.task.layout.decode(seen["quad_3"]).comm
    gone = np.isin(env.senders[3], [1, 2])
    assert not comm[gone].any() and (comm[~gone & (env.senders[3] >= 0), 0] > 0.0).all()
    with pytest.raises(ValueError, match="quad_1, quad_2 left the episode"):
        env.step({name: np.zeros(4, np.float32) for name in env.possible_agents})


def test_leaving_the_arena_and_turning_over_are_crashes():
    for start, velocity in (((99.99, 0.0, 0.0), (9.0, 0.0, 0.0)), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))):
        env, state = formation_v0.parallel_env(vehicles=2, graph="chain"), np.zeros((2, 12))
        state[1, 1] = 5.0
        state[0, :3], state[0, 3:6] = start, velocity
        state[0, 9] = 0.0 if velocity[0] else 40.0
        env.reset(options={"state": state})
        _, _, terminated, _, _ = env.step({name: np.zeros(4, np.float32) for name in env.agents})
        assert all(terminated.values())


# ------------ the batched form
@pytest.mark.parametrize(
    ("module", "kwargs"),
    [
        (formation_v0, {}),
        (formation_v0, {"vehicles": 3, "formation": "triangle", "reference": "random", "randomize": 0.1}),
        (formation_v0, {"vehicles": 40, "start": "box", "terminate": "agent", "disturbance": "gusts"}),
        (formation_v0, {"drop_out": 0.3, "delay": 1, "sensor_noise": 0.01, "comm": "plan"}),
        (target_tracking_v0, {"target_spread": (1.0, 0.2), "detection": 0.8}),
        (cooperative_estimation_v0, {}),
    ],
)
def test_a_batch_of_teams_equals_single_teams(module, kwargs):
    teams, kwargs = 3, {"time_limit": 0.5, **kwargs}
    many, singles = module.vector_env(teams, **kwargs), [module.parallel_env(**kwargs) for _ in range(teams)]
    n, rng = many.task.vehicles, np.random.default_rng(1)
    seen, _ = many.reset(seed=7)
    alone = [env.reset(seed=7 + t)[0] for t, env in enumerate(singles)]
    for t, one in enumerate(alone):
        assert np.array_equal(seen[t * n : (t + 1) * n], np.stack(list(one.values())))
    for _ in range(25):
        actions = rng.uniform(-0.4, 0.4, many.action_space.shape).astype(np.float32)
        flying = [list(env.agents) for env in singles]
        seen, rewards, terminated, truncated, info = many.step(actions)
        for t, env in enumerate(singles):
            rows = [t * n + env.possible_agents.index(name) for name in flying[t]]
            if rows:
                asked = {name: actions[row] for name, row in zip(flying[t], rows, strict=True)}
                one, *said, infos = env.step(asked)
            else:  # a team whose episode ended begins anew, whatever the actions
                rows = list(range(t * n, (t + 1) * n))
                one, infos = env.reset()
                said = [dict.fromkeys(one, value) for value in (0.0, False, False)]
            assert np.array_equal(seen[rows], np.stack(list(one.values())))
            for given, ours in zip(said, (rewards, terminated, truncated), strict=True):
                assert ours[rows].tolist() == list(given.values())
            for key in infos[next(iter(infos))]:
                assert np.array_equal(info[key][rows], column(infos, key), equal_nan=True)


def test_a_batch_refuses_what_it_cannot_do():
    with pytest.raises(ValueError, match="NEXT_STEP or DISABLED"):
        formation_v0.vector_env(2, autoreset_mode="SameStep")
    with pytest.raises(ValueError, match="num_teams must be"):
        formation_v0.vector_env(0)
    env = formation_v0.vector_env(2)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(12, 4\)"):
        env.step(np.zeros((6, 4), np.float32))
    with pytest.raises(ValueError, match=r"action\[2\] of vehicle 1 \(team 1\) is nan"):
        actions = np.zeros((12, 4), np.float32)
        actions[7, 2] = np.nan
        env.step(actions)


# ------------ symmetries
def test_the_names_of_the_followers_mean_nothing():
    order = np.array([0, 3, 5, 1, 2, 4])
    plain = formation_v0.parallel_env(graph="strong", start="sorted")
    G, slots = plain._batch.graph(0), plain._batch.slots
    start = plain._batch._start(np.random.default_rng(0))[:, :3]
    other = formation_v0.parallel_env(
        formation=slots[order], graph=G[np.ix_(order, order)], start=start[order]
    )
    rng = np.random.default_rng(0)
    plain.reset(seed=0), other.reset(seed=0)
    for _ in range(30):
        actions = rng.uniform(-0.1, 0.1, (6, 4)).astype(np.float32)
        one = plain.step(dict(zip(plain.possible_agents, actions, strict=True)))
        two = other.step(dict(zip(other.possible_agents, actions[order], strict=True)))
        assert np.allclose(np.array(list(one[1].values()))[order], list(two[1].values()), rtol=1e-12)
    views = [plain.task.layout.decode(np.stack(list(found[0].values()))) for found in (one, two)]
    for i in range(6):
        mine = sorted(map(tuple, views[0].comm[order[i]]))
        assert np.allclose(mine, sorted(map(tuple, views[1].comm[i])), atol=1e-6)


def test_the_task_does_not_know_where_it_is():
    far = np.array([30.0, -20.0, 10.0])
    reference = quad_envs.Line((0.5, 0.0, -0.2))
    moved = quad_envs.from_function(lambda t: (*(far + np.array([0.5, 0.0, -0.2]) * t), 0.5, 0.0, -0.2, 0.0))
    start = np.array([[0.0, i, 0.0] for i in range(6)])
    here = formation_v0.parallel_env(start=start, reference=reference)
    there = formation_v0.parallel_env(start=start + far, reference=moved)
    for one, two in zip(fly(here, 20), fly(there, 20), strict=True):
        for mine, other in zip(one[0], two[0], strict=True):
            assert np.allclose(mine, other, atol=1e-5)


# ------------ bad input
@pytest.mark.parametrize(
    ("module", "kwargs", "message"),
    [
        (formation_v0, {"vehicles": 1}, "vehicles must be an integer from 2 to 200"),
        (formation_v0, {"vehicles": 5, "formation": "triangle"}, "triangle.*3, 6, 10"),
        (formation_v0, {"formation": ((0.0, 0.0, 0.0),) * 6}, "apart"),
        (formation_v0, {"graph": np.eye(5)}, r"6"),
        (formation_v0, {"graph": "weka"}, "did you mean 'weak'"),
        (formation_v0, {"vehicles": 20, "graph": "complete"}, "pass neighbours=19"),
        (formation_v0, {"start": ((0.0, 0.0, 0.0),) * 6}, "coincide|apart"),
        (formation_v0, {"drop_out": 1.5}, "drop_out must be a number from 0 to 1"),
        (formation_v0, {"delay": -1}, "delay must be an integer >= 0"),
        (formation_v0, {"delay": 10, "message_lifetime": 0.2}, "message_lifetime must be a number from 0.5"),
        (formation_v0, {"crash_distance": 0.5}, "below the separation"),
        (formation_v0, {"comm": "pigeon"}, "comm must be 'state' or 'plan'"),
        (formation_v0, {"terminate": "both"}, "terminate must be 'team' or 'agent'"),
        (formation_v0, {"max_cycles": 0}, "max_cycles must be an integer >= 1"),
        (formation_v0, {"render_mode": "ascii"}, "render_mode"),
        (formation_v0, {"reference": "spiarl"}, "did you mean 'spiral'"),
        (target_tracking_v0, {"vehicles": 4}, "'chapter-7' has 6 slots"),
        (target_tracking_v0, {"measuring": (0, 6)}, "measuring names vehicle 6"),
        (target_tracking_v0, {"measuring": "none"}, "measuring must be 'all'"),
        (target_tracking_v0, {"sensor": "sonar"}, "sensor"),
        (target_tracking_v0, {"sensor_sigma": (0.1, 0.0, 0.1)}, "sensor_sigma must be positive"),
        (target_tracking_v0, {"detection": -0.1}, "detection must be a number from 0 to 1"),
        (target_tracking_v0, {"target": "ufo"}, "target"),
        (cooperative_estimation_v0, {"rails": ((0.0, 0.0, 0.0),) * 4}, "coincide"),
        (cooperative_estimation_v0, {"vehicles": 3, "graph": "ring"}, "rails must be 3 positions"),
        (cooperative_estimation_v0, {"comm": "plan"}, "on rails"),
    ],
)
def test_bad_arguments_are_refused_by_name(module, kwargs, message):
    with pytest.raises(ValueError, match=message):
        module.parallel_env(**kwargs).reset(seed=0)


def test_an_unknown_argument_names_the_nearest():
    with pytest.raises(TypeError, match="did you mean 'vehicles'"):
        formation_v0.parallel_env(vehicels=4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda actions: actions.pop("quad_3"), r"missing \['quad_3'\]"),
        (lambda actions: actions.update(quad_9=np.zeros(4)), r"extra \['quad_9'\]"),
        (lambda actions: actions.update(quad_2=np.zeros(3)), "action of quad_2 must be 4 numbers"),
        (lambda actions: actions.update(quad_2="up"), "action of quad_2 must be 4 numbers"),
        (lambda actions: actions.update(quad_2=np.full(4, np.inf)), r"action\[0\] of vehicle 2"),
    ],
)
def test_a_bad_action_is_refused_and_nobody_moves(change, message):
    env = formation_v0.parallel_env()
    env.reset(seed=0)
    before, actions = env.plants, {name: np.zeros(4, np.float32) for name in env.agents}
    change(actions)
    with pytest.raises(ValueError, match=message):
        env.step(actions)
    assert np.array_equal(env.plants, before) and len(env.agents) == 6


def test_a_step_needs_a_reset():
    with pytest.raises(ValueError, match="call reset"):
        formation_v0.parallel_env().step({})


def test_vehicles_may_not_start_in_each_other():
    env, state = formation_v0.parallel_env(), np.zeros((6, 12))
    state[:, 1] = [0.0, 1.0, 2.0, 2.2, 4.0, 5.0]
    with pytest.raises(ValueError, match=r"vehicles 2 and 3 start 0\.2 m apart"):
        env.reset(options={"state": state})
    with pytest.raises(ValueError, match=r"\(6, 12\) or \(6, 16\)"):
        env.reset(options={"state": np.zeros(12)})
    with pytest.raises(ValueError, match="did you mean 'state'"):
        env.reset(options={"states": state})


@pytest.mark.parametrize(
    ("module", "kwargs"),
    [
        (formation_v0, {"graph": np.eye(6)}),
        (formation_v0, {"drop_out": 1.0}),
        (target_tracking_v0, {"graph": "case-2", "measuring": (5,)}),
        (target_tracking_v0, {"measuring": ()}),
    ],
)
def test_a_team_that_cannot_be_reached_warns_and_flies(module, kwargs):
    with pytest.warns(UserWarning, match="no spanning tree|loses every message"):
        env = module.parallel_env(**kwargs)
    assert not env.task.spanning_tree
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(fly(env, 5)) == 6


def test_a_target_inside_a_vehicle_is_measured_as_numbers():
    env = target_tracking_v0.parallel_env(
        target="static", start=((3.0, 0.0, 0.0), *((0.0, i, 0.0) for i in range(5)))
    )
    view = fly(env, 0)[0][0]
    assert np.isfinite(view.measured).all() and view.measured[0, 0, 0] == 1.0


# ------------ good manners
def test_nothing_that_was_handed_out_changes_later():
    env = formation_v0.parallel_env()
    seen, infos = env.reset(seed=0)
    kept = pickle.dumps((seen, infos))
    for _ in range(5):
        env.step({name: np.full(4, 0.1, np.float32) for name in env.agents})
    assert pickle.dumps((seen, infos)) == kept


def test_a_pickled_environment_flies_on_alike():
    env = target_tracking_v0.parallel_env()
    fly(env, 5)
    twin = pickle.loads(pickle.dumps(env))
    actions = {name: np.full(4, 0.1, np.float32) for name in env.agents}
    one, two = env.step(actions), twin.step(actions)
    assert all(np.array_equal(one[0][name], two[0][name]) for name in env.possible_agents)


def test_actions_outside_the_box_are_clipped_and_counted():
    env, twin = formation_v0.parallel_env(), formation_v0.parallel_env()
    env.reset(seed=0), twin.reset(seed=0)
    _, _, _, _, infos = env.step({name: np.full(4, 3.0) for name in env.agents})
    twin.step({name: np.ones(4, np.float32) for name in twin.agents})
    assert np.array_equal(env.plants, twin.plants)
    assert infos["quad_4"]["clipped_actions"] == 4
