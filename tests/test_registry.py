"""Every registered id passes the checkers of its users, and importing the package stays cheap."""

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import quad_envs
from quad_envs.registration import TRACKING, register

# A symmetric box that is unbounded in the observation is what Gymnasium's checker warns of, nothing else.
pytestmark = pytest.mark.filterwarnings("ignore:.*observation space (minimum|maximum) value is .*infinity.*")


@pytest.mark.parametrize("env_id", TRACKING)
def test_gymnasium_checker_passes(env_id):
    check_env(gym.make(env_id).unwrapped, skip_render_check=True)


@pytest.mark.parametrize("env_id", TRACKING)
def test_stable_baselines_checker_passes(env_id):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    checker.check_env(gym.make(env_id).unwrapped, skip_render_check=True)


@pytest.mark.parametrize("env_id", TRACKING)
def test_flight_is_the_same_in_another_process(env_id):
    code = (
        "import gymnasium as gym, numpy as np, quad_envs, hashlib\n"
        f"env = gym.make({env_id!r})\n"
        "digest = hashlib.sha256(env.reset(seed=11)[0].tobytes())\n"
        "rng = np.random.default_rng(0)\n"
        "for _ in range(40): digest.update(env.step(rng.uniform(-.2, .2, 4).astype('f4'))[0].tobytes())\n"
        "print(digest.hexdigest())"
    )
    runs = {
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    }
    assert len(runs) == 1


def test_the_module_may_be_named_in_the_id_instead_of_imported():
    assert gym.make("quad_envs:quad/HelixTracking-v0").spec.id == "quad/HelixTracking-v0"


def test_registering_twice_changes_nothing():
    before = dict(gym.registry)
    register()
    assert gym.registry == before


def test_every_public_name_exists():
    for name in quad_envs.__all__:
        assert getattr(quad_envs, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'Nonsense'"):
        _ = quad_envs.Nonsense


@pytest.mark.parametrize(
    ("modules", "heavy"),
    [
        (
            "quad_envs",
            {"torch", "scipy.optimize", "osqp", "matplotlib", "PIL", "stable_baselines3", "pandas"},
        ),
        ("baselines", {"torch", "scipy", "osqp", "matplotlib", "PIL", "stable_baselines3", "numba"}),
        (
            "baselines.training.runs, baselines.training.imitation, baselines.training.policy_gradient",
            {"torch", "stable_baselines3", "matplotlib", "tensorboard"},
        ),
    ],
)
def test_importing_loads_nothing_heavy(modules, heavy):
    code = f"import sys, {modules}; print(sorted({heavy!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_default_flights_stay_inside_the_spaces():
    for env_id in TRACKING:
        env = gym.make(env_id)
        observation, _ = env.reset(seed=0)
        assert env.observation_space.contains(observation)
        assert env.observation_space.contains(env.step(np.zeros(4, np.float32))[0])
