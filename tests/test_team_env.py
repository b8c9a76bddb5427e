"""The multi-agent environments: conformance, motion, rewards, bad input, and the batched form."""

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
from team_steps import DT, column, fly

import quad_envs
from quad_envs import cooperative_estimation_v0, formation_v0, target_tracking_v0
from quad_envs.constraints import TOLERANCE, forces_from_actions
from quad_envs.dynamics import simulate
from quad_envs.reward import stage_cost

MODULES = [formation_v0, target_tracking_v0, cooperative_estimation_v0]


def names(module):
    return module.__name__.rsplit(".", 1)[-1]


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


def test_a_masked_reset_begins_only_its_teams_anew():
    env = formation_v0.vector_env(3, autoreset_mode="Disabled")
    env.reset(seed=0)
    seen, *_ = env.step(np.full((18, 4), 0.1, np.float32))
    again, _ = env.reset(options={"reset_mask": np.array([True, False, False])})
    assert np.array_equal(again[6:], seen[6:]) and not np.array_equal(again[:6], seen[:6])
    rows = np.repeat([False, True, False], 6)
    assert np.array_equal(env.reset(options={"reset_mask": rows})[0][:6], again[:6])
    with pytest.raises(ValueError, match="alike for all vehicles of a team"):
        env.reset(options={"reset_mask": np.arange(18) == 0})
    with pytest.raises(ValueError, match=r"shape \(3,\) or \(18,\)"):
        env.reset(options={"reset_mask": np.ones(4, dtype=bool)})
    with pytest.raises(ValueError, match="first reset must begin all"):
        formation_v0.vector_env(2).reset(options={"reset_mask": np.array([True, False])})


def test_a_seed_of_a_masked_reset_is_for_its_teams_alone():
    env, plain = (formation_v0.vector_env(2, autoreset_mode="Disabled") for _ in range(2))
    second = {"reset_mask": np.array([False, True])}
    for vector in (env, plain):
        vector.reset(seed=0)
    env.reset(seed=7, options={"reset_mask": np.array([True, False])})
    drawn, expected = (vector.reset(options=second)[0][6:] for vector in (env, plain))
    assert np.array_equal(drawn, expected)


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
        (formation_v0, {"vehicles": 1}, "vehicles must be a whole number >= 2, got 1"),
        (formation_v0, {"vehicles": 5, "formation": "triangle"}, "triangle.*3, 6, 10"),
        (formation_v0, {"formation": ((0.0, 0.0, 0.0),) * 6}, "apart"),
        (formation_v0, {"graph": np.eye(5)}, r"6"),
        (formation_v0, {"graph": "weka"}, "did you mean 'weak'"),
        (formation_v0, {"vehicles": 20, "graph": "complete"}, "pass neighbours=19"),
        (formation_v0, {"start": ((0.0, 0.0, 0.0),) * 6}, "coincide|apart"),
        (formation_v0, {"drop_out": 1.5}, "drop_out must be a number from 0 to 1"),
        (formation_v0, {"delay": -1}, "delay must be a whole number >= 0"),
        (formation_v0, {"delay": 10, "message_lifetime": 0.2}, "at least the delay of 10 steps"),
        (formation_v0, {"message_lifetime": np.inf}, "message_lifetime must be a finite number"),
        (formation_v0, {"crash_distance": 0.5}, "below the separation"),
        (formation_v0, {"comm": "pigeon"}, "comm must be 'state' or 'plan'"),
        (formation_v0, {"terminate": "both"}, "terminate must be 'team' or 'agent'"),
        (formation_v0, {"max_cycles": 0}, "max_cycles must be a whole number >= 1"),
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
        (cooperative_estimation_v0, {"start": "line"}, "start has no effect"),
        (cooperative_estimation_v0, {"formation": "hexagon"}, "formation has no effect"),
        (target_tracking_v0, {"sensor_sigma": 0.1}, "three standard deviations"),
    ],
)
def test_bad_arguments_are_refused_by_name(module, kwargs, message):
    with pytest.raises(ValueError, match=message):
        module.parallel_env(**kwargs)


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
        (lambda actions: actions.update(quad_2=np.zeros((1, 4))), "action of quad_2 must be 4 numbers"),
        (
            lambda actions: actions.update(dict.fromkeys(actions, np.zeros((4, 1), np.float32))),
            "action of quad_0 must be 4 numbers",
        ),
        (
            lambda actions: actions.update(quad_2=np.zeros(3), quad_3=np.zeros(5)),
            "action of quad_2 must be 4 numbers",
        ),
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
        (target_tracking_v0, {"detection": 0.0}),
    ],
)
def test_a_team_that_cannot_be_reached_warns_and_flies(module, kwargs):
    with pytest.warns(UserWarning, match="no spanning tree") as said:
        env = module.parallel_env(**kwargs)
    assert len(said) == 1
    nobody = kwargs in ({"measuring": ()}, {"detection": 0.0})
    assert ("nobody measures: let somebody" in str(said[0].message)) == nobody
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
@pytest.mark.parametrize("module", MODULES, ids=names)
def test_infos_hold_numbers_alone_so_that_clients_can_make_tensors_of_them(module):
    _, infos = module.parallel_env().reset(seed=0)
    for key, value in infos["quad_1"].items():
        assert np.asarray(value).dtype.kind in "bif", key


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


@pytest.mark.parametrize("kind", ["lists", "doubles", "whole numbers", "columns"])
def test_actions_in_any_form_of_numbers_are_flown_as_those_of_the_space(kind):
    whole = np.random.default_rng(0).integers(-1, 2, (6, 4))
    columns = np.asfortranarray(whole.astype(np.float32))
    rows = {"lists": columns.tolist(), "doubles": columns.astype(float), "columns": columns}
    forms = (np.ascontiguousarray(columns), rows.get(kind, whole))
    seen = []
    for form in forms:
        env = formation_v0.parallel_env(vehicles=6)
        env.reset(seed=0)
        seen.append(env.step(dict(zip(env.agents, form, strict=True)))[0])
    assert all(np.array_equal(seen[0][name], seen[1][name]) for name in seen[0])
