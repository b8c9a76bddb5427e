"""Kernels are compiled by all cores before they are needed, and all that are needed are."""

import os
import subprocess
import sys
from collections import deque
from pathlib import Path

import pytest

from baselines.__main__ import main
from baselines.policies.registry import TEAM_POLICIES, TRACKING_POLICIES
from baselines.sweeps import compiling
from baselines.sweeps.compiling import Piece, _Helpers, _pieces, _policies, _unit
from quad_envs.registration import TEAMS, TRACKING

UNIT = _unit("quad/HelixTracking-v0", "hover")


def leave_mark(unit):
    """Say which process did a piece; the name of its policy is a folder."""
    Path(unit.policy_name, str(os.getpid())).touch()


def fail_elsewhere(unit):
    if str(os.getpid()) != unit.env.label:
        raise RuntimeError("only at home")
    leave_mark(unit)


def test_warm_calls_every_environment_and_policy_of_the_registries():
    units = [_unit(env_id, name) for env_id in (*TRACKING, *TEAMS) for name in _policies(env_id)]
    titles = {piece.title for piece in _pieces(units)}
    assert titles >= {*TRACKING, *TEAMS, *TRACKING_POLICIES, *TEAM_POLICIES}
    assert any("apg" in title or "dagger" in title for title in titles)  # a network, too


def test_environments_are_first_then_the_dearest_mpc_then_what_shares_no_solver_with_it():
    env_id = "quad/HelixTracking-v0"
    first, *policies = [piece.title for piece in _pieces([_unit(env_id, name) for name in _policies(env_id)])]
    entries = [TRACKING_POLICIES[name] for name in policies if name in TRACKING_POLICIES]
    assert first == env_id and {policies[0], policies[1]} <= TRACKING_POLICIES.keys()
    assert [entry.mpc for entry in entries] == [True, *[False] * 5, *[True] * 3]
    for group in (entries[:1] + entries[:5:-1], entries[1:6]):
        prices = [entry.decision_ms for entry in group]
        assert prices == sorted(prices, reverse=True)


def finish(pieces, helpers, monkeypatch):
    """Titles in the order of finishing, after a kernel had to be compiled."""
    monkeypatch.setattr(compiling, "kept_in", lambda: Path())
    said = []
    with _Helpers(deque(pieces), helpers, lambda title, seconds: said.append(title)) as crew:
        crew.on_start(None)
        for piece in crew.rest():
            piece.call(piece.unit)
            said.append(piece.title)
    return said


def test_another_process_helps_and_each_piece_is_done_once(tmp_path, monkeypatch):
    pieces = [Piece(str(i), leave_mark, UNIT._replace(policy_name=str(tmp_path))) for i in range(40)]
    monkeypatch.setattr(compiling, "kept_in", lambda: Path())
    said = []
    with _Helpers(deque(pieces), 1, lambda title, seconds: said.append(title)) as crew:
        crew.on_start(None)
        for thread in crew._threads:
            thread.join()
        assert list(crew.rest()) == []
    assert said == [piece.title for piece in pieces]
    assert str(os.getpid()) not in {mark.name for mark in tmp_path.iterdir()}


def test_what_fails_in_another_process_is_done_here(tmp_path, monkeypatch):
    env = UNIT.env.__class__(UNIT.env.id, {}, str(os.getpid()))
    unit = UNIT._replace(policy_name=str(tmp_path), env=env)
    pieces = [Piece(str(i), fail_elsewhere, unit) for i in range(3)]
    assert sorted(finish(pieces, 2, monkeypatch)) == ["0", "1", "2"]
    assert [mark.name for mark in tmp_path.iterdir()] == [str(os.getpid())]


def test_nobody_helps_where_nothing_is_compiled_or_kept(monkeypatch):
    with _Helpers(deque(), 2, lambda title, seconds: None) as crew:
        assert crew._threads == []
        monkeypatch.setattr(compiling, "kept_in", lambda: None)
        crew.on_start(None)
        assert crew._threads == []


def test_warm_says_where_the_kernels_are_and_fails_where_they_cannot_be_kept(monkeypatch, capsys):
    monkeypatch.setattr(compiling, "compile_everything", lambda jobs: Path("somewhere"))
    assert main(["warm", "--jobs", "1"]) == 0
    assert "somewhere" in capsys.readouterr().out
    monkeypatch.setattr(compiling, "compile_everything", lambda jobs: None)
    assert main(["warm"]) == 1
    assert main(["warm", "--jobs", "0"]) == 2
    assert "jobs must be a whole number >= 1, got 0" in capsys.readouterr().err


def test_warm_compiles_safety_filters_and_random_vehicles_too(monkeypatch):
    """Whoever installed the wheel would wait for them otherwise: no policy of the registry calls them."""
    found = {}
    monkeypatch.setattr(
        compiling, "_compile", lambda pieces, *rest: found.update({p.title: p for p in pieces})
    )
    compiling.compile_everything()
    piece = found["vehicles drawn at random"]
    assert piece.unit.env.kwargs == {"randomize": 0.1}
    piece.call(piece.unit)
    piece = found["a safety filter"]
    assert piece.unit.policy_name == "safe:hover"
    piece.call(piece.unit)


@pytest.mark.slow  # compiles an environment
def test_what_two_processes_compile_nobody_compiles_again(tmp_path):
    code = (
        "from baselines.sweeps.compiling import *\n"
        "from baselines.sweeps.compiling import _compile, _pieces, _unit\n"
        "units = [_unit('quad/HelixTracking-v0', name) for name in ('lqr', 'feedback-linearization')]\n"
        "_compile(_pieces(units), units, 'all', 2)\n"
    )
    # Kernels of another optimisation are nowhere yet, whatever this user or an earlier test has compiled.
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "NUMBA_OPT": "1"}
    said = [
        subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
        )
        for _ in range(2)
    ]
    assert "quad_envs: compiling" in said[0].stderr and "quad_envs: compiling" not in said[1].stderr
