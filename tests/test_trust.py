"""What the figures of trust found, and a little of each of them."""

from __future__ import annotations

import itertools
import json
import os
import time
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

import quad_envs
from baselines import (
    ResultsError,
    evaluate,
    export_policy,
    load_policy,
    make_policy,
    run_benchmark,
    train,
    tune,
)
from baselines.policies.network import NetworkPolicy
from baselines.report import render_report
from baselines.sweeps.folder import read_run
from benchmarks.trust import found, kills, malformed, observations, problems, repeat, soak
from benchmarks.trust.__main__ import FIGURES, Outcome, table, try_out
from controllers import CentralOptions, ConsensusOptions, LmpcOptions, SdcOptions
from quad_envs import cooperative_estimation_v0, formation_v0

HELIX = "quad/HelixTracking-v0"


@pytest.mark.parametrize("rows", [1, 4, 9])
def test_an_observation_beyond_what_a_network_holds_is_refused_by_its_row(rows):
    env = gym.make("quad/CorridorTracking-v0")
    network = replace(make_policy("apg-corridor", env).network, activation="relu")  # inf, then inf - inf
    observation = np.tile(env.reset(seed=0)[0], (rows, 1))
    observation[-1] = 3e38
    with pytest.raises(ValueError, match=f"no action follows from observation {rows - 1}: entry 0 of 'V_B'"):
        NetworkPolicy(network, env.unwrapped.task, "large").predict(observation)


def test_a_try_hangs_by_its_cpu_time_or_by_the_clock(monkeypatch):
    short = tuple(one._replace(seconds=one.seconds / 600.0) for one in found.LIMITS)
    monkeypatch.setattr(found, "LIMITS", short)
    busy = found.tried("busy", lambda: next(k for k in itertools.count() if k < 0))
    assert busy.wrong[0].startswith("busy: Hangs: for 0.1 CPU-s, in <genexpr> of ")
    assert "Hangs: for 1 s by the clock" in found.tried("asleep", lambda: time.sleep(30.0)).wrong[0]
    assert found.tried("short", lambda: time.sleep(0.2)) == found.Found(1)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["ekf", "trilateration", "cooperative-mpc"])
def test_a_filter_that_was_told_nonsense_begins_anew(name):
    env = cooperative_estimation_v0.parallel_env()
    policy = make_policy(name, env)
    usual = np.array(list(env.reset(seed=0)[0].values()))
    starts = np.ones(len(usual), dtype=np.bool_)
    _, state = policy.predict(usual, None, starts)
    wild = np.full_like(usual, np.finfo(np.float32).max)
    wild[:, ::2] *= -1.0
    action, state = policy.predict(wild, state, ~starts)
    assert np.isfinite(action).all() and np.abs(action).max() <= 1.0
    action, state = policy.predict(usual, state, ~starts)
    assert np.isfinite(action).all() and np.isfinite(state.memory).all()


def test_a_state_of_teams_that_is_not_finite_is_refused_by_its_row():
    env = formation_v0.parallel_env(vehicles=3, formation="triangle")
    policy = make_policy("central-mpc", env)
    env.reset(seed=0)
    states = np.tile(env.state(), (3, 1))
    states[2, policy.task.state_slices["graph"].start] = np.nan  # which the program does not even read
    with pytest.raises(ValueError, match="observation 2 is not finite: entry 0 of 'graph'"):
        policy.predict(states)


@pytest.mark.parametrize(
    ("part", "size"),
    [
        (slice(0, 3), 1e37),  # p: a bound beyond OSQP's infinity, which it refused with an exception
        (slice(9, 12), 1e20),  # Omega: a plan that is nan, which the next decision refused
    ],
)
def test_a_team_whose_program_overflows_falls_back_and_decides_again(part, size):
    env = formation_v0.parallel_env(vehicles=3, formation="triangle")
    policy = make_policy("central-mpc", env)
    env.reset(seed=0)
    usual = np.array(env.state(), dtype=np.float64)[None]
    _, state = policy.predict(usual)
    wild = usual.copy()
    wild[0, part] = size
    action, state = policy.predict(wild, state)
    assert np.isfinite(action).all() and np.abs(action).max() <= 1.0
    assert state.fallbacks[0, 0] == 1 and np.isfinite(state.memory).all()
    action, state = policy.predict(usual, state)
    assert np.isfinite(action).all() and state.fallbacks[0, 0] == 2


@pytest.fixture
def folder(tmp_path):
    """A results folder."""
    suite = {"envs": [{"id": HELIX, "kwargs": {"time_limit": 0.5}}], "policies": ["hover"], "episodes": 1}
    run_benchmark(suite, tmp_path / "run")
    return tmp_path / "run"


def test_a_pipe_in_place_of_a_flight_is_not_waited_for(folder):
    (flight,) = (folder / "episodes").iterdir()
    flight.unlink()
    os.mkfifo(flight)
    assert "is damaged (it is not a regular file)" in render_report(read_run(folder))


@pytest.mark.parametrize(("name", "value"), [("score", "x"), ("effort", []), ("agent", 3), ("steps", {})])
def test_a_cell_with_a_word_for_a_number_is_refused_by_name(folder, name, value):
    (cell,) = (folder / "cells").iterdir()
    data = json.loads(cell.read_text())
    data["found"]["records"][0][name] = value
    cell.write_text(json.dumps(data))
    with pytest.raises(ResultsError, match="delete it to fly this unit again") as said:
        read_run(folder)
    assert cell.name in str(said.value) and name in str(said.value)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("tries", "number"),
    [
        (soak.soak, 6),
        (problems.problems, 60),
        (observations.observations, 50),
        (malformed.malformed, 40),
        (repeat.repeat, 5),
        (repeat.rows, 2),
    ],
)
def test_a_little_of_each_figure_fails_nowhere(tries, number):
    found = list(itertools.islice(tries(3), number))
    assert [line for one in found for line in one.wrong] == []
    assert sum(one.tried for one in found) >= number


def test_the_table_says_what_was_tried_and_what_failed(monkeypatch):
    one = try_out("problems", 10, 60.0, 0)
    assert one.tried == 10 and one.failed == 0 and 0.0 <= one.worst < 1e-8
    printed = table([one, Outcome("kills", 3, 1, 0.0, 2.0, ("benchmark: differs",))])
    assert "100000 problems" in printed and printed.splitlines()[-1].split()[-4:] == ["3", "1", "-", "2"]
    assert set(FIGURES) == {
        *("soak", "problems", "observations", "inputs", "kills", "malformed", "repeat", "rows"),
    }


def test_a_command_that_dies_is_counted_as_dead_and_goes_on(tmp_path):
    job = kills.JOBS[1]  # evaluate, the quickest
    found = list(itertools.islice(kills.kills(2, [job]), 3))
    assert [one.wrong for one in found] == [()] * 3


WRONG = [
    (lambda: quad_envs.RandomSmooth(amplitude=2.0), "amplitude must be several numbers, got 2.0"),
    (lambda: quad_envs.Limits(position_lower=1.0), "position_lower must be three numbers, got 1.0"),
    (lambda: quad_envs.Weights(Q="x"), "Q must be several numbers, got 'x'"),
    (lambda: quad_envs.TorquePulse(start=[1.0]), "start must be a number, got"),
    (lambda: quad_envs.Gusts(correlation_time="x"), "correlation_time must be a number, got 'x'"),
    (lambda: quad_envs.Switching(graphs=3), "graphs must be a sequence, got 3"),
    (lambda: quad_envs.Timed(["ring"], 3), "times must be several numbers, got 3"),
    (lambda: quad_envs.StaticTarget({"x": 1}), "position of StaticTarget must be three finite numbers"),
    (lambda: quad_envs.toward_leader(3), "G must be a square matrix of weights, got 3"),
    (lambda: quad_envs.adjacency(10**7, []), "a graph of 10000000 vehicles would take"),
    (lambda: LmpcOptions(margin="x"), "margin must be a number, got 'x'"),
    (lambda: LmpcOptions(estimator_gain="x"), r"estimator_gain must be 'auto' or lie in \(0, 1\], got 'x'"),
    (lambda: SdcOptions(alpha=None), "alpha must be a number, got None"),
    (lambda: CentralOptions(swirl=[1.0]), "swirl must be a number, got"),
    (lambda: ConsensusOptions(reach="x"), "reach must be a number, got 'x'"),
    (lambda: load_policy(3, HELIX), "a checkpoint must be a path, got 3"),
    (lambda: run_benchmark(3), "a suite, if no mapping, must be a path, got 3"),
    (lambda: run_benchmark("quick", out=3), "out must be a path, got 3"),
    (lambda: run_benchmark("quick", policies=[3]), r"policies must be a mapping of labels, got \[3\]"),
    (lambda: evaluate("hover", HELIX, out=3), "out must be a path, got 3"),
    (lambda: train(3, "ppo"), "env_id must be a text, got 3"),
    (lambda: train(HELIX, "ppo", start_from=[1]), r"start_from must be a path, got \[1\]"),
    (lambda: tune(HELIX, "lmpc", options=3), "options must be a mapping of names to values, got 3"),
    (lambda: export_policy("model.zip", 3), "folder must be a path, got 3"),
]


@pytest.mark.parametrize(("make", "message"), WRONG, ids=[message for _, message in WRONG])
def test_a_value_of_another_kind_is_refused_by_the_name_of_its_argument(make, message):
    with pytest.raises(ValueError, match=message):
        make()
