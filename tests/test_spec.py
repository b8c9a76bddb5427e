"""What `env.spec` says: the length of an episode, a good return, and how to make the environment again."""

import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import RecordEpisodeStatistics, TimeLimit

from baselines import evaluate, make_policy, run_episodes
from quad_envs import Gusts, Heading, Helix, from_function
from quad_envs.envs.tracking.env import TrackingEnv
from quad_envs.registration import NMPC_SCORES, TRACKING

HELIX = "quad/HelixTracking-v0"
STILL = np.zeros(4, np.float32)


def steps_of(env):
    """Steps until truncation of a vehicle that hovers at its set point."""
    env.reset(seed=0, options={"state": [0.0] * 12})
    for k in range(1, 10_000):
        _, _, terminated, truncated, _ = env.step(STILL)
        assert not terminated
        if truncated:
            return k


@pytest.mark.parametrize("env_id", TRACKING)
def test_every_id_registers_its_steps_and_a_good_return(env_id):
    registered, env = gym.spec(env_id), gym.make(env_id)
    assert registered.max_episode_steps == env.spec.max_episode_steps == env.unwrapped.task.episode_steps
    assert env.spec.reward_threshold == registered.reward_threshold
    assert registered.reward_threshold == pytest.approx(NMPC_SCORES[env_id] * registered.max_episode_steps)


@pytest.mark.slow
@pytest.mark.parametrize("env_id", TRACKING)
def test_the_good_return_is_that_of_exact_nmpc(env_id):
    env = gym.make(env_id)
    score = evaluate(make_policy("nmpc", env), env, episodes=20, seed=0).summary()["score"].mean
    # Three digits are registered; the score may move by as much before they must be flown again.
    assert score == pytest.approx(NMPC_SCORES[env_id], abs=2e-3)


@pytest.mark.parametrize(
    ("kwargs", "steps"),
    [
        ({}, 200),
        ({"max_episode_steps": 500}, 500),
        ({"max_episode_steps": 50}, 50),
        ({"max_episode_steps": -1}, 200),
        ({"time_limit": 20.0}, 400),
        ({"time_limit": 2.0}, 40),
        ({"dt": 0.1}, 100),
        ({"dt": 0.1, "max_episode_steps": 150}, 150),
        ({"time_limit": 20.0, "max_episode_steps": 400}, 400),
    ],
)
def test_an_episode_is_as_long_as_was_asked_for_however_it_was_asked(kwargs, steps):
    env = gym.make(HELIX, reference="setpoint", **kwargs)
    assert steps_of(env) == env.spec.max_episode_steps == env.unwrapped.task.episode_steps == steps
    assert env.spec.reward_threshold == pytest.approx(NMPC_SCORES[HELIX] * steps)


def test_ids_with_a_time_limit_of_their_own_can_be_made_longer():
    assert gym.make("quad/CorridorTracking-v0", max_episode_steps=500).unwrapped.task.episode_steps == 500


def test_of_two_contradicting_limits_the_shorter_holds_with_a_warning():
    for time_limit, steps, shorter in ((20.0, 500, 400), (20.0, 100, 100)):
        with pytest.warns(UserWarning, match=r"max_episode_steps=.* time_limit=20 s: the shorter holds"):
            env = gym.make(HELIX, reference="setpoint", time_limit=time_limit, max_episode_steps=steps)
        assert steps_of(env) == shorter


def test_the_whole_of_a_longer_episode_has_its_own_reference():
    env = gym.make(HELIX, max_episode_steps=500)
    t = 0.05 * np.arange(501)
    np.testing.assert_allclose(env.unwrapped.reference[:501, 2], 3.0 * t, atol=1e-9)


def test_who_stays_behind_a_longer_helix_is_lost_on_the_way_and_who_follows_flies_all_of_it():
    # The helix descends at 3 m/s: a vehicle that hovers is 50 m away after 16.65 s, whatever the limit says.
    env = gym.make(HELIX, max_episode_steps=500)
    env.reset(seed=0, options={"state": [0.0] * 12})
    k = 0
    while not env.step(STILL)[2]:
        k += 1
    assert k + 1 == 333
    episode = next(run_episodes(make_policy("lmpc", env), env, 1))
    assert episode.truncated and not episode.terminated and len(episode.rewards) == 500


def test_vectors_and_environments_made_by_hand_take_the_steps_too():
    vector = gym.make_vec(HELIX, num_envs=2, max_episode_steps=500)
    assert vector.task.episode_steps == vector.spec.max_episode_steps == 500
    assert gym.make_vec(HELIX, num_envs=2, time_limit=20.0).task.episode_steps == 400
    inner = gym.make_vec(HELIX, 2, vectorization_mode="sync", max_episode_steps=500).envs[0]
    assert inner.unwrapped.task.episode_steps == 500
    assert TrackingEnv(max_episode_steps=70).task.episode_steps == 70


@pytest.mark.parametrize("steps", [0, 2.5, "many"])
def test_steps_that_are_none_are_refused(steps):
    with pytest.raises(ValueError, match="max_episode_steps must be a whole number >= 1"):
        gym.make_vec(HELIX, num_envs=2, max_episode_steps=steps)


def test_without_a_number_nothing_counts_beside_the_environment():
    env = gym.make(HELIX)
    while isinstance(env, gym.Wrapper):
        assert not isinstance(env, TimeLimit)
        env = env.env


def test_ids_of_somebody_else_may_register_steps_and_derived_classes_are_told():
    class Mine(TrackingEnv):
        def __init__(self, **kwargs):
            super().__init__(**kwargs)

    gym.register("lab/Mine-v0", entry_point=Mine, kwargs={"reference": "setpoint"}, max_episode_steps=300)
    try:
        assert steps_of(gym.make("lab/Mine-v0")) == 300
        assert steps_of(gym.make("lab/Mine-v0", max_episode_steps=320)) == 320
    finally:
        del gym.registry["lab/Mine-v0"]


KWARGS = [
    {},
    {"reference": Heading(Helix(radius=2.0), rate=0.3), "disturbance": Gusts(force=0.1), "time_limit": 12.0},
    {"reference": {"kind": "helix", "radius": 2}, "max_episode_steps": 300, "kappa": np.float64(0.5)},
    {"reference": np.column_stack([0.01 * np.arange(201)] * 3), "Q": np.ones(12), "start": "reference"},
    {"randomize": {"mass": 0.1}, "position_limit": ((-9, -9, -9), (9, 9, 99)), "tilt_limit": float("inf")},
]


def same_flight(one, other):
    for env in (one, other):
        env.reset(seed=3)
    np.testing.assert_array_equal(one.unwrapped.reference, other.unwrapped.reference)
    for _ in range(5):
        np.testing.assert_array_equal(one.step(STILL)[0], other.step(STILL)[0])


@pytest.mark.parametrize("kwargs", KWARGS, ids=lambda kwargs: " ".join(kwargs) or "defaults")
def test_an_environment_is_recovered_from_its_specification(kwargs):
    env = RecordEpisodeStatistics(gym.make(HELIX, **kwargs))
    text = env.spec.to_json()
    for spec in (env.spec, EnvSpec.from_json(text), pickle.loads(pickle.dumps(env.spec))):
        again = gym.make(spec)
        assert isinstance(again, RecordEpisodeStatistics)
        assert again.unwrapped.task == env.unwrapped.task
        kept = again.spec.kwargs | {"max_episode_steps": env.spec.kwargs.get("max_episode_steps")}
        assert {key: value for key, value in kept.items() if value is not None} == env.spec.kwargs
        assert EnvSpec.from_json(again.spec.to_json()).max_episode_steps == env.spec.max_episode_steps
        same_flight(again, env)


def test_a_vector_is_recovered_from_its_specification():
    vector = gym.make_vec(HELIX, num_envs=3, reference=Helix(radius=2.0), max_episode_steps=300)
    for spec in (vector.spec, EnvSpec.from_json(vector.spec.to_json())):
        again = gym.make_vec(spec)
        assert again.num_envs == 3 and again.task == vector.task
        np.testing.assert_array_equal(again.reference, vector.reference)


def test_a_table_is_recovered_from_its_file(tmp_path):
    path = tmp_path / "up.csv"
    path.write_text("t,x,y,z\n" + "\n".join(f"{t},0,0,{0.1 * t}" for t in range(11)) + "\n")
    env = gym.make(HELIX, reference={"kind": "csv", "path": path, "axes": "enu"})
    same_flight(gym.make(EnvSpec.from_json(env.spec.to_json())), env)


def test_a_path_alone_stays_a_path(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t,x,y,z\n" + "\n".join(f"{t},0,0,0" for t in range(11)) + "\n")
    assert gym.make(HELIX, reference=path).spec.kwargs["reference"] == str(path)


def falls(t):
    return (0.0, 0.0, t)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"reference": falls},
        {"reference": Heading(from_function(falls), rate=0.1)},
        {"disturbance": lambda t: (0.0, 0.0, 0.1)},
    ],
)
def test_what_json_cannot_hold_is_named_and_can_be_made_again_all_the_same(kwargs):
    env = gym.make(HELIX, **kwargs)
    with pytest.raises(ValueError, match=f"{next(iter(kwargs))} holds a .*which JSON cannot: give a name"):
        env.spec.to_json()
    same_flight(gym.make(env.spec), env)


def test_the_return_of_another_reward_has_no_threshold():
    assert gym.make(HELIX, reward="quadratic").spec.reward_threshold is None


def test_what_was_passed_stays_as_it_was():
    mapping = {"kind": "helix", "radius": 2}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gym.make(HELIX, reference=mapping)
    assert mapping == {"kind": "helix", "radius": 2}
