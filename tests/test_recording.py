"""Minari datasets: the flights of `evaluate`, an environment that comes back, and nothing half-written."""

import json
import sys

import gymnasium as gym
import numpy as np
import pytest

from baselines import evaluate, make_policy, record
from baselines.__main__ import main
from baselines.errors import MissingPackageError

minari = pytest.importorskip("minari", reason="needs the extra [minari]")
pytest.importorskip("h5py", reason="needs the extra [minari]")

CORRIDOR, NAME = "quad/CorridorTracking-v0", "quad/corridor/expert-v0"


@pytest.fixture(autouse=True)
def root(tmp_path, monkeypatch):
    """Where Minari looks for datasets."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return tmp_path


def make():
    return gym.make(CORRIDOR, time_limit=1.0, tilt_limit=0.3, disturbance="gusts")


def flights(name=NAME):
    return list(minari.load_dataset(name).iterate_episodes())


def about(name=NAME):
    storage = minari.load_dataset(name).storage
    return list(storage.get_episode_metadata(range(storage.total_episodes)))


def test_a_dataset_holds_the_flights_that_evaluate_measures():
    env = make()
    found = record(env, "lmpc", NAME, episodes=2, seed=7)
    measured = evaluate(make_policy("lmpc", env), env, episodes=2, seed=7)
    for flight, told, row in zip(flights(), about(), measured.records, strict=True):
        assert told["seed"] == row.seed and len(flight) == row.steps == told["total_steps"] == 20
        assert flight.rewards.sum() / 20 == pytest.approx(row.score, rel=1e-12)
        assert flight.infos["cost"][1:].sum() == pytest.approx(row.constraint_cost, rel=1e-12)
        assert told["rewards_sum"] == flight.rewards.sum() and told["policy"] == "lmpc"
    assert (found.episodes, found.steps) == (2, 40)
    assert found.score == pytest.approx(measured.summary()["score"].mean)


def test_minaris_normalized_score_is_the_score_of_evaluate():
    record(make(), ["lqr", "random"], NAME, episodes=2, seed=3)
    dataset = minari.load_dataset(NAME)
    returns = np.array([episode.rewards.sum() for episode in dataset.iterate_episodes()])
    scores = [one.score for name, seed in (("lqr", 3), ("random", 5)) for one in evaluated(name, seed)]
    assert minari.get_normalized_score(dataset, returns) == pytest.approx(scores, rel=1e-6)


def evaluated(name, seed):
    return evaluate(make_policy(name, make()), make(), episodes=2, seed=seed).records


def test_the_environment_and_its_seeds_come_back_so_that_actions_give_the_same_flight():
    record(make(), "lmpc", NAME, episodes=2, seed=3)
    env = minari.load_dataset(NAME).recover_environment()
    assert env.unwrapped.task == make().unwrapped.task
    for flight, told in zip(flights(), about(), strict=True):
        seen, info = env.reset(seed=told["seed"])
        for k, action in enumerate(flight.actions):
            np.testing.assert_array_equal(seen, flight.observations[k])
            assert info["cost"] == flight.infos["cost"][k]
            seen, reward, terminated, truncated, info = env.step(action)
            ends = (flight.terminations[k], flight.truncations[k])
            assert (reward, terminated, truncated) == (flight.rewards[k], *ends)
        np.testing.assert_array_equal(seen, flight.observations[-1])
        np.testing.assert_array_equal(info["constraint_values"], flight.infos["constraint_values"][-1])


def test_a_mixed_dataset_says_of_each_episode_who_flew_it_from_which_seed_with_which_noise():
    record(make(), ["lmpc", "lqr"], NAME, episodes=2, seed=5, noise=[0.0, 0.2])
    told = [(entry["policy"], entry["seed"], entry["noise"]) for entry in about()]
    assert told == [("lmpc", 5, 0.0), ("lmpc", 6, 0.0), ("lqr", 7, 0.2), ("lqr", 8, 0.2)]
    metadata = minari.load_dataset(NAME).storage.metadata
    assert metadata["algorithm_name"] == "lmpc, lqr with noise 0.2"


def test_noise_is_that_of_the_seed_and_actions_are_those_that_flew():
    record(make(), "lmpc", NAME, episodes=2, seed=0, noise=0.5)
    record(make(), "lmpc", "quad/second-v0", episodes=1, seed=1, noise=0.5)
    for flight in flights():
        assert flight.actions.dtype == np.float32 and np.abs(flight.actions).max() == 1.0  # clipped
    np.testing.assert_array_equal(flights()[1].actions, flights("quad/second-v0")[0].actions)


def test_a_name_that_is_taken_is_refused_with_the_remedy_and_nothing_is_touched(root):
    record(make(), "lqr", NAME, episodes=1)
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    with pytest.raises(ValueError, match=r"expert-v1, or delete it first: minari delete quad/corridor/exp"):
        record(make(), "lqr", NAME, episodes=1)
    with pytest.raises(ValueError, match=r"'expert-v0' in .* is a Minari dataset itself"):
        record(make(), "lqr", f"{NAME}/more-v0", episodes=1)
    assert {path: path.stat().st_mtime_ns for path in root.rglob("*")} == before


@pytest.mark.parametrize("ending", [KeyboardInterrupt, MemoryError])
def test_whatever_ends_a_recording_no_half_dataset_is_left(root, ending):
    def stop(count):
        raise ending

    with pytest.raises(ending):
        record(make(), "lqr", NAME, episodes=2, on_episode=stop)
    assert list(root.iterdir()) == [] and minari.list_local_datasets() == {}


@pytest.mark.parametrize("name", ["corridor", "quad/../up-v0", "a b-v0", "", "quad/corridor/expert-v0/"])
def test_what_is_no_name_of_a_dataset_is_refused(root, name):
    with pytest.raises(ValueError, match="no name of a Minari dataset"):
        record(make(), "lqr", name, episodes=1)
    assert list(root.iterdir()) == []


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"env": gym.make_vec(CORRIDOR, 2)}, "single Gymnasium environment"),
        ({"policies": []}, "no policy is named"),
        ({"episodes": 0}, "episodes must be"),
        ({"noise": -1.0}, "noise must be a number from 0 to 2, got -1.0; actions lie between"),
        ({"noise": [0.1, 0.1]}, "or one for each of 1, got 2"),
        ({"env": gym.make(CORRIDOR, reference=lambda t: (t, 0.0, 0.0))}, "JSON cannot"),
    ],
)
def test_what_cannot_be_recorded_is_refused_before_anything_is_written(root, asked, said):
    asked = {"env": make(), "policies": "lqr", "episodes": 1, **asked}
    with pytest.raises(ValueError, match=said):
        record(asked.pop("env"), asked.pop("policies"), NAME, **asked)
    assert list(root.iterdir()) == []


def test_the_command_records_a_mixed_dataset_and_says_where_it_is(root, capsys):
    command = ["record", CORRIDOR, "lmpc", "lqr", "--minari", NAME, "--episodes", "1", "--noise", "0"]
    assert main([*command, "--noise", "0.1", "--set", "time_limit=0.5", "--json"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["episodes"] == 2 and f"load_dataset('{NAME}')" in said.err
    assert str(root) in said.err and [entry["noise"] for entry in about()] == [0.0, 0.1]
    assert main(command[:4]) == 2 and "--minari quad/corridor/expert-v0" in capsys.readouterr().err
    assert main(["record", "quad/Formation-v0", "hover", "--minari", "a-v0"]) == 2
    assert "--save-episodes" in capsys.readouterr().err


def test_without_minari_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(MissingPackageError, match=r'".\[minari\]"'):
        record(make(), "lqr", NAME)
