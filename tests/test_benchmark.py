"""Suites and results folders: complete, resumable, never half-written."""

from __future__ import annotations

import csv
import errno
import json
import math
import os
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import baselines.files
import baselines.sweeps.crews
import baselines.sweeps.store
from baselines import Results, ResultsError, Suite, load_suite, run_benchmark
from baselines.evaluation.evaluate import Evaluation
from baselines.files import locked, plain_json, write_atomic, write_csv
from baselines.policies.registry import TRACKING_POLICIES
from baselines.policies.trained import SHIPPED
from baselines.sweeps.folder import read_run
from baselines.sweeps.suite_files import suite_names
from quad_envs import Helix, from_function
from quad_envs.registration import TRACKING

HELIX = "quad/HelixTracking-v0"

SMALL = {
    "name": "small",
    "episodes": 3,
    "seed": 5,
    "envs": [
        "quad/HelixTracking-v0",
        {"id": "quad/Regulation-v0", "kwargs": {"kappa": 0.3, "tilt_limit": 0.3}},
    ],
    "policies": ["hover", {"name": "random", "kwargs": {"seed": 1}, "label": "dice"}],
}
TIMES = ("decision_p50_ms", "decision_p99_ms", "decision_max_ms")


def without_times(rows):
    return [{key: str(value) for key, value in row.items() if key not in TIMES} for row in rows]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A complete sweep and its folder."""
    folder = tmp_path_factory.mktemp("runs") / "small"
    return run_benchmark(SMALL, folder, save_episodes=True), folder


@pytest.fixture
def flown(monkeypatch):
    """Titles of the units that are flown."""
    titles = []
    real = baselines.sweeps.crews.fly_unit

    def count(unit):
        titles.append((unit.env.title, unit.policy.title))
        return real(unit)

    monkeypatch.setattr(baselines.sweeps.crews, "fly_unit", count)
    return titles


def test_every_policy_flies_in_every_environment_from_the_same_seeds(finished):
    rows = finished[0].rows()
    assert len(rows) == 2 * 2 * 3
    assert {row["env"] for row in rows} == {
        "quad/HelixTracking-v0",
        "quad/Regulation-v0, kappa=0.3, tilt_limit=0.3",
    }
    assert {row["policy"] for row in rows} == {"hover", "dice"}
    assert [row["seed"] for row in rows[:3]] == [5, 6, 7]


def test_the_folder_holds_configuration_results_summary_and_flights(finished):
    results, folder = finished
    assert sorted(path.name for path in folder.iterdir()) == [
        ".lock", "cells", "config.json", "episodes", "report.html", "results.csv", "summary.csv",
    ]  # fmt: skip
    config = json.loads((folder / "config.json").read_text())
    assert config["suite"]["episodes"] == 3 and "numba" in config["versions"] and "git_revision" in config
    with open(folder / "results.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["score"] for row in rows] == [str(row["score"]) for row in results.rows()]
    assert len(list((folder / "episodes").iterdir())) == 12


def test_a_saved_flight_has_its_arrays(finished):
    path = sorted((finished[1] / "episodes").glob("*hover*"))[0]
    with np.load(path) as arrays:
        assert arrays["states"].shape == (201, 16) and arrays["commands"].shape == (200, 4)


def test_differences_are_taken_from_the_first_policy_or_the_named_one(finished):
    rows = {(row["env"], row["policy"]): row for row in finished[0].summary()}
    hover, dice = (rows["quad/HelixTracking-v0", name] for name in ("hover", "dice"))
    assert hover["score_minus_base"] == 0.0
    assert dice["score_minus_base"] == pytest.approx(dice["score"] - hover["score"])
    assert load_suite(SMALL | {"compare_with": "dice"}).base == "dice"


def test_the_table_has_a_line_for_each_policy_and_environment(finished):
    text = str(finished[0])
    assert text.count("hover ") >= 2 and text.count("dice ") == 2 and "seeds 5 to 7" in text


def test_several_processes_find_the_same(finished):
    results = run_benchmark(SMALL, jobs=2)
    assert without_times(results.rows()) == without_times(finished[0].rows())


def test_an_interrupted_sweep_goes_on_where_it_stopped(tmp_path, flown, finished):
    def interrupt(count, total):
        if count == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_benchmark(SMALL, tmp_path, on_unit=interrupt)
    assert len(flown) == 2 and not (tmp_path / "results.csv").exists()
    results = run_benchmark(SMALL, tmp_path)
    assert len(flown) == 4 and len(set(flown)) == 4
    assert without_times(results.rows()) == without_times(finished[0].rows())


def test_a_complete_sweep_is_read_and_not_flown_again(tmp_path, flown):
    first = run_benchmark(SMALL, tmp_path)
    again = run_benchmark(SMALL, tmp_path)
    assert len(flown) == 4 and str(again) == str(first)


def test_a_fresh_run_discards_what_the_folder_holds_and_nothing_else(tmp_path, flown):
    run_benchmark(SMALL, tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    run_benchmark(SMALL | {"episodes": 1}, tmp_path, fresh=True)
    assert len(flown) == 8 and (tmp_path / "notes.txt").exists()


@pytest.mark.parametrize("fresh", [False, True])
@pytest.mark.parametrize(
    ("name", "text"), [("config.json", '{"mine": 1}'), ("config.json", "[1]"), ("results.csv", "a,b")]
)
def test_files_of_these_names_that_are_not_ours_are_left_alone(tmp_path, name, text, fresh, flown):
    (tmp_path / name).write_text(text)
    with pytest.raises(ResultsError, match=f"holds a {name} that no benchmark has written"):
        run_benchmark(SMALL, tmp_path, fresh=fresh)
    assert (tmp_path / name).read_text() == text and not flown


def test_another_suite_in_the_same_folder_is_refused(tmp_path):
    run_benchmark(SMALL, tmp_path)
    with pytest.raises(ResultsError, match=r"holds another suite \(it differs in seed\)"):
        run_benchmark(SMALL | {"episodes": 4, "seed": 0}, tmp_path)


def test_more_flights_extend_a_folder_and_fewer_are_read_from_it(tmp_path, flown, monkeypatch):
    monkeypatch.setattr(baselines.sweeps.store, "BLOCK", 2)  # of 3, 6 and 4 flights
    run_benchmark(SMALL, tmp_path)
    assert len(flown) == 8
    more = run_benchmark(SMALL | {"episodes": 6}, tmp_path)
    assert len(flown) == 16
    once = run_benchmark(SMALL | {"episodes": 6})
    assert without_times(more.rows()) == without_times(once.rows())
    fewer = run_benchmark(SMALL | {"episodes": 4}, tmp_path)
    assert len(flown) == 16 + 12 and fewer.evaluations[0].flights == 4
    assert [record.score for record in fewer.evaluations[0].records] == [
        record.score for record in once.evaluations[0].records[:4]
    ]
    assert read_run(tmp_path).finished[0].evaluation.flights == 4
    assert more.evaluations[0].decision_ms == fewer.evaluations[0].decision_ms


def test_stored_flights_beyond_those_asked_for_do_not_stand_for_missing_ones(tmp_path, flown, monkeypatch):
    monkeypatch.setattr(baselines.sweeps.store, "BLOCK", 2)
    more = run_benchmark(SMALL | {"episodes": 4}, tmp_path)
    for path in (tmp_path / "cells").glob("*-5-2.json"):  # the first block of each unit
        path.unlink()
    before, counts = len(flown), []
    fewer = run_benchmark(
        SMALL | {"episodes": 2}, tmp_path, on_unit=lambda count, total: counts.append(count)
    )
    assert counts == [0, 0, 1, 2, 3, 4]
    assert len(flown) == before + 4 and [one.flights for one in fewer.evaluations] == 4 * [2]
    for ours, theirs in zip(fewer.evaluations, more.evaluations, strict=True):
        assert [one.score for one in ours.records] == [one.score for one in theirs.records[:2]]


def test_a_unit_flies_again_when_a_file_that_it_reads_has_changed(tmp_path, flown):
    table = tmp_path / "ref.csv"

    def write(speed):
        t = np.linspace(0.0, 10.0, 21)
        rows = np.column_stack([t, speed * t, 0.0 * t, -1.0 + 0.0 * t])
        np.savetxt(table, rows, delimiter=",", header="t,x,y,z", comments="")

    write(0.2)
    checkpoint = tmp_path / "net"
    shutil.copytree(SHIPPED / "apg-helix", checkpoint)
    env = {"id": "quad/HelixTracking-v0", "kwargs": {"reference": str(table)}}
    suite = SMALL | {"envs": [env], "policies": ["hover", str(checkpoint)], "compare_with": "hover"}
    first = run_benchmark(suite, tmp_path / "out")
    assert run_benchmark(suite, tmp_path / "out").rows() == first.rows() and len(flown) == 2
    shutil.copytree(SHIPPED / "dagger-helix", checkpoint, dirs_exist_ok=True)
    with pytest.warns(UserWarning, match=r"net' flies again in .*what it reads has changed \(.*net\)"):
        run_benchmark(suite, tmp_path / "out")
    assert len(flown) == 3
    write(0.3)
    with pytest.warns(UserWarning, match=r"flies again in .*what it reads has changed \(.*ref\.csv"):
        second = run_benchmark(suite, tmp_path / "out")
    assert len(flown) == 5 and second.get(*_titles(suite, "hover")) != first.get(*_titles(suite, "hover"))


def _titles(suite, policy):
    return Suite.from_dict(load_suite(suite).to_dict()).envs[0].title, policy


def test_titles_that_differ_in_other_characters_have_files_of_their_own(tmp_path):
    policies = [{"name": "hover", "label": "a b"}, {"name": "random", "label": "a-b"}]
    results = run_benchmark(SMALL | {"policies": policies, "compare_with": ""}, tmp_path)
    assert len(list((tmp_path / "cells").iterdir())) == 4
    again = run_benchmark(SMALL | {"policies": policies, "compare_with": ""}, tmp_path)
    assert again.rows() == results.rows()


@pytest.mark.parametrize("start", [(0.0,) * 12, np.zeros(12), (0.0, np.float64(0.0), 0.0)])
@pytest.mark.parametrize("rate_limit", [5.0, math.inf])
def test_arguments_that_json_changes_have_the_title_that_is_read_again(tmp_path, start, rate_limit):
    kwargs = {"start": start, "start_box": 0.0, "rate_limit": rate_limit, "time_limit": 0.2}
    suite = {"name": "a", "episodes": 1, "envs": [{"id": HELIX, "kwargs": kwargs}], "policies": ["lqr"]}
    run_benchmark(suite, tmp_path)  # whose page reads the folder
    assert (tmp_path / "report.html").exists()


@pytest.mark.parametrize("reference", [Helix(radius=1.0), from_function(lambda t: [t, 0.0, 0.0])])
def test_objects_in_a_suite_fly_without_a_folder_alone(tmp_path, reference):
    kwargs = {"reference": reference, "time_limit": 0.2}
    suite = {"name": "a", "episodes": 1, "envs": [{"id": HELIX, "kwargs": kwargs}], "policies": ["lqr"]}
    assert run_benchmark(suite).evaluations[0].flights == 1
    with pytest.raises(ValueError, match=r"reference of .* which a results folder cannot hold: say it"):
        run_benchmark(suite, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_results_of_another_numpy_are_not_mixed(tmp_path, monkeypatch):
    run_benchmark(SMALL, tmp_path)
    real = baselines.sweeps.store.provenance()
    other = real | {"versions": real["versions"] | {"numpy": "1.0"}}
    monkeypatch.setattr(baselines.sweeps.store, "provenance", lambda: other)
    with pytest.raises(
        ResultsError, match=r"begun with numpy .*, and here is 1\.0: their numbers do not mix"
    ):
        run_benchmark(SMALL, tmp_path)


def test_results_of_other_sources_are_not_mixed(tmp_path, monkeypatch):
    run_benchmark(SMALL, tmp_path)
    monkeypatch.setattr(baselines.files, "source_digest", lambda: "0123abc")
    with pytest.raises(ResultsError, match="begun with other sources"):
        run_benchmark(SMALL, tmp_path)


def test_a_folder_in_use_is_refused(tmp_path):
    with locked(tmp_path), pytest.raises(ResultsError, match=f"in use by process {os.getpid()}"):
        run_benchmark(SMALL, tmp_path)
    with locked(tmp_path):  # free again
        pass


def test_a_folder_is_free_when_its_process_was_killed(tmp_path):
    code = (
        "import sys, time; from pathlib import Path; from baselines.files import locked\n"
        "with locked(Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"held\n"
        with pytest.raises(ResultsError, match=f"in use by process {process.pid} on "), locked(tmp_path):
            pass
        process.kill()
    with locked(tmp_path):
        assert json.loads((tmp_path / ".lock").read_text())["pid"] == os.getpid()


def test_what_a_dead_writer_left_is_swept_and_what_another_writes_is_not(tmp_path):
    (tmp_path / "cells").mkdir()
    old, young = tmp_path / "cells/.a.json.12.tmp", tmp_path / ".b.json.13.tmp"
    for path in (old, young):
        path.write_text("half")
    os.utime(old, (0, 0))
    with locked(tmp_path):
        assert young.exists() and not old.exists()


def test_the_lock_is_that_of_an_open_file_and_not_of_its_name(tmp_path):
    """Were the file removed at the end, one process could hold the old one and another the new one."""
    with locked(tmp_path):
        before = (tmp_path / ".lock").stat().st_ino
    with locked(tmp_path):
        assert (tmp_path / ".lock").stat().st_ino == before
    (tmp_path / ".lock").write_text(json.dumps({"pid": 1, "host": "elsewhere"}))  # says so, holds nothing
    with locked(tmp_path):
        pass


def test_a_file_in_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(ResultsError, match="taken' is a file"):
        run_benchmark(SMALL, tmp_path / "taken")
    with pytest.raises(ResultsError, match="cannot write into"):
        run_benchmark(SMALL, tmp_path / "taken" / "below")


def test_a_full_disk_leaves_no_half_written_file(tmp_path, monkeypatch):
    write_atomic(tmp_path / "a", b"old")

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(
        ResultsError, match=r"cannot write .*No space left on device.*finished units are kept"
    ):
        write_atomic(tmp_path / "a", b"new")
    assert (tmp_path / "a").read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1


def test_a_damaged_cell_is_named(tmp_path):
    run_benchmark(SMALL, tmp_path)
    cell = sorted((tmp_path / "cells").iterdir())[1]
    cell.write_text("{")
    with pytest.raises(ResultsError, match=f"cannot read .*{cell.name}.*delete it to fly this unit again"):
        run_benchmark(SMALL, tmp_path)


def test_stored_evaluations_read_back_as_they_were(finished):
    for evaluation in finished[0].evaluations:
        text = json.dumps(evaluation.to_plain(), allow_nan=False)
        assert repr(Evaluation.from_plain(json.loads(text))) == repr(evaluation)  # as nan != nan


def test_plain_json_turns_what_json_lacks_into_null():
    assert plain_json({"a": (np.float64("nan"), float("inf"), np.int64(3), np.arange(2), True, "x")}) == {
        "a": [None, None, 3, [0, 1], True, "x"]
    }


def test_csv_rows_may_have_different_columns(tmp_path):
    write_csv(tmp_path / "t.csv", [{"a": 1, "b": float("nan")}, {"a": 2, "c": "x,y"}])
    assert (tmp_path / "t.csv").read_text().splitlines() == ["a,b,c", "1,,", '2,,"x,y"']


# ---------------------------------------------------------------- suites


def test_the_default_suite_is_everything():
    suite = load_suite("default")
    assert [env.id for env in suite.envs] == list(TRACKING)
    assert [policy.name for policy in suite.policies] == list(TRACKING_POLICIES)


@pytest.mark.parametrize("name", suite_names())
def test_every_shipped_suite_loads(name):
    assert isinstance(load_suite(name), Suite) and suite_names()[name]


def test_a_suite_is_read_from_a_file(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(
        'envs = ["quad/HelixTracking-v0"]\nepisodes = 2\n'
        '[[policies]]\nname = "lmpc"\nkwargs = {horizon = 15}\nlabel = "short"\n'
    )
    suite = load_suite(path)
    assert (suite.name, suite.episodes, suite.policies[0].title) == ("mine", 2, "short")
    assert suite.policies[0].kwargs == {"horizon": 15}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"episode": 3}, "did you mean 'episodes'"),
        ({"episodes": 0}, "episodes of suite .* must be a whole number >= 1, got 0"),
        ({"episodes": 2.5}, "must be a whole number"),
        ({"seed": -1}, "seed of suite"),
        ({"envs": []}, "has no envs"),
        ({"envs": ["quad/Helix-v0"]}, "did you mean 'quad/HelixTracking-v0'"),
        ({"envs": [3]}, "choose by name or by a table with 'id', got 3"),
        ({"policies": [{"name": "hover", "kwargs": 3}]}, "kwargs of 'hover' must be a table.*got 3"),
        ({"policies": [{"name": "hover", "label": 3}]}, "label of 'hover' must be text, got 3"),
        ({"name": 3}, "name of a suite must be text, got 3"),
        ({"envs": "some"}, 'list of tables with .id., or "all"'),
        ({"policies": [{"kwargs": {}}]}, "each table needs 'name'"),
        ({"policies": [{"name": "hover", "kwarg": {}}]}, "did you mean 'kwargs'"),
        ({"policies": ["hover", "hover"]}, "'hover' twice in policies; give them labels"),
        ({"compare_with": "lmpc"}, "unknown compare_with"),
        ({"policies": [{"name": "random", "kwargs": {"sed": 1}}]}, "did you mean 'seed'"),
        ({"envs": [{"id": "quad/HelixTracking-v0", "kwargs": {"kapa": 1.0}}]}, "did you mean 'kappa'"),
        ({"envs": [{"id": "quad/HelixTracking-v0", "kwargs": {"kappa": 0.2}}]}, "must lie in"),
    ],
)
def test_a_mistake_in_a_suite_is_refused_before_anything_is_flown(change, message, flown):
    with pytest.raises(ValueError, match=message):
        run_benchmark(SMALL | change)
    assert not flown


def test_a_suite_that_does_not_exist_is_refused_with_a_suggestion(tmp_path):
    with pytest.raises(ValueError, match="unknown suite 'defualt'; did you mean 'default'"):
        load_suite("defualt")
    with pytest.raises(ValueError, match="there is no suite file"):
        load_suite(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("envs = [")
    with pytest.raises(ValueError, match="is not valid TOML"):
        load_suite(tmp_path / "bad.toml")
    (tmp_path / "latin.toml").write_bytes('name = "h\xfctte"'.encode("latin-1"))
    with pytest.raises(ValueError, match=r"latin\.toml' is not valid TOML"):
        load_suite(tmp_path / "latin.toml")
    (tmp_path / "odd.toml").write_text('envs = [3]\npolicies = ["hover"]')
    with pytest.raises(ValueError, match=r"odd\.toml': .*got 3"):
        load_suite(tmp_path / "odd.toml")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"engine": "rya"}, "unknown engine 'rya'; did you mean 'ray'"),
        ({"jobs": 0}, "jobs must be a whole number >= 1, got 0"),
        ({"save_episodes": True}, "save_episodes needs a folder"),
    ],
)
def test_bad_arguments_of_a_sweep_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        run_benchmark(SMALL, **arguments)


@pytest.mark.parametrize(("engine", "package"), [("ray", "ray"), ("dask", "distributed")])
def test_an_engine_that_is_not_installed_says_how_to_install_it(engine, package, monkeypatch):
    monkeypatch.setattr(baselines.sweeps.engines, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=f"needs the package {package}: pip install"):
        run_benchmark(SMALL, engine=engine)


def test_results_are_found_by_title(finished):
    results: Results = finished[0]
    assert results.get("quad/HelixTracking-v0", "dice").policy == "random"
    with pytest.raises(KeyError, match="no evaluation of 'lqr'"):
        results.get("quad/HelixTracking-v0", "lqr")
    assert replace(results.suite, seed=6).seed == 6
