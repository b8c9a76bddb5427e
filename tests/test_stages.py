"""What a sweep says while it flies: stages, each row once flown, quick policies first, the time left."""

import re

import pytest

from baselines.__main__ import main
from baselines.policies.registry import TRACKING_POLICIES
from baselines.sweeps.choices import PolicyChoice
from baselines.sweeps.compiling import compile_for
from baselines.sweeps.progress import said_left, said_seconds
from baselines.sweeps.stages import SweepProgress, price
from baselines.sweeps.suite_files import load_suite
from baselines.sweeps.sweep import Order, Sweep
from baselines.sweeps.units import suite_units

SUITE = """
episodes = 1
seed = 0
compare_with = "lmpc"
envs = [
    {id = "quad/Regulation-v0", kwargs = {time_limit = 0.5}},
    {id = "quad/LineTracking-v0", kwargs = {time_limit = 0.5}},
]
policies = ["lmpc", "hover", "lqr"]
"""


@pytest.fixture
def suite(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(SUITE)
    return path


def rows(text):
    return [line.split() for line in text.splitlines() if line.startswith("quad/")]


def test_each_row_is_said_with_the_time_left_and_quick_policies_fly_first(suite, tmp_path, capsys):
    assert main(["benchmark", str(suite), "--out", str(tmp_path / "run")]) == 0
    said = capsys.readouterr()
    lines = [line for line in said.err.splitlines() if " score 0." in line]
    assert [re.search(r"(hover|lqr|lmpc) ", line)[1] for line in lines] == ["hover", "lqr", "lmpc"] * 2
    assert all(re.search(r"about \d+ (s|min) left$", line) for line in lines[:-1])
    assert re.search(r"took \d+ (s|min)$", lines[-1])
    assert said.err.index("compile: hover, lqr, lmpc; took") < said.err.index(lines[0])
    # The tables keep the order of the suite.
    assert [line.split()[0] for line in said.out.splitlines() if line[:4] in ("lmpc", "hove", "lqr ")] == [
        "lmpc",
        "hover",
        "lqr",
    ] * 2


def test_a_run_that_goes_on_compiles_and_says_only_what_is_left(suite, tmp_path, capsys):
    command = ["benchmark", str(suite), "--out", str(tmp_path / "run")]
    assert main(command) == 0
    for cell in (tmp_path / "run" / "cells").glob("*lqr*"):
        cell.unlink()
    capsys.readouterr()
    assert main(command) == 0
    said = capsys.readouterr().err
    assert said.count(" score 0.") == 2 and "compile: lqr; took" in said


def test_nothing_is_said_to_who_does_not_follow(suite, capsys):
    sweep = Sweep(load_suite(suite), {}, {}, None, Order())
    sweep.go()
    assert len(sweep.flown) == 6 and capsys.readouterr().err == ""


def test_exact_nmpc_is_the_dearest_and_hover_the_cheapest():
    # As measured; the price is for the order and for estimates only.
    units = {unit.policy.name: price(unit) for unit in suite_units(load_suite("quick"))}
    assert units.keys() == TRACKING_POLICIES.keys()
    assert max(units, key=units.get) == "nmpc" and units["hover"] == min(units.values())


def test_a_policy_from_outside_is_not_flown_to_compile(suite, capsys):
    units = suite_units(load_suite(suite))
    compile_for([unit._replace(policy=PolicyChoice("nobody:knows")) for unit in units])
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("seconds", "said"), [(0.2, "1 s"), (7.4, "7 s"), (100.0, "2 min"), (7200.0, "2.0 h")]
)
def test_durations_are_said_as_people_say_them(seconds, said):
    assert said_seconds(seconds) == said


def test_the_time_left_follows_the_work_and_not_the_count():
    assert said_left(10.0, 1.0, 4.0) == "about 30 s left"
    assert said_left(0.0, 0.0, 4.0) == ""
    assert said_left(60.0, 3.0, 300.0) == "", "of the first minute most was compilation"
    assert said_left(12.0, 4.0, 4.0) == "took 12 s"


def test_networks_that_are_trained_are_counted_with_the_time_left(tmp_path, capsys):
    pytest.importorskip("torch", reason="dagger trains with it")
    suite = {
        "name": "learned",
        "episodes": 1,
        "envs": [{"id": "quad/Regulation-v0", "kwargs": {"time_limit": 0.5}}],
        "policies": ["hover", {"name": "dagger", "train": {"seeds": [0, 1], "steps": 500}}],
    }
    sweep = Sweep(load_suite(suite), {}, {}, tmp_path, Order(watcher=SweepProgress()))
    sweep.go()
    said = capsys.readouterr().err.splitlines()
    assert said[0] == "train: 2 policies"
    assert re.fullmatch(r"train: 1 of 2 are there; about \d+ (s|min) left", said[1])
    assert re.fullmatch(r"train: 2 of 2 are there; took \d+ (s|min)", said[2])
    assert said[3].startswith("compile: hover; ") and len(said) == 7
