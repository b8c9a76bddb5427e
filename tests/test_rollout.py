"""Rollouts: single, vector and multi-agent environments give the same flights."""

from __future__ import annotations

import math

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from pettingzoo import ParallelEnv

from baselines import evaluate, make_policy, measure, run_episodes
from quad_envs.constraints import forces_from_actions

HELIX = "quad/HelixTracking-v0"
CRASHING = {
    "kappa": 0.5,
    "tilt_limit": 0.4,
    "sensor_noise": 0.01,
}  # random policy: every flight ends early, by turns


class Formation(ParallelEnv):
    """Tracking tasks side by side as a ParallelEnv; an agent leaves when its flight ends."""

    metadata = {"name": "side_by_side"}  # noqa: RUF012

    def __init__(self, n, **kwargs):
        self.envs = {f"quad_{i}": gymnasium.make(HELIX, **kwargs).unwrapped for i in range(n)}
        self.possible_agents, self.agents = list(self.envs), []
        self.task = self.envs["quad_0"].task

    def observation_space(self, agent):
        return self.envs[agent].observation_space

    def action_space(self, agent):
        return self.envs[agent].action_space

    @property
    def plants(self):
        return np.stack([env.state for env in self.envs.values()])

    @property
    def references(self):
        return np.stack([env.reference for env in self.envs.values()])

    def reset(self, seed=None, options=None):
        self.agents = list(self.possible_agents)
        both = {name: env.reset(seed=100 * seed + i) for i, (name, env) in enumerate(self.envs.items())}
        return {name: pair[0] for name, pair in both.items()}, {name: pair[1] for name, pair in both.items()}

    def step(self, actions):
        assert set(actions) == set(self.agents)
        results = {name: self.envs[name].step(action) for name, action in actions.items()}
        self.agents = [name for name in self.agents if not (results[name][2] or results[name][3])]
        return tuple({name: result[part] for name, result in results.items()} for part in range(5))


def test_a_flight_records_what_the_environment_said():
    env = gymnasium.make(HELIX, tilt_limit=0.3, rate_limit=20.0)
    policy = make_policy("random", env)
    episode = next(run_episodes(policy, env, 1, seed=5))
    steps = len(episode.rewards)
    observation, _ = env.reset(seed=5)
    np.testing.assert_array_equal(episode.states[0], env.unwrapped.state)
    np.testing.assert_array_equal(episode.references, env.unwrapped.reference[: steps + 1])
    state, start = None, [True]
    for k in range(steps):
        action, state = policy.predict(observation[None], state, start)
        start = [False]
        observation, reward, terminated, truncated, info = env.step(action[0])
        assert (episode.rewards[k], episode.stage_costs[k]) == (reward, info["stage_cost"])
        assert (episode.costs[k], episode.violations[k]) == (info["cost"], info["constraint_violation"])
        np.testing.assert_array_equal(episode.constraint_values[k], info["constraint_values"])
        np.testing.assert_array_equal(episode.states[k + 1], env.unwrapped.state)
        task = env.unwrapped.task
        np.testing.assert_array_equal(
            episode.commands[k], forces_from_actions(action[0], task.hover_force, task.force_max)
        )
    assert (episode.terminated, episode.truncated) == (terminated, truncated)
    assert episode.fallbacks.tolist() == [steps, 0, 0, 0, 0]


def test_every_decision_is_timed_and_compilation_is_not():
    env = gymnasium.make(HELIX)
    policy, calls = make_policy("hover", env), []
    real = policy.predict
    policy.predict = lambda *arguments, **options: calls.append(1) or real(*arguments, **options)
    times = next(run_episodes(policy, env, 1)).decision_times
    assert np.isfinite(times).all() and (times > 0.0).all()
    assert len(times) < len(calls)  # the first ones, which compile, are not of the flight


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
@pytest.mark.parametrize(("env_id", "kwargs"), [(HELIX, CRASHING), ("quad/RandomTracking-v0", CRASHING)])
def test_a_vector_environment_gives_the_flights_of_a_single_one(env_id, kwargs, mode):
    env = gymnasium.make(env_id, **kwargs)
    vector = gymnasium.make_vec(env_id, num_envs=4, autoreset_mode=mode, **kwargs)
    policy = make_policy("random", env)
    singles = list(run_episodes(policy, env, 6, seed=2))
    together = list(run_episodes(policy, vector, 6, seed=2))
    assert len({len(episode.rewards) for episode in singles}) > 1
    for one, other in zip(singles, together, strict=True):
        for name, value in one._asdict().items():
            if name not in ("task", "decision_times"):
                np.testing.assert_array_equal(value, getattr(other, name), err_msg=name)


def test_a_vector_environment_flies_full_episodes_too():
    vector = gymnasium.make_vec(HELIX, num_envs=3)
    episodes = list(run_episodes(make_policy("hover", vector), vector, 2))
    assert [episode.seed for episode in episodes] == [0, 1]
    assert all(episode.truncated and len(episode.rewards) == 200 for episode in episodes)
    assert all(np.isnan(episode.decision_times).all() for episode in episodes)


def test_a_shorter_time_limit_counts_the_same_in_single_and_vector_environments():
    envs = gymnasium.make(HELIX, max_episode_steps=50), gymnasium.make_vec(HELIX, 2, max_episode_steps=50)
    policy = make_policy("hover", HELIX)
    one, other = (measure(next(run_episodes(policy, env, 1))) for env in envs)
    assert one.steps == 50 and one.score == other.score > 0.0
    assert one.steady_rms == other.steady_rms > 0.0


def test_a_time_limit_put_around_an_environment_counts_where_it_is_the_shorter():
    inner = gymnasium.make(HELIX)
    for steps, flown in ((50, 50), (500, 200)):
        env = gymnasium.wrappers.TimeLimit(inner, steps)
        assert next(run_episodes(make_policy("hover", env), env, 1)).task.episode_steps == flown


def test_a_vector_environment_that_resets_in_the_same_step_is_refused():
    vector = gymnasium.make_vec(HELIX, num_envs=2, autoreset_mode=AutoresetMode.SAME_STEP)
    with pytest.raises(ValueError, match="SAME_STEP"):
        run_episodes(make_policy("hover", vector), vector, 1)


def test_agents_of_a_parallel_environment_are_rows():
    env = Formation(3, **CRASHING)
    policy = make_policy("random", env.task)
    episodes = list(run_episodes(policy, env, 2, seed=1))
    assert [episode.agent for episode in episodes] == 2 * ["quad_0", "quad_1", "quad_2"]
    alone = gymnasium.make(HELIX, **CRASHING)
    assert len({len(episode.rewards) for episode in episodes}) > 1
    for i, episode in enumerate(episodes):
        single = next(run_episodes(policy, alone, 1, seed=100 * (1 + i // 3) + i % 3))
        for name in ("states", "references", "commands", "rewards", "costs", "constraint_values", "crashed"):
            np.testing.assert_array_equal(getattr(episode, name), getattr(single, name), err_msg=name)


def test_a_parallel_environment_need_not_show_its_plants():
    class Closed(Formation):
        plants = references = property(lambda self: (_ for _ in ()).throw(AttributeError()))

    env = Closed(2)
    record = measure(next(run_episodes(make_policy("hover", env.task), env, 1)))
    assert record.steps == 200 and record.score > 0.0 and math.isnan(record.position_rms)


@pytest.mark.parametrize("episodes", [0, -3, 1.5, True])
def test_the_number_of_episodes_must_be_a_whole_positive_one(episodes):
    env = gymnasium.make(HELIX)
    with pytest.raises(ValueError, match="episodes must be a whole number >= 1"):
        run_episodes(make_policy("hover", env), env, episodes)


@pytest.mark.parametrize("seed", [-1, 0.5, True])
def test_the_seed_must_be_a_whole_number_that_is_not_negative(seed):
    env = gymnasium.make(HELIX)
    with pytest.raises(ValueError, match="seed must be a whole number >= 0"):
        run_episodes(make_policy("hover", env), env, 1, seed)


def test_environments_that_cannot_be_measured_are_refused_with_a_remedy():
    policy = make_policy("hover", HELIX)
    with pytest.raises(ValueError, match=r"cannot find the task of .*CartPole"):
        evaluate(policy, "CartPole-v1")
    with pytest.raises(ValueError, match=r'SyncVectorEnv hides .*vectorization_mode="vector_entry_point"'):
        evaluate(policy, gymnasium.make_vec(HELIX, num_envs=2, vectorization_mode="sync"))


def test_policies_fly_from_the_same_starts():
    env = gymnasium.make("quad/RandomTracking-v0", disturbance="gusts")
    flights = [list(run_episodes(make_policy(name, env), env, 3, seed=7)) for name in ("hover", "random")]
    for one, other in zip(*flights, strict=True):
        np.testing.assert_array_equal(one.states[0], other.states[0])
        np.testing.assert_array_equal(one.references[0], other.references[0])


def test_evaluate_takes_an_id_and_gives_the_records_of_its_flights():
    found = evaluate(make_policy("hover", HELIX), HELIX, episodes=3, seed=4)
    env = gymnasium.make(HELIX)
    records = [measure(episode) for episode in run_episodes(make_policy("hover", env), env, 3, seed=4)]
    assert [record.score for record in found.records] == [record.score for record in records]
    assert [record.seed for record in found.records] == [4, 5, 6]
    assert found.policy == "hover" and found.env_id == HELIX


def test_an_evaluation_keeps_no_flights():
    sizes = []
    seen = []
    found = evaluate(
        make_policy("hover", HELIX), HELIX, 3, on_episode=lambda e: sizes.append(e.states.nbytes)
    )
    seen.extend(value for record in found.records for value in record)
    assert len(sizes) == 3 and not any(isinstance(value, np.ndarray) for value in seen)


def test_an_evaluation_prints_every_metric():
    text = str(evaluate(make_policy("random", HELIX), HELIX, episodes=2))
    for word in ("score", "position_rms", "effort", "violation_share", "p99", "crashed 2"):
        assert word in text


def test_an_evaluation_as_json_has_no_nan():
    import json

    found = evaluate(make_policy("random", HELIX), HELIX, episodes=2).to_dict()
    text = json.dumps(found, allow_nan=False)
    assert json.loads(text)["summary"]["quadratic_cost"]["mean"] is None
