"""The command line at its edges: long and deep input, other kinds of values, streams that are closed."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys

import pytest
from commands import fails

from quad_envs.arguments.names import shortened

HELIX = "quad/HelixTracking-v0"
RUN = f"{shlex.quote(sys.executable)} -m baselines"
LONG = "x" * 100_000
SUITE = 'policies = ["hover"]\nenvs = ["quad/HelixTracking-v0"]\nepisodes = 1\n'


@pytest.mark.parametrize(
    "arguments",
    [
        [LONG],
        ["evaluate", LONG, "hover"],
        ["evaluate", HELIX, LONG],
        ["evaluate", HELIX, "hover", LONG],
        ["evaluate", HELIX, "hover", f"--{LONG}"],
        ["evaluate", HELIX, "hover", "--episodes", LONG],
        ["evaluate", HELIX, "hover", "--episodes", "1" * 100_000],
        ["evaluate", HELIX, "hover", "--set", f"mass={LONG}"],
        ["evaluate", HELIX, "hover", "--set", f"{LONG}=1"],
        ["evaluate", HELIX, "hover", "--set", f"reference={LONG}.csv"],
        ["evaluate", HELIX, "lmpc", "--policy-set", f"solver={LONG}"],
        ["evaluate", HELIX, "hover", "--episodes", "1", "--out", LONG],
        ["benchmark", LONG],
        ["benchmark", f"{LONG}.toml"],
        ["benchmark", "quick", "--engine", LONG],
        ["train", HELIX, LONG],
        ["train", HELIX, "ppo", "--hyper", f"n_envs={LONG}"],
        ["train", HELIX, "ppo", "--from", LONG],
        ["reproduce", LONG],
        ["report", LONG],
        ["replay", LONG],
        ["list", LONG],
        ["certify", HELIX, LONG],
    ],
)
def test_a_long_input_is_not_repeated(capsys, arguments):
    said = fails(capsys, *arguments)
    assert "x" * 241 not in said and "1" * 241 not in said and len(said) < 1500


def test_messages_are_cut_at_long_words_and_where_they_never_end():
    assert shortened("a\n b  c") == "a b c"
    assert len(shortened("y" * 10**6)) < 200 and shortened("y" * 10**6 + "z").endswith("yz")
    assert len(shortened("a b " * 10**5)) == 2000
    path = "/home/somebody/" + "runs/" * 30 + "table.csv"
    assert shortened(path) == path


@pytest.mark.parametrize(
    "line", ["episodes = 1979-05-27", "episodes = true", "seed = 07:32:00", "name = 1979-05-27"]
)
def test_dates_and_booleans_in_suites_are_refused_by_name(capsys, tmp_path, line):
    key = line.split()[0]
    suite = tmp_path / "suite.toml"
    suite.write_text(
        "\n".join([line, *(one for one in SUITE.splitlines() if not one.startswith(key))]) + "\n"
    )
    assert f"{key} of" in fails(capsys, "benchmark", str(suite))


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("[[envs]]\nid = 1979-05-27", "id must be text"),
        ("[[envs]]\nid = 'quad/HelixTracking-v0'\nkwargs = {mass = 1979-05-27}", "mass must be a number"),
        ("[[envs]]\nid = 'quad/HelixTracking-v0'\nkwargs = {env_id = 'a'}", "'env_id' is no argument"),
        ("[[policies]]\nname = 1979-05-27", "name must be text"),
        ("[[policies]]\nname = 'lmpc'\nkwargs = {horizon = 1979-05-27}", "horizon of policy 'lmpc' must be"),
        ("[[policies]]\nname = 'ppo'\ntrain = {steps = 1979-05-27}", "steps of training must be"),
        ("[[policies]]\nname = 'ppo'\ntrain = {hyper = 1979-05-27}", "hyper of a training must be a table"),
        ("[[policies]]\nname = 'ppo'\ntrain = {hyper = {stages = 1979-05-27}}", "stages of 'ppo' must be"),
    ],
)
def test_dates_in_tables_of_suites_are_refused_by_name(capsys, tmp_path, table, message):
    if "hyper = {" in table:
        pytest.importorskip("stable_baselines3", reason="without it the training is refused for that")
    key = table[2:].split("]")[0]
    suite = tmp_path / "suite.toml"
    rest = [one for one in SUITE.splitlines() if not one.startswith(key)]
    suite.write_text("\n".join([*rest, table]) + "\n")
    assert message in fails(capsys, "benchmark", str(suite), "--out", str(tmp_path / "run"))


@pytest.mark.parametrize("deep", ["[" * 3000 + "]" * 3000, "{a=" * 3000 + "1" + "}" * 3000])
def test_files_nested_too_deeply_are_refused(capsys, tmp_path, deep):
    suite = tmp_path / "suite.toml"
    suite.write_text(f"policies = {deep}\n")
    assert "nested too deeply" in fails(capsys, "benchmark", str(suite))
    (tmp_path / "config.json").write_text(deep.replace("{a=", '{"a":'))
    for command in ("report", "replay"):
        assert "config.json" in fails(capsys, command, str(tmp_path))


def test_files_that_are_none_are_refused_and_not_waited_for(capsys, tmp_path):
    os.mkfifo(tmp_path / "config.json")
    assert "has no config.json" in fails(capsys, "report", str(tmp_path))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,x,y,z\n0,0,0,0\n1,0,0," + "1" * 200_000, "line 3: a cell is longer than"),
        ("t,x,y,z," + "q" * 200_000 + "\n0,0,0,0,1\n1,0,0,0,1", "line 1: a cell is longer than"),
        ('t,x,y,z\n0,0,0,0\n1,0,0,"' + "1," * 60_000, "line 3: a quote is not closed"),
    ],
)
def test_cells_that_no_number_needs_are_refused_with_their_line(capsys, tmp_path, text, message):
    (tmp_path / "long.csv").write_text(text)
    said = fails(capsys, "evaluate", HELIX, "hover", "--set", f"reference={tmp_path / 'long.csv'}")
    assert message in said and len(said) < 400


@pytest.mark.parametrize(
    "value",
    ["", "true", "NaN", "Infinity", "1e400", "1j", "{1, 2}", "1979-05-27", "9" * 5000, "\udcff", "[[]]"],
)
def test_values_of_any_kind_on_the_command_line_are_refused_by_name(capsys, value):
    assert "mass must be a number" in fails(capsys, "evaluate", HELIX, "hover", "--set", f"mass={value}")


@pytest.mark.parametrize(
    ("redirection", "code", "errors"),
    [
        ("list >&-", 2, 1),
        ("--help >&-", 2, 1),
        ("list > /dev/full", 2, 1),
        ("list --json > /dev/full", 2, 1),
        ("evaluate quad/HelixTracking-v0 hovr 2>&-", 2, 0),
        ("evaluate quad/HelixTracking-v0 hovr >&- 2>&-", 2, 0),
        ("list <&- > /dev/null", 0, 0),
    ],
)
@pytest.mark.parametrize("unbuffered", ["1", ""])
def test_closed_streams_end_with_one_line_and_print_nowhere_else(
    tmp_path, redirection, code, errors, unbuffered
):
    done = subprocess.run(
        ["bash", "-c", f"{RUN} {redirection}"],
        capture_output=True,
        text=True,
        env={**os.environ, "COLUMNS": "80", "PYTHONUNBUFFERED": unbuffered},
    )
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (code, "", errors)
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("arguments", ["list", "--help", "list quad/HelixTracking-v0 --json"])
def test_a_reader_that_has_left_ends_it_without_a_word(arguments):
    done = subprocess.run(
        ["bash", "-c", f"{RUN} {arguments} | true; exit ${{PIPESTATUS[0]}}"], capture_output=True, text=True
    )
    assert done.returncode in (141, 0) and (done.stdout, done.stderr) == ("", "")
