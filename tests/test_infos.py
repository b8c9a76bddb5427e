"""In which form environments tell their infos: numbers of one flight, arrays of many or on request."""

import json

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

from baselines import evaluate, make_policy
from quad_envs import ArrayInfo

HELIX = "quad/HelixTracking-v0"
LIMITED = {"kappa": 0.3125, "tilt_limit": 0.35}  # so that constraint_values has entries


def step_info(env):
    env.reset(seed=0)
    return env.step(np.zeros(env.action_space.shape, np.float32))[-1]


def test_a_single_environment_tells_numbers_that_json_and_a_deep_copy_take_cheaply():
    for info in (step_info(gym.make(HELIX, **LIMITED)), gym.make(HELIX, **LIMITED).reset(seed=0)[1]):
        numbers = {name: value for name, value in info.items() if name != "constraint_values"}
        assert {type(value) for value in numbers.values()} == {float, int, bool}
        assert json.loads(json.dumps(numbers)) == numbers


@pytest.mark.parametrize("wrap", [lambda env: env, ArrayInfo], ids=["numbers", "arrays"])
def test_vectors_of_single_environments_have_the_dtypes_of_the_native_one(wrap):
    """Gymnasium makes object arrays of what it does not know, as of numpy's booleans."""
    native = step_info(gym.make_vec(HELIX, num_envs=2, **LIMITED))
    many = gym.vector.SyncVectorEnv([lambda: wrap(gym.make(HELIX, **LIMITED))] * 2)
    stacked = step_info(many)
    for name, values in native.items():
        assert stacked[name].dtype == values.dtype, name
        assert stacked[name].shape == values.shape, name


def test_array_info_gives_every_value_a_dtype_and_changes_none():
    plain, wrapped = gym.make(HELIX, **LIMITED), ArrayInfo(gym.make(HELIX, **LIMITED))
    for told, arrays in (
        (plain.reset(seed=0)[1], wrapped.reset(seed=0)[1]),
        (step_info(plain), step_info(wrapped)),
    ):
        assert list(told) == list(arrays)
        for name, value in arrays.items():
            assert isinstance(value, np.ndarray) and value.dtype != object
            assert value.shape == np.shape(told[name])
            np.testing.assert_array_equal(value, told[name])


def test_array_info_is_recorded_in_the_spec_and_no_obstacle_to_a_policy():
    env = ArrayInfo(gym.make(HELIX))
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert isinstance(again, ArrayInfo)
    scores = [evaluate(make_policy("lqr", one), one, 1).records[0].score for one in (env, gym.make(HELIX))]
    assert scores[0] == scores[1]
