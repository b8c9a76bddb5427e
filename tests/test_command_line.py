"""The command line: what it prints where, and how it ends."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from commands import fails
from processes import start_command

from baselines.__main__ import COMMANDS, main
from baselines.cli.commands import _resume
from baselines.cli.options import BenchmarkOptions, read_assignments
from baselines.cli.values import read_value
from baselines.evaluation.columns import COLUMNS
from baselines.policies.registry import TEAM_POLICIES, TRACKING_POLICIES, policy_comments, policy_options
from baselines.policies.trained import SHIPPED
from baselines.policies.tuned import TunedPolicy, write_tuned
from baselines.sweeps.contenders import CONTENDER_COLUMNS
from baselines.sweeps.sweep import REPORTED
from quad_envs import __version__
from quad_envs.registration import TEAMS, TRACKING

HELIX = "quad/HelixTracking-v0"
RUN = [sys.executable, "-m", "baselines"]


def test_evaluate_prints_a_table(capsys):
    assert main(["evaluate", HELIX, "hover", "--episodes", "2"]) == 0
    out, err = capsys.readouterr()
    assert out.startswith(f"hover on {HELIX}, 2 flights from seed 0") and "position_rms" in out
    assert "%" not in err  # no progress bar where nobody watches


def test_evaluate_as_json_prints_json_alone(capsys):
    assert main(["evaluate", HELIX, "random", "--episodes", "2", "--seed", "3", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["policy"], found["seed"], found["episodes"]) == ("random", 3, 2)
    assert [record["seed"] for record in found["records"]] == [3, 4]


def test_set_reaches_the_environment_and_policy_set_the_policy(capsys):
    arguments = ["--episodes", "1", "--json"]
    main(["evaluate", HELIX, "random", *arguments, "--set", "kappa=0.3125", "--set", "tilt_limit=.3"])
    first = json.loads(capsys.readouterr().out)
    main(["evaluate", HELIX, "random", *arguments, "--policy-set", "seed=4"])
    second = json.loads(capsys.readouterr().out)
    assert "tilt" in first["worst_violation"] and second["worst_violation"] == {}
    assert first["summary"]["effort"]["mean"] < second["summary"]["effort"]["mean"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1", 1),
        (".5", 0.5),
        ("[1, 2]", [1, 2]),
        ("(1, 2)", (1, 2)),
        ("true", True),
        ("None", None),
        ("wind", "wind"),
        ("x=y", "x=y"),
        ("", ""),
        ('{"mass": 0.1}', {"mass": 0.1}),
        ("{kind: helix, radius: 2}", {"kind": "helix", "radius": 2}),
        ("{kind = line, velocity = [1, 0, -.2]}", {"kind": "line", "velocity": [1, 0, -0.2]}),
        ("{ kind : csv , path: ~/my logs/a.csv , }", {"kind": "csv", "path": "~/my logs/a.csv"}),
        ("{path: C:\\logs\\a.csv}", {"path": "C:\\logs\\a.csv"}),
        ("{a: {b: [1, {c: true}], 'd, e': \"f: g\"}}", {"a": {"b": [1, {"c": True}], "d, e": "f: g"}}),
        ("[helix, {}, []]", ["helix", {}, []]),
    ],
)
def test_assignments_are_json_or_python_or_mappings_or_text(text, expected):
    assert read_assignments("--set", [f"key={text}"]) == {"key": expected}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{kind: helix", "expected ',' or '}' at character 13, got the end"),
        ("{kind: helix, radius}", "expected a key and ':' at character 21, got '}'"),
        ("{kind: helix} 3", "expected nothing more at character 15, got '3'"),
        ("{kind: , radius: 2}", "expected a value at character 8"),
        ("{kind: 'helix}", "expected a closing '"),
        ("{a: 1, a: 2}", "'a' is there twice"),
        ("[1, 2", "expected ',' or ']'"),
        ("[" * 3000 + "]" * 3000, "more than 20 brackets in each other"),
        ("{a: " + "b" * 100_000, "expected ',' or '}' at character 100005"),
        ("1" * 2_000_000, "longer than 1000000 characters"),
    ],
)
def test_mappings_with_mistakes_are_refused_with_the_place(capsys, text, message):
    said = fails(capsys, "evaluate", HELIX, "hover", "--set", f"reference={text}")
    assert message in said and "--set 'reference'" in said and len(said) < 300


def test_references_as_mappings_fly_from_the_command_line(capsys, tmp_path):
    (tmp_path / "up.csv").write_text("t,x,y,z\n0,0,0,0\n0.5,0,0,1\n1,0,0,2\n")
    table, found = f"{{kind: csv, path: {tmp_path / 'up.csv'}, axes: enu}}", []
    for reference in ("{kind: line, velocity: [0, 0, -2]}", table):
        arguments = ["--episodes", "1", "--json", "--set", "time_limit=1", "--set", f"reference={reference}"]
        assert main(["evaluate", HELIX, "lqr", *arguments]) == 0
        found.append(json.loads(capsys.readouterr().out)["summary"]["score"]["mean"])
    # The table ends with the episode, and what comes after is not scored: the same flight.
    assert found[0] == pytest.approx(found[1], abs=1e-12)


def test_mappings_stand_in_suites_too(capsys, tmp_path):
    suite, out = tmp_path / "suite.toml", tmp_path / "run"
    suite.write_text(
        'policies = ["lqr"]\nepisodes = 1\nseed = 0\n[[envs]]\nid = "quad/HelixTracking-v0"\nlabel = "line"\n'
        '[envs.kwargs]\ntime_limit = 1.0\nreference = {kind = "line", velocity = [0, 0, -2]}\n'
        '[[conditions]]\nlabel = "wind"\nkwargs = {disturbance = {kind = "steady", force = [0.2, 0, 0]}}\n'
    )
    assert main(["benchmark", str(suite), "--out", str(out)]) == 0
    assert "wind" in capsys.readouterr().out
    suite.write_text(suite.read_text().replace('"line", v', '"lin", v'))
    assert "did you mean 'line'" in fails(capsys, "benchmark", str(suite), "--out", str(tmp_path / "other"))


def test_evaluate_leaves_a_results_folder(capsys, tmp_path):
    out = tmp_path / "run"
    assert (
        main(["evaluate", HELIX, "hover", "--episodes", "2", "--out", str(out), "--save-episodes", "--json"])
        == 0
    )
    printed = json.loads(capsys.readouterr().out)
    assert printed["policy"] == "hover" and (out / "results.csv").is_file()
    assert len(list((out / "episodes").iterdir())) == 2


def test_flights_that_are_asked_for_later_are_flown_and_saved(tmp_path):
    arguments = ["evaluate", HELIX, "hover", "--episodes", "3", "--out", str(tmp_path), "--json"]
    assert main(arguments) == 0 and len(list((tmp_path / "episodes").iterdir())) == REPORTED
    assert main([*arguments, "--save-episodes"]) == 0
    assert len(list((tmp_path / "episodes").iterdir())) == 3


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ((HELIX, "apg-helix"), []),
        ((HELIX, "nmpc", "--set", "mass=0.8"), []),
        (
            (HELIX, "apg-helix", "--set", "mass=0.8"),
            [f"apg-helix was trained on {HELIX}; here it flies {HELIX} with mass=0.8"],
        ),
        (
            ("quad/LineTracking-v0", "apg-helix"),
            [f"apg-helix was trained on {HELIX}; here it flies quad/LineTracking-v0"],
        ),
        (
            (
                "quad/CorridorTracking-v0",
                "safe:nmpc",
                "--set",
                "disturbance=gusts",
                "--set",
                "sensor_noise=0",
            ),
            ["the filter of safe:nmpc predicts without disturbance: limits may be broken in spite of it"],
        ),
    ],
)
def test_evaluate_says_what_a_policy_was_not_made_for(capsys, arguments, expected):
    assert main(["evaluate", *arguments, "--episodes", "1", "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["episodes"] == 1
    assert [line.removeprefix("note: ") for line in err.splitlines() if line.startswith("note")] == expected


def test_evaluate_discards_another_run_if_asked_to(capsys, tmp_path):
    arguments = ["evaluate", HELIX, "hover", "--out", str(tmp_path), "--episodes"]
    assert main([*arguments, "2"]) == 0
    capsys.readouterr()
    assert "--fresh" in fails(capsys, *arguments, "2", "--seed", "1")
    assert main([*arguments, "2", "--seed", "1", "--fresh"]) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["evalute", HELIX, "hover"], "unknown command 'evalute'; did you mean 'evaluate'"),
        (["evaluate", "quad/HelixTrack-v0", "hover"], "did you mean 'quad/HelixTracking-v0'"),
        (["evaluate", HELIX, "hover", "--out", ""], "must name a file or folder, got nothing"),
        (["evaluate", "helix", "hover"], "did you mean 'quad/HelixTracking-v0'"),
        (["evaluate", HELIX, "hovr"], "unknown policy 'hovr'; did you mean 'hover'"),
        (["evaluate", HELIX, "random", "--policy-set", "sed=1"], "did you mean 'seed'"),
        (["evaluate", HELIX, "hover", "--set", "kapa=1"], "did you mean 'kappa'"),
        (["evaluate", HELIX, "hover", "--set", "kappa=0.2"], "must lie in (1/4, 20]"),
        (
            ["evaluate", HELIX, "hover", "--set", "render_mode=a"],
            "render_mode must be None or 'rgb_array', got",
        ),
        (["evaluate", HELIX, "hover", "--set", "kappa"], "--set needs KEY=VALUE"),
        (["evaluate", HELIX, "hover", "--set", "kappa=1", "--set", "kappa=1"], "sets 'kappa' twice"),
        (["evaluate", HELIX, "hover", "--episodes", "0"], "episodes must be a whole number >= 1, got 0"),
        (
            ["evaluate", HELIX, "hover", "--episodes", "many"],
            "--episodes: must be a whole number, got 'many'",
        ),
        (["train", HELIX, "apg", "--seconds", "few"], "--seconds: must be a number, got 'few'"),
        (["evaluate", HELIX, "hover", "--set", "tilt_limit=much"], "tilt_limit must be a number, rad"),
        (["evaluate", HELIX, "hover", "--episode", "3"], "did you mean '--episodes'"),
        (["evaluate", HELIX, "hover", "more"], "unexpected argument 'more'"),
        (["evaluate", HELIX, "hover", "--save-episodes"], "needs a folder: --out FOLDER"),
        (["evaluate", HELIX], "required: policy"),
        ([], "required: COMMAND"),
        (["benchmark", "quik"], "unknown suite 'quik'; did you mean 'quick'"),
        (["benchmark", "quick", "--engine", "processe"], "did you mean 'processes'"),
        (["list", "hovr"], "did you mean 'hover'"),
        (["evaluate", HELIX, "LMPC"], "unknown policy 'LMPC'; did you mean 'lmpc'"),
        (["evaluate", "quad/Formation", "hover"], "did you mean 'quad/Formation-v0'"),
        (["evaluate", "quad/Formation-v0", "hover", "--set", "grph=weak"], "did you mean 'graph'"),
        (["evaluate", "quad/Formation-v0", "lmpc"], "for tracking tasks, not for formation"),
        (["evaluate", HELIX, "consensus-mpc"], "for formation tasks, not for tracking"),
        (["evaluate", HELIX, "hover", "--set", "reference=nofile.csv"], "nofile.csv"),
        (["evaluate", HELIX, "hover", "--set", "reference={kind: heliks}"], "did you mean 'helix'"),
        (
            ["evaluate", HELIX, "hover", "--set", "reference={kind: helix, radios: 2}"],
            "did you mean 'radius'",
        ),
        (["evaluate", HELIX, "hover", "--set", "disturbance={kind: gusts, force: -1}"], "deviation >= 0"),
        (["evaluate", HELIX, "hover", "--set", "reference=" + "x" * 5000], "unknown reference 'xxx"),
        (["evaluate", HELIX, "hover", "--seed", "-1"], "seed must be a whole number >= 0, got -1"),
        (["evaluate", "CartPole-v1", "hover"], "one of the ids quad/Regulation-v0"),
        (["evaluate", HELIX, "hover", "--save-episodes"], "--save-episodes needs a folder"),
        (["evaluate", HELIX, "hover", "--fresh"], "--fresh needs a folder"),
    ],
)
def test_bad_input_gets_one_clear_line_and_exit_code_2(capsys, arguments, message):
    assert message in fails(capsys, *arguments)


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (PermissionError(13, "Permission denied", "a.csv"), "a.csv: Permission denied"),
        (gymnasium.error.NameNotFound("first\nsecond"), "error: first second"),
        (MemoryError(), "not enough memory"),
        (OverflowError("int too large"), "a number is too large: int too large"),
    ],
)
def test_what_bad_input_raises_elsewhere_gets_one_clear_line_too(capsys, monkeypatch, error, message):
    def fail(options):
        raise error

    monkeypatch.setitem(COMMANDS, "list", COMMANDS["list"]._replace(run=fail))
    assert message in fails(capsys, "list")


def test_a_mistake_of_ours_keeps_its_traceback(monkeypatch):
    monkeypatch.setitem(COMMANDS, "list", COMMANDS["list"]._replace(run=lambda options: {}["missing"]))
    with pytest.raises(KeyError):
        main(["list"])


def test_the_advice_to_resume_can_be_pasted_into_a_shell():
    text = _resume(BenchmarkOptions(suite="my suite.toml"), Path("a folder"))
    assert shlex.split(text) == ["quad-envs", "benchmark", "my suite.toml", "--out", "a folder"]


def test_a_folder_that_cannot_be_written_gets_one_clear_line(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    message = fails(capsys, "evaluate", HELIX, "hover", "--episodes", "1", "--out", str(tmp_path / "file"))
    assert "is a file, not a folder" in message


def test_list_names_every_environment_and_policy(capsys):
    assert main(["list", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert set(found["environments"]) == set(TRACKING) and set(found["policies"]) == set(TRACKING_POLICIES)
    assert set(found["team_environments"]) == set(TEAMS) and set(found["team_policies"]) == set(TEAM_POLICIES)
    assert main(["list"]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in (*TRACKING, *TEAMS, *TRACKING_POLICIES, *TEAM_POLICIES))


@pytest.mark.parametrize(("name", "option"), [(HELIX, "reference"), ("random", "seed")])
def test_list_shows_the_options_of_a_name(capsys, name, option):
    assert main(["list", name, "--json"]) == 0
    assert option in json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(
    ("name", "key", "value"),
    [
        ("crazyflie", "mass", 0.027),
        ("ppo-corridor", "env_id", "quad/CorridorTracking-v0"),
        ("quick", "seed", 0),
    ],
)
def test_list_shows_what_a_name_without_options_is(capsys, name, key, value):
    assert main(["list", name, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[key] == value
    assert main(["list", name]) == 0
    assert name in capsys.readouterr().out.splitlines()[0]


def test_every_name_of_the_list_can_be_listed(capsys):
    assert main(["list", "--json"]) == 0
    for name in {name for shelf in json.loads(capsys.readouterr().out).values() for name in shelf}:
        assert main(["list", name]) == 0, name


def test_list_says_what_columns_are(capsys):
    assert main(["list", "columns", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert list(said) == [*COLUMNS, *CONTENDER_COLUMNS] and all(said.values())
    assert "{" not in "".join(said.values()) and "the policy that others" in said["score_minus_base"]
    assert main(["list", "steady_rms", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"steady_rms": said["steady_rms"]}
    assert said["steady_rms"].startswith("m; ")


def test_list_says_what_the_folder_of_a_trained_or_tuned_policy_is(capsys, tmp_path):
    tuned = TunedPolicy("lmpc", {"R": 2.0}, HELIX, {"mass": 0.8})
    write_tuned(tmp_path, tuned, {"score": 0.5, "updates": 3})
    assert main(["list", str(tmp_path), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said == {"env_id": HELIX, **tuned._asdict(), "score": 0.5}
    assert main(["list", str(SHIPPED / "ppo-helix"), "--json"]) == 0
    trained = json.loads(capsys.readouterr().out)
    assert main(["list", "ppo-helix", "--json"]) == 0
    assert trained == json.loads(capsys.readouterr().out) and trained["algorithm"] == "ppo"
    (tmp_path / "empty").mkdir()
    assert "cannot read policy.json" in fails(capsys, "list", str(tmp_path / "empty"))


def test_version_is_that_of_the_package(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0 and capsys.readouterr().out == f"quad-envs {__version__}\n"


@pytest.mark.parametrize(("text", "value"), [("inf", np.inf), ("-inf", -np.inf), ("[1, inf]", [1, np.inf])])
def test_infinity_is_read_as_list_shows_it(text, value):
    assert read_value(text) == value


def test_list_shows_what_each_option_of_a_tracking_environment_means(capsys):
    assert main(["list", HELIX]) == 0
    printed = [line for line in capsys.readouterr().out.splitlines()[1:] if not line.startswith("  kappa")]
    assert len(printed) > 25 and not [line for line in printed if " # " not in line]


@pytest.mark.parametrize(
    "name", [name for name in (*TRACKING_POLICIES, *TEAM_POLICIES) if policy_comments(name)]
)
def test_list_shows_what_each_option_of_a_controller_means(capsys, name):
    assert main(["list", name]) == 0
    printed = capsys.readouterr().out.splitlines()[1:]
    assert [line.split()[0] for line in printed] == list(policy_options(name))
    for line, meaning in zip(printed, policy_comments(name).values(), strict=True):
        assert meaning and line.endswith(f"# {meaning}")


def test_benchmark_prints_tables_and_says_where_the_results_are(capsys, tmp_path):
    suite = tmp_path / "two.toml"
    suite.write_text('envs = ["quad/HelixTracking-v0"]\npolicies = ["hover", "random"]\nepisodes = 9\n')
    out = tmp_path / "run"
    assert main(["benchmark", str(suite), "--episodes", "2", "--out", str(out)]) == 0
    printed, said = capsys.readouterr()
    assert "RMS m" in printed and f"results in {out}" in said
    assert json.loads((out / "config.json").read_text())["suite"]["episodes"] == 2


def test_help_and_list_load_nothing_heavy():
    code = (
        "import sys; from baselines.__main__ import main, make_parser; make_parser().format_help();"
        "main(['list']);"
        "print([m for m in ('numba', 'scipy', 'joblib', 'osqp', 'controllers', 'torch') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_every_command_has_a_help_page(capsys):
    for name in COMMANDS:
        with pytest.raises(SystemExit) as end:
            main([name, "--help"])
        assert end.value.code == 0 and capsys.readouterr().out.startswith(f"usage: quad-envs {name}")


def test_a_reader_that_leaves_is_no_error():
    with subprocess.Popen([*RUN, "list"], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait() == 141


def test_ctrl_c_says_how_to_resume_and_exits_with_130(tmp_path):
    out, suite = tmp_path / "run", tmp_path / "long.toml"
    suite.write_text('envs = ["quad/HelixTracking-v0"]\npolicies = ["random", "hover"]\nepisodes = 2000\n')
    with start_command("benchmark", suite, "--out", out) as process:
        for _ in range(600):
            if list(out.glob("cells/*.json")):
                break
            time.sleep(0.05)
        os.kill(process.pid, signal.SIGINT)
        printed, said = process.communicate(timeout=30)
    assert process.returncode == 130 and printed == "" and "Traceback" not in said
    assert (
        f"what was flown is stored, 0 units whole. Resume with: quad-envs benchmark {suite} --out {out}"
        in said
    )
    assert not (out / "results.csv").exists()


def test_doctor_examines_the_installation(capsys):
    assert main(["doctor", "--json"]) == 0
    findings = {finding["check"]: finding for finding in json.loads(capsys.readouterr().out)}
    assert set(findings) == {"versions", "packages", "cache", "self-test", "team-test", "extras"}
    assert all(finding["ok"] for finding in findings.values())
    assert re.match(r"\d+ compiled kernels in /", findings["cache"]["detail"])


def test_doctor_names_a_package_of_the_same_name(monkeypatch):
    from baselines.cli import doctor

    monkeypatch.setattr(
        doctor.metadata, "packages_distributions", lambda: {"controllers": ["quad-envs", "webapp"]}
    )
    finding = doctor._shadowing()
    assert not finding.ok and "webapp also installs a package controllers" in finding.detail


def test_help_loads_neither_numpy_nor_gymnasium():
    """It has to be there at once: 0.07 CPU-s, with them 0.4."""
    code = "import sys, baselines.__main__ as m\ntry: m.main(['--help'])\nexcept SystemExit: pass\n"
    loaded = "print(*{'numpy', 'gymnasium', 'numba', 'quad_envs'} & {*sys.modules}, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code + loaded], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == ""
