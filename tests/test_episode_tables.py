"""Flights as tables and figures, and evaluations in a notebook."""

from __future__ import annotations

import csv
import sys
import types

import gymnasium as gym
import numpy as np
import pytest

from baselines import evaluate, make_policy, plot_episode, run_benchmark, run_episodes
from baselines.errors import MissingPackageError
from quad_envs import cooperative_estimation_v0, formation_v0

CORRIDOR = "quad/CorridorTracking-v0"


@pytest.fixture(scope="module")
def flight():
    env = gym.make(CORRIDOR, time_limit=2.0)
    return next(run_episodes(make_policy("lqr", env), env, 1))


@pytest.fixture(scope="module")
def team():
    env = formation_v0.parallel_env(vehicles=3, time_limit=1.0)
    return list(run_episodes(make_policy("hover", env), env, 1))


def test_columns_are_the_arrays_of_the_flight_by_name(flight):
    columns, T = flight.columns(), len(flight.rewards)
    assert all(values.shape == (T + 1,) for values in columns.values())
    assert np.array_equal(columns["t"], flight.task.dt * np.arange(T + 1))
    for name, k in (("x", 0), ("w", 5), ("psi", 8), ("r", 11), ("F4", 15)):
        assert np.array_equal(columns[name], flight.states[:, k])
    for name, k in (("y_ref", 1), ("vz_ref", 5)):
        assert np.array_equal(columns[name], flight.references[:, k])
    assert np.allclose(np.sin(columns["psi_ref"]), flight.references[:, 6], atol=1e-15)
    assert np.array_equal(columns["F2_command"][:-1], flight.commands[:, 1])
    for name, values in (("reward", flight.rewards), ("constraint_cost", flight.costs)):
        assert np.array_equal(columns[name][:-1], values) and np.isnan(columns[name][-1])
    assert set(columns["violated"][:-1]) <= {0.0, 1.0}
    for k, name in enumerate(flight.task.constraint_names):
        assert np.array_equal(columns[f"limit_{name}"][:-1], flight.constraint_values[:, k])


def test_a_csv_gives_every_number_back(flight, tmp_path):
    text = flight.to_csv(tmp_path / "flight.csv")
    with open(tmp_path / "flight.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert flight.to_csv() == text == (tmp_path / "flight.csv").read_text()
    for name, values in flight.columns().items():
        read = np.array([float(row[name] or "nan") for row in rows])
        assert np.array_equal(read, values, equal_nan=True)


def test_a_flown_path_is_a_reference_for_another_flight(flight, tmp_path):
    """Names of columns are those that tables of references have."""
    columns = {name: values for name, values in flight.columns().items() if name in ("t", "x", "y", "z")}
    env = gym.make("quad/Regulation-v0", reference=columns, time_limit="reference")
    env.reset(seed=0)
    assert np.allclose(env.unwrapped.reference[:20, :3], flight.states[:20, :3], atol=1e-9)


def test_teams_have_their_signals_as_columns(team):
    columns = team[0].columns()
    assert np.array_equal(columns["min_separation"][:-1], team[0].signals["min_separation"])
    assert np.array_equal(columns["reward_terms_2"][:-1], team[0].signals["reward_terms"][:, 2])
    env = cooperative_estimation_v0.parallel_env(time_limit=1.0)
    estimating = next(run_episodes(make_policy("ekf", env), env, 1)).columns()
    assert np.isfinite(estimating["estimate_covariance_2_1"][:-1]).all()
    assert np.isnan(estimating["F1_command"]).all()  # answers command nothing


def test_a_frame_needs_pandas_and_says_so(flight, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingPackageError, match=r"pip install pandas; columns\(\) gives the same"):
        flight.to_frame()
    stub = types.ModuleType("pandas")
    stub.DataFrame = dict
    monkeypatch.setitem(sys.modules, "pandas", stub)
    assert list(flight.to_frame()) == list(flight.columns())


def test_flights_are_drawn(flight, team, tmp_path):
    pytest.importorskip("matplotlib", reason="figures need matplotlib")
    env = cooperative_estimation_v0.parallel_env(time_limit=1.0)
    on_rails = next(run_episodes(make_policy("ekf", env), env, 1))
    for name, flights in (("one", [flight]), ("team", team), ("rails", [on_rails])):
        figure = plot_episode(*flights)
        figure.savefig(tmp_path / f"{name}.png")
        assert len(figure.axes) == 6
    labelled = plot_episode(flight, flight, labels=("a", "b"))
    assert [text.get_text() for text in labelled.axes[0].get_legend().get_texts()] == ["a", "b"]
    assert np.array_equal(labelled.axes[0].lines[1].get_ydata(), flight.states[:, 0])  # north is up
    with pytest.raises(ValueError, match="needs a flight"):
        plot_episode()
    with pytest.raises(ValueError, match="a label for each of 2 flights, got 1"):
        plot_episode(flight, flight, labels=("a",))


def test_a_notebook_shows_the_table_that_is_printed():
    results = run_benchmark(
        {
            "name": "<s>",
            "envs": ["quad/Regulation-v0"],
            "policies": [{"name": "lqr", "label": "<b>"}, "hover"],
            "episodes": 2,
        }
    )
    one = results.evaluations[0]
    for found in (one, results):
        shown, printed = found._repr_html_(), str(found)
        assert shown.count("<table>") == 1 and "<b>" not in shown.replace("&lt;b&gt;", "")
        words = {word for line in printed.splitlines() for word in line.split("  ") if word.strip("- ")}
        assert all(word.strip().replace("<", "&lt;").replace(">", "&gt;") in shown for word in words)
    assert "&lt;b&gt;" in results._repr_html_()


def test_a_notebook_shows_what_did_not_fly():
    with pytest.warns(UserWarning, match="does not fly"):
        results = run_benchmark(
            {"name": "s", "envs": ["quad/Regulation-v0"], "policies": ["lqr"], "episodes": 1},
            policies={"<mine>": lambda task: 3},
        )
    assert "&lt;mine&gt; did not fly in quad/Regulation-v0" in results._repr_html_()
    assert evaluate("lqr", "quad/Regulation-v0", 1)._repr_html_().startswith("<div><strong>lqr on quad/Reg")
