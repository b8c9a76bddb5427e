"""Crashes in teams: what they cost, and what is seen and counted of who left and of who flies on."""

import numpy as np
import pytest

from quad_envs import formation_v0


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


def test_a_crash_says_who_and_why():
    for terminate in ("team", "agent"):
        env, (_, _, _, _, infos) = collide(terminate)
        causes = [env.task.crash_causes[info["crash_cause"]] for info in infos.values()]
        assert causes == ["", "distance", "distance", "", "", ""]
    env, state = formation_v0.parallel_env(vehicles=2, graph="chain"), np.zeros((2, 12))
    state[1, 1], state[0, 9] = 5.0, 40.0
    env.reset(options={"state": state})
    *_, infos = env.step({name: np.zeros(4, np.float32) for name in env.agents})
    causes = [env.task.crash_causes[infos[name]["crash_cause"]] for name in ("quad_0", "quad_1")]
    assert causes == ["tilt", ""]
    assert all(info["crashed"] for info in infos.values()), "the episode of both ended in a crash"


def test_a_step_without_actions_after_the_end_gives_nothing_as_in_pettingzoos_environments():
    env, _ = collide("team")
    assert env.step({}) == ({}, {}, {}, {}, {})
    with pytest.raises(ValueError, match="call reset"):
        formation_v0.parallel_env().step({})


def test_the_cost_of_the_crash_counts():
    for terminate in ("team", "agent"):
        _, (*_, infos) = collide(terminate)
        assert infos["quad_1"]["cost"] > 0.0
        assert infos["quad_1"]["episode_cost"] == infos["quad_1"]["cost"]


def test_who_crashes_still_sees_where():
    _, (seen, *_) = collide("agent")
    assert abs(np.hypot(*seen["quad_1"][5:7]) - 1.0) < 1e-6, "sine and cosine of the heading"


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
    graph = env.state()[env.state_slices["graph"]].reshape(6, 6)
    assert not graph[[1, 2]].any() and not graph[:, [1, 2]].any() and graph[3, 3] == 1.0
    with pytest.raises(ValueError, match="quad_1, quad_2 left the episode"):
        env.step({name: np.zeros(4, np.float32) for name in env.possible_agents})


def test_who_flies_alone_is_as_far_from_the_others_as_can_be():
    env = formation_v0.parallel_env(vehicles=3, formation="triangle", terminate="agent")
    state = np.zeros((3, 12))
    state[:, 1] = [0.0, 10.0, 10.5]
    state[1, 4], state[2, 4] = 3.0, -3.0
    env.reset(seed=0, options={"state": state})
    for _ in range(2):
        *_, infos = env.step({name: np.zeros(4, np.float32) for name in env.agents})
    assert infos["quad_0"]["min_separation"] == 200.0


def test_nothing_counts_in_the_rows_of_vehicles_that_left():
    many, state = formation_v0.vector_env(1, graph="strong", terminate="agent"), np.zeros((6, 12))
    state[:, 1] = [0.0, 10.0, 10.5, 20.0, 30.0, 40.0]
    state[1, 4], state[2, 4] = 3.0, -3.0
    many.reset(seed=0, options={"state": state})
    actions = np.zeros((6, 4), np.float32)
    *_, first = many.step(actions)
    _, rewards, terminated, _, later = many.step(actions)
    assert first["cost"][1] > 0.0 and terminated.tolist() == [False, True, True, False, False, False]
    assert later["alive"].tolist() == [True, False, False, True, True, True]
    for name in ("cost", "stage_cost", "constraint_violation"):
        assert not later[name][1:3].any()
    assert not later["reward_terms"][1:3].any() and not rewards[1:3].any()
    assert later["episode_cost"][1] == first["episode_cost"][1]


def test_leaving_the_arena_and_turning_over_are_crashes():
    for start, velocity in (((99.99, 0.0, 0.0), (9.0, 0.0, 0.0)), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))):
        env, state = formation_v0.parallel_env(vehicles=2, graph="chain"), np.zeros((2, 12))
        state[1, 1] = 5.0
        state[0, :3], state[0, 3:6] = start, velocity
        state[0, 9] = 0.0 if velocity[0] else 40.0
        env.reset(options={"state": state})
        _, _, terminated, _, _ = env.step({name: np.zeros(4, np.float32) for name in env.agents})
        assert all(terminated.values())
