"""The vector environment equals single environments row by row, in every autoreset mode."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from quad_envs.envs.tracking.kernel import step_flights
from quad_envs.lanes import LANES
from quad_envs.registration import TRACKING

RANDOM = {
    "randomize": 0.1,
    "sensor_noise": 0.01,
    "disturbance": "gusts",
    "reveal_disturbance": True,
    "tilt_limit": 0.4,
    "rate_limit": 20.0,
    "time_limit": 0.6,
}
N = 5


def make_pair(env_id, n=N, mode=AutoresetMode.NEXT_STEP, **kwargs):
    vector = gym.make_vec(env_id, num_envs=n, autoreset_mode=mode, **kwargs)
    return vector, [gym.make(env_id, **kwargs).unwrapped for _ in range(n)]


def actions_of(rng, n):
    return rng.uniform(-1.0, 1.0, (n, 4)).astype(np.float32)


def assert_info_row(infos, i, info):
    for key, value in info.items():
        assert np.array_equal(np.asarray(infos[key][i]), np.asarray(value)), key


@pytest.mark.parametrize("env_id", TRACKING)
@pytest.mark.parametrize("n", [N, 2 * LANES + 3])
def test_rows_equal_single_environments_across_next_step_autoreset(env_id, n):
    vector, singles = make_pair(env_id, n, **RANDOM)
    rng = np.random.default_rng(0)
    observations, infos = vector.reset(seed=7)
    for i, env in enumerate(singles):
        observation, info = env.reset(seed=7 + i)
        assert np.array_equal(observations[i], observation)
        assert_info_row(infos, i, info)
    done = np.zeros(n, dtype=bool)
    for _ in range(30):
        actions = actions_of(rng, n)
        observations, rewards, terminated, truncated, infos = vector.step(actions)
        for i, env in enumerate(singles):
            if done[i]:
                observation, info = env.reset()
                expected = (0.0, False, False)
            else:
                observation, *expected, info = env.step(actions[i])
            assert np.array_equal(observations[i], observation)
            assert (rewards[i], terminated[i], truncated[i]) == tuple(expected)
            assert_info_row(infos, i, info)
        done = terminated | truncated


def test_same_step_autoreset_gives_the_last_and_the_first_observation():
    vector, singles = make_pair("quad/HelixTracking-v0", mode=AutoresetMode.SAME_STEP, **RANDOM)
    rng = np.random.default_rng(1)
    vector.reset(seed=0)
    for i, env in enumerate(singles):
        env.reset(seed=i)
    ends = 0
    for _ in range(30):
        actions = actions_of(rng, N)
        observations, rewards, terminated, truncated, infos = vector.step(actions)
        for i, env in enumerate(singles):
            last, reward, ended, cut, info = env.step(actions[i])
            assert (rewards[i], terminated[i], truncated[i]) == (reward, ended, cut)
            if ended or cut:
                ends += 1
                assert np.array_equal(infos["final_obs"][i], last)
                assert_info_row(infos["final_info"], i, info)
                last, info = env.reset()
            assert np.array_equal(observations[i], last)
            assert_info_row(infos, i, info)
    assert ends >= N


def test_without_autoreset_a_masked_reset_begins_only_the_chosen_rows():
    vector = gym.make_vec("quad/HelixTracking-v0", num_envs=3, autoreset_mode=AutoresetMode.DISABLED)
    vector.reset(seed=0)
    stepped = vector.step(np.zeros((3, 4), np.float32))[0]
    observations, infos = vector.reset(options={"reset_mask": np.array([False, True, False])})
    assert np.array_equal(observations[[0, 2]], stepped[[0, 2]])
    assert not np.array_equal(observations[1], stepped[1])
    assert infos["episode_cost"].shape == (3,)


def test_rows_that_are_not_reset_show_their_present_observation():
    vector = gym.make_vec("quad/HelixTracking-v0", num_envs=2)
    vector.reset(seed=0)
    for _ in range(5):
        stepped = vector.step(np.full((2, 4), 0.1, np.float32))[0]
    observations, _ = vector.reset(options={"reset_mask": np.array([True, False])})
    assert np.array_equal(observations[1], stepped[1]) and not np.array_equal(observations[0], stepped[0])


def test_the_first_reset_cannot_be_partial():
    vector = gym.make_vec("quad/HelixTracking-v0", num_envs=2)
    with pytest.raises(ValueError, match="first reset"):
        vector.reset(options={"reset_mask": np.array([True, False])})


def test_start_states_need_one_row_per_flight():
    vector = gym.make_vec("quad/HelixTracking-v0", num_envs=3)
    with pytest.raises(ValueError, match="3 rows"):
        vector.reset(options={"state": np.zeros((2, 12))})


def test_observations_and_infos_share_no_memory_between_calls():
    vector = gym.make_vec("quad/HelixTracking-v0", num_envs=3, rate_limit=1.0)
    first, infos = vector.reset(seed=0)
    kept = first.copy(), {key: np.array(value) for key, value in infos.items()}
    vector.step(np.full((3, 4), 0.5, np.float32))
    assert np.array_equal(first, kept[0])
    assert all(np.array_equal(infos[key], kept[1][key]) for key in infos)


def test_seeds_may_be_given_one_by_one():
    vector = gym.make_vec("quad/HelixTracking-v0", num_envs=2)
    observations, _ = vector.reset(seed=[5, 5])
    assert np.array_equal(observations[0], observations[1])


def test_max_episode_steps_of_make_vec_shortens_the_episode():
    gym.register("quad/Short-v0", **_spec_kwargs(), max_episode_steps=7)
    vector = gym.make_vec("quad/Short-v0", num_envs=2)
    vector.reset(seed=0)
    cuts = [vector.step(np.zeros((2, 4), np.float32))[3].all() for _ in range(7)]
    assert cuts == [False] * 6 + [True]
    del gym.registry["quad/Short-v0"]


def _spec_kwargs():
    spec = gym.spec("quad/HelixTracking-v0")
    return {
        "entry_point": spec.entry_point,
        "vector_entry_point": spec.vector_entry_point,
        "kwargs": spec.kwargs,
    }


def test_a_pickled_vector_environment_continues_the_same_flight():
    vector = gym.make_vec("quad/HelixTracking-v0", num_envs=2)
    vector.reset(seed=3)
    copy = pickle.loads(pickle.dumps(vector))
    actions = np.full((2, 4), 0.1, np.float32)
    assert np.array_equal(vector.step(actions)[0], copy.step(actions)[0])


@pytest.mark.parametrize(
    ("actions", "message"),
    [(np.zeros((2, 3)), "shape"), (np.array([[0, 0, 0, 0], [0, np.nan, 0, 0]]), r"action\[1, 1\]")],
)
def test_bad_actions_are_refused(actions, message):
    vector = gym.make_vec("quad/HelixTracking-v0", num_envs=2)
    vector.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        vector.step(actions)


def test_step_before_reset_is_refused():
    with pytest.raises(gym.error.ResetNeeded):
        gym.make_vec("quad/HelixTracking-v0", num_envs=2).step(np.zeros((2, 4), np.float32))


@pytest.mark.parametrize("n", [0, -1])
def test_an_empty_vector_is_refused(n):
    with pytest.raises(ValueError, match="num_envs must be a whole number >= 1"):
        gym.make_vec("quad/HelixTracking-v0", num_envs=n)


def test_nothing_that_a_step_returned_changes_in_later_ones_or_is_shared_within_it():
    env = gym.make_vec("quad/HelixTracking-v0", num_envs=N, tilt_limit=0.4)
    env.reset(seed=0)
    rng, kept, copies = np.random.default_rng(0), [], []
    for _ in range(3):
        *arrays, info = env.step(actions_of(rng, N))
        kept.append([*arrays, *(values for name, values in info.items() if not name.startswith("_"))])
        copies.append([array.copy() for array in kept[-1]])
    for arrays, before in zip(kept, copies, strict=True):
        for k, array in enumerate(arrays):
            assert np.array_equal(array, before[k])
            assert not any(np.shares_memory(array, other) for other in arrays[:k])
            assert array.flags.writeable


def test_actions_that_may_not_be_written_to_are_flown_as_others_and_compile_nothing():
    envs = [gym.make_vec("quad/HelixTracking-v0", num_envs=N) for _ in range(2)]
    actions = actions_of(np.random.default_rng(0), N)
    fixed = actions.copy()
    fixed.flags.writeable = False
    for env in envs:
        env.reset(seed=0)
    forms = len(step_flights.entry.overloads)
    for _ in range(3):
        results = [env.step(given)[0] for env, given in zip(envs, (actions, fixed), strict=True)]
        assert np.array_equal(*results)
    assert len(step_flights.entry.overloads) == max(forms, 1)
