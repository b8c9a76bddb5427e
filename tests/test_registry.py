"""Every registered id passes the checkers of its users, and importing the package stays cheap."""

import re
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

import baselines
import controllers
import quad_envs
from quad_envs.registration import TEAMS, TRACKING, register

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


@pytest.mark.parametrize("package", [quad_envs, controllers, baselines], ids=lambda package: package.__name__)
def test_every_public_name_exists_and_is_in_dir(package):
    for name in package.__all__:
        assert getattr(package, name) is not None
    assert set(package.__all__) <= set(dir(package))
    assert not [name for name in dir(package) if name.startswith("_") and not name.endswith("__")]
    with pytest.raises(AttributeError, match="attribute Nonsense"):
        _ = package.Nonsense


def test_public_names_are_listed_before_anything_is_loaded():
    code = (
        "import sys, quad_envs, baselines\nprint(*dir(quad_envs), *dir(baselines))\n"
        "assert 'numba' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert {"Helix", "formation_v0", "make_policy", "train"} <= set(done.stdout.split())


def test_the_modules_of_teams_are_attributes():
    code = "import quad_envs; print(quad_envs.formation_v0.parallel_env().possible_agents)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "quad_0" in done.stdout


@pytest.mark.parametrize("env_id", TEAMS)
@pytest.mark.parametrize(
    "make",
    [
        gym.make,
        lambda env_id, **kwargs: gym.make(f"quad_envs:{env_id}", **kwargs),
        lambda env_id, **kwargs: gym.make_vec(env_id, num_envs=3, **kwargs),
        lambda env_id, **kwargs: gym.make_vec(env_id, num_envs=3, vectorization_mode="sync", **kwargs),
        lambda env_id, **kwargs: gym.make(gym.spec(env_id), **kwargs),
        lambda env_id, **kwargs: gym.make(EnvSpec.from_json(gym.spec(env_id).to_json()), **kwargs),
    ],
    ids=["make", "module", "make_vec", "sync", "spec", "json"],
)
def test_gymnasium_says_that_teams_are_pettingzoo_and_shows_a_line_that_makes_them(make, env_id):
    with pytest.raises(
        gym.error.NameNotFound, match="is a PettingZoo environment, not one of Gymnasium"
    ) as said:
        make(env_id, dt=0.1, time_limit=2.0)
    lines = re.findall(r"quad_envs\.\w+\.\w+\([^)]*\)", str(said.value))
    parallel, vector = (eval(line) for line in lines)  # what the message shows, typed as it stands
    assert parallel.task.dt == 0.1 and parallel.task.env_id == env_id
    assert vector.unwrapped.task.episode_steps == 20


def test_the_listing_of_gymnasium_names_every_id_of_the_suite_once():
    listed = gym.pprint_registry(disable_print=True).split()
    assert [listed.count(env_id) for env_id in (*TRACKING, *TEAMS)] == [1] * 10
    with pytest.raises(gym.error.NameNotFound, match="Did you mean: `Formation`"):
        gym.make("quad/Formations-v0")


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


def test_solvers_are_found_by_their_paths_of_before():
    from controllers.ocp import OcpQp
    from controllers.riccati import dare
    from controllers.solvers import StructuredSolver

    from controllers import qp

    assert (OcpQp, dare, StructuredSolver) == (controllers.OcpQp, controllers.dare, qp.StructuredSolver)
