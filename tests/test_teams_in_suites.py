"""Teams beside single vehicles in a suite: who flies where, and that they change nothing for the others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import baselines.sweeps
from baselines import run_benchmark
from baselines.sweeps.finished import training_plan
from baselines.sweeps.suite_files import suite_from_dict, tomllib
from baselines.sweeps.units import suite_units, training_units
from baselines.training.tuning import tune
from quad_envs.registration import TEAMS

FORMATION = {
    "id": "quad/Formation-v0",
    "label": "Triangle",
    "tables": ["teams"],
    "kwargs": {"vehicles": 3, "formation": "triangle", "time_limit": 0.5},
}
TRAINED = {"name": "dagger", "envs": ["Triangle"], "tables": ["teams"], "train": {"seconds": 1}}
SINGLE = {
    "name": "mixed",
    "episodes": 2,
    "seed": 10_000,
    "protocol": "mixed",
    "compare_with": "best MPC",
    "envs": [
        {"id": "quad/HelixTracking-v0", "label": "Helix", "kwargs": {"time_limit": 0.5}},
        {"id": "quad/SpiralTracking-v0", "label": "Spiral", "kwargs": {"time_limit": 0.5}},
    ],
    "policies": [
        {"name": "lmpc", "tables": ["one"]},
        {"name": "ppo", "tables": ["one"], "train": {"seconds": 1}},
        {"name": "lmpc", "label": "R 0.1", "kwargs": {"R": 0.1}, "trace": "R"},
    ],
    "tables": [{"label": "one"}],
    "conditions": [
        {"label": "nominal"},
        {"label": "noise", "kwargs": {"sensor_noise": 0.01}, "envs": ["Helix"]},
    ],
}
MIXED = SINGLE | {
    "envs": [*SINGLE["envs"], FORMATION],
    "policies": [
        *SINGLE["policies"],
        {"name": "consensus-mpc", "envs": ["Triangle"], "tables": ["teams"]},
        {"name": "central-mpc", "envs": ["Triangle"], "tables": ["teams"]},
        TRAINED,
    ],
    "tables": [*SINGLE["tables"], {"label": "teams"}],
    "conditions": [
        {"label": "nominal"},
        {"label": "noise", "kwargs": {"sensor_noise": 0.01}, "envs": ["Helix", "Triangle"]},
        {"label": "delay", "kwargs": {"delay": 2}, "envs": ["Triangle"]},
    ],
}
PROTOCOL = Path(baselines.sweeps.__file__).parent / "suites" / "quad-bench-2026.1.toml"


def without_teams(data):
    """A suite with neither teams nor what is for them alone."""
    teams = {name for env in data["envs"] if env["id"] in TEAMS for name in (env["id"], env["label"])}

    def others(entries):
        for entry in entries:
            names = [name for name in entry.get("envs", ()) if name not in teams]
            if names or not entry.get("envs"):
                yield entry | ({"envs": names} if names else {})

    policies = list(others(data["policies"]))
    used = {label for policy in policies for label in policy.get("tables", ())}
    return data | {
        "envs": [env for env in data["envs"] if env["id"] not in TEAMS],
        "policies": policies,
        "conditions": list(others(data["conditions"])),
        "tables": [table for table in data["tables"] if table["label"] in used],
    }


def titles(suite):
    return {(unit.env.title, unit.policy.contender) for unit in suite_units(suite)}


def test_in_an_environment_with_tables_fly_policies_of_these_alone():
    found = titles(suite_from_dict(MIXED))
    assert {name for env, name in found if env.startswith("Helix")} == {"lmpc", "ppo", "R 0.1"}
    assert {name for env, name in found if env.startswith("Triangle")} == {
        "consensus-mpc",
        "central-mpc",
        "dagger",
    }


@pytest.mark.parametrize("name", ["teams", "Triangle", "quad/Formation-v0"])
def test_teams_are_a_part_that_is_named(name):
    suite = suite_from_dict(MIXED).only([name])
    assert [env.title for env in suite.envs] == ["Triangle"]
    assert [table.label for table in suite.tables] == ["teams"]
    assert {policy.name for policy in suite.policies} == {"consensus-mpc", "central-mpc", "dagger"}
    assert [one.label for one in suite.conditions] == ["nominal", "noise", "delay"]


def test_the_tables_of_single_vehicles_hold_no_teams():
    suite = suite_from_dict(MIXED).only(["one"])
    assert [env.title for env in suite.envs] == ["Helix", "Spiral"]
    assert {policy.contender for policy in suite.policies} == {"lmpc", "ppo", "R 0.1"}


def test_a_table_that_is_not_there_is_refused():
    env = FORMATION | {"tables": ["team"]}
    with pytest.raises(ValueError, match=r"table of environment 'Triangle'.*'team'.*did you mean 'teams'"):
        suite_from_dict(MIXED | {"envs": [*SINGLE["envs"], env]})


def test_teams_change_no_digest_of_what_is_flown_without_them():
    mixed, single = suite_from_dict(MIXED), suite_from_dict(SINGLE)
    for names in (["Helix"], ["Helix", "noise"], ["Helix", "one"]):
        assert mixed.only(names).digest == single.only(names).digest
    assert mixed.definition != single.definition


def test_teams_change_no_digest_of_the_shipped_protocol_without_them():
    data = tomllib.loads(PROTOCOL.read_text("utf-8"))
    whole, single = (suite_from_dict(one, "quad-bench-2026.1") for one in (data, without_teams(data)))
    for env in single.envs:
        assert whole.only([env.title]).digest == single.only([env.title]).digest
        assert whole.only([env.title]).quick().digest == single.only([env.title]).quick().digest
    assert whole.quick().digest == single.quick().digest


def test_what_a_training_goes_on_from_is_said_and_counts_in_the_digest():
    pytest.importorskip("torch", reason="apg trains with it")
    begun = TRAINED | {"train": {"seconds": 1, "start_from": "dagger-formation"}, "name": "apg"}
    suite = suite_from_dict(MIXED | {"policies": [*MIXED["policies"][:-1], begun]})
    (unit,) = [unit for unit in training_units(suite) if unit.policy.name == "apg"]
    assert training_plan(unit).about["start_from"]["algorithm"] == "dagger"
    other = suite_from_dict(
        MIXED | {"policies": [*MIXED["policies"][:-1], begun | {"train": {"seconds": 1}}]}
    )
    assert other.digest != suite.digest
    with pytest.raises(
        ValueError, match="start_from of a training in a suite must be the name of a policy, got 3"
    ):
        suite_from_dict(MIXED | {"policies": [TRAINED | {"train": {"start_from": 3}}]})


def test_tables_hold_those_of_their_environments_and_say_how_teams_kept_together(tmp_path):
    policies = [policy for policy in MIXED["policies"] if "train" not in policy]
    tuned = policies[-2] | {"label": "tuned", "tune": {"episodes": 32, "fields": ["R"]}}
    policies.append(tuned)
    found = run_benchmark(MIXED | {"policies": policies}, tmp_path / "run")
    rows = found.contender_rows()
    here = {(row["table"], row["env"], row["policy"]) for row in rows}
    assert {key for key in here if key[0] == "teams"} == {
        ("teams", "Triangle", "consensus-mpc"),
        ("teams", "Triangle", "central-mpc"),
        ("teams", "Triangle", "tuned"),
    }
    assert ("one", "Helix", "R 0.1") in here
    bases = {row["base"] for row in rows if row["table"] == "teams"}
    assert bases <= {"consensus-mpc", "tuned"}, "who sees what others see"
    (head,) = {line for line in str(found).splitlines() if " separation m " in line}
    assert " final m " in head and " messages /step " in head


def test_a_controller_of_a_team_is_tuned(tmp_path):
    team = {"vehicles": 3, "formation": "triangle", "time_limit": 0.5}
    found = tune(
        "quad/Formation-v0",
        "consensus-mpc",
        episodes=40,
        fields=["R"],
        env_kwargs=team,
        out=tmp_path / "tuned",
    )
    assert found.policy == "consensus-mpc" and len(found.options["R"]) == 4
    assert np.isfinite(found.best.score) and found.best.flights == 5 * 3


def test_a_comparison_with_the_best_mpc_needs_an_mpc_everywhere(tmp_path):
    without = SINGLE | {"policies": [{"name": "lmpc", "envs": ["Helix"]}, {"name": "hover"}]}
    without |= {"tables": []}
    with pytest.raises(ValueError, match=r"compares with the best MPC, and no policy in 'Spiral' is an MPC"):
        run_benchmark(suite_from_dict(without), out=tmp_path / "run")
    assert not (tmp_path / "run").exists()
