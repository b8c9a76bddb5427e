"""Clients that others wrote run against the ids: each example as a process of its own, with a tiny budget."""

import subprocess
import sys
from importlib import import_module
from importlib.util import find_spec

import gymnasium as gym
import pytest
from sources import ROOT

from quad_envs.registration import TRACKING

# What each needs beyond the suite, its arguments, and what it prints at its end.
EXAMPLES = {
    "cleanrl_ppo": (["torch"], ["--steps", "16384"], "lmpc: score 0."),
    "sb3_tools": (["stable_baselines3"], ["--steps", "2000"], "lmpc: score 0."),
    "supersuit_sb3": (["supersuit", "stable_baselines3"], ["--steps", "1536"], "consensus-mpc: score 0."),
    "torchrl_ppo": (["torchrl"], ["--updates", "1"], "update 1: mean reward 0."),
    "torchrl_mappo": (["torchrl"], ["--seconds", "1"], "consensus-mpc: score 0."),
    "rllib_formation": (["ray.rllib"], ["--iterations", "1", "--batch", "1000"], "1000 steps, score 0."),
    "behaviour_cloning": (["minari", "h5py", "torch"], ["--record", "1", "--epochs", "1"], "crashes "),
    "gallery": ([], ["--only", "quad/Regulation-v0", "--out", "{tmp}"], "regulation.png, "),
    "animate_formation": ([], ["--steps", "8", "--out", "{tmp}/short.gif"], "3 frames in "),
    "your_own_filter": ([], [], "estimate_rmse"),
    "your_own_team_learner": (["torch"], ["--steps", "16384"], "consensus-mpc: score 0."),
    "your_own_task": ([], ["--episodes", "1"], "sdc-nmpc on quad/HelixTracking-v0"),
}


def is_installed(package):
    """Whether a package is there; asking for a part of one that is not raises."""
    return all(find_spec(".".join(package.split(".")[: i + 1])) for i in range(package.count(".") + 1))


def run(name, *arguments):
    needs = EXAMPLES[name][0]
    missing = [package for package in needs if not is_installed(package)]
    if missing:
        pytest.skip(f"{name} needs {', '.join(missing)}: see examples/README.md")
    command = [sys.executable, "-m", f"examples.{name}", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_runs_to_its_end(name, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    _, arguments, last = EXAMPLES[name]
    assert last in run(name, *(text.format(tmp=tmp_path) for text in arguments))


@pytest.mark.slow
def test_supersuit_flies_teams_that_lose_vehicles_behind_its_black_death_wrapper():
    assert "12 rows" in run("supersuit_sb3", "--steps", "1536", "--terminate", "agent")


def test_every_example_is_tested_and_says_its_command():
    files = {path.stem: path.read_text() for path in (ROOT / "examples").glob("*.py")}
    assert files.keys() == EXAMPLES.keys()
    for name, text in files.items():
        assert f"examples.{name}" in text.split('"""')[1]


def test_the_file_for_rl_zoo_has_every_tracking_id_and_names_what_there_is():
    yaml = pytest.importorskip("yaml", reason="rl-zoo reads its files with it")
    tables = yaml.safe_load((ROOT / "examples" / "rl_zoo" / "ppo.yml").read_text(encoding="utf-8"))
    assert tables.keys() - {"default"} == TRACKING.keys()
    for env_id, table in tables.items():
        module, _, name = table["env_wrapper"].rpartition(".")
        wrapper = getattr(import_module(module), name)
        assert table["policy"] == "MlpPolicy" and table["n_timesteps"] >= 100_000
        assert table.keys() <= {"env_wrapper", "policy", "n_timesteps"}  # the rest is the learner's default
        if env_id in TRACKING:
            assert wrapper(gym.make(env_id)).observation_space.shape[0] < 80
