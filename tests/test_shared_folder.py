"""Several processes at one results folder: each block is flown once, also where one of them dies."""

import signal
import subprocess
import sys
import time

import pytest

import baselines.files
from baselines import ResultsError, run_benchmark
from baselines.__main__ import main as command
from baselines.files import claimed
from baselines.report.benchmark import join_sweep
from baselines.sweeps import crews, shared, store
from baselines.sweeps.shared import Task, share

SUITE = {
    "name": "small",
    "envs": [{"id": "quad/HelixTracking-v0", "kwargs": {"time_limit": 2.0}}],
    "policies": ["hover", "lqr", "feedback-linearization"],
    "episodes": 6,
}


def without_times(rows):
    return [{key: value for key, value in row.items() if "decision" not in key} for row in rows]


def test_what_another_is_at_is_waited_for_and_done_when_it_dies(tmp_path, monkeypatch):
    done = []
    tasks = [
        Task(i, f"t{i}", lambda i=i: i if i in done else None, lambda i=i: done.append(i) or i, pytest.fail)
        for i in (0, 1)
    ]

    def give_up(seconds):
        raise InterruptedError

    with claimed(tmp_path / "claims/t0.lock") as ours:
        assert ours
        found = share(tasks, tmp_path)
        assert next(found) == (1, 1)
        monkeypatch.setattr(shared.time, "sleep", give_up)
        with pytest.raises(InterruptedError):
            list(found)
    assert list(share(tasks, tmp_path)) == [(0, 0), (1, 1)] and done == [1, 0]


def test_what_another_has_done_is_read(tmp_path):
    stored = iter([None, "theirs"])
    task = Task(0, "t", lambda: next(stored), lambda: pytest.fail("done twice"), pytest.fail)
    assert list(share([task], tmp_path)) == [(0, "theirs")]


def test_a_sweep_at_a_shared_folder_finds_the_same_and_is_joined_later(tmp_path, monkeypatch):
    monkeypatch.setattr(store, "BLOCK", 2)
    here = run_benchmark(SUITE)
    there = run_benchmark(SUITE, tmp_path / "out", engine="folder")
    assert without_times(there.rows()) == without_times(here.rows())
    assert len(list((tmp_path / "out/cells").glob("*.json"))) == 9
    assert join_sweep(tmp_path / "out") == (3, ())
    assert command(["worker", str(tmp_path / "out")]) == 0


def test_what_no_worker_can_join_is_refused(tmp_path, capsys):
    with pytest.raises(ResultsError, match=r"no sweep has been begun in .* --engine folder --out"):
        join_sweep(tmp_path)
    run_benchmark(SUITE | {"policies": ["hover"]}, tmp_path / "out")
    assert command(["worker", str(tmp_path / "out")]) == 2
    assert "has engine 'processes', which no worker joins" in capsys.readouterr().err
    with pytest.raises(ValueError, match="needs the folder"):
        run_benchmark(SUITE, engine="folder")
    with pytest.raises(ValueError, match="has no jobs: start as many quad-envs worker"):
        run_benchmark(SUITE, tmp_path / "b", engine="folder", jobs=2)
    with pytest.raises(ValueError, match="is an object, which does not reach"):
        run_benchmark(SUITE, tmp_path / "c", engine="folder", policies={"mine": lambda task: None})


def test_a_block_that_fails_is_said_to_all_and_tried_again_by_the_next_run(tmp_path, monkeypatch):
    real = crews.fly_unit

    def broken(unit):
        if unit.policy.title == "lqr":
            raise RuntimeError("no luck")
        return real(unit)

    monkeypatch.setattr(crews, "fly_unit", broken)
    with pytest.warns(UserWarning, match="no luck"):
        results = run_benchmark(SUITE, tmp_path, engine="folder")
    assert [failure.message for failure in results.failures] == ["RuntimeError: no luck"]
    with pytest.warns(UserWarning, match="no luck"):
        assert join_sweep(tmp_path) == (2, ("RuntimeError: no luck",))
    monkeypatch.setattr(crews, "fly_unit", real)
    assert not run_benchmark(SUITE, tmp_path, engine="folder").failures


@pytest.mark.parametrize("deaths", [shared._MOST_DEATHS - 1, shared._MOST_DEATHS])
def test_a_task_at_which_process_after_process_died_is_given_up(tmp_path, deaths):
    count = tmp_path / "claims/t.begun"
    baselines.files.write_json(count, deaths)  # as processes leave it that are killed
    began = []
    task = Task(0, "t", lambda: None, lambda: began.append(count.read_text()) or "done", lambda why: why)
    ((_, found),) = share([task], tmp_path)
    assert found == "done" if deaths < shared._MOST_DEATHS else "3 processes died at it" in found
    assert len(began) == (deaths < shared._MOST_DEATHS) and not count.exists()


DEADLY = """
import os, signal
import numpy as np

calls = 0

class Deadly:
    def __init__(self, task):
        pass

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        global calls
        calls += 1
        if calls > 60:
            os.kill(os.getpid(), signal.SIGKILL)
        return np.zeros((*observation.shape[:-1], 4), np.float32), state
"""


@pytest.mark.slow  # starts processes that import everything
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no such signal here")
def test_a_policy_that_kills_its_processes_is_a_failure_in_the_end_and_tried_by_the_next_run(tmp_path):
    (tmp_path / "deadly.py").write_text(DEADLY)
    suite = SUITE | {"policies": ["hover", "deadly:Deadly"]}
    code = (
        "import sys; sys.path.insert(0, '.')\nfrom baselines import run_benchmark\n"
        f"print(run_benchmark({suite!r}, 'out', engine='folder').failures)"
    )

    def run():
        return subprocess.run(
            [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
        )

    runs = [run() for _ in range(shared._MOST_DEATHS + 2)]
    died = [-signal.SIGKILL] * shared._MOST_DEATHS
    assert [each.returncode for each in runs] == [*died, 0, -signal.SIGKILL]
    assert "3 processes died at it" in runs[-2].stdout and (tmp_path / "out/report.html").exists()


@pytest.mark.slow  # starts processes that import everything
def test_workers_that_are_killed_leave_what_they_were_at_to_others(tmp_path):
    suite, out = SUITE | {"episodes": 2500}, tmp_path / "out"
    code = f"from baselines import run_benchmark; run_benchmark({suite!r}, {str(out)!r}, engine='folder')"
    head = subprocess.Popen([sys.executable, "-c", code])
    while not (out / "config.json").exists():
        time.sleep(0.05)
    workers = [subprocess.Popen([sys.executable, "-m", "baselines", "worker", str(out)]) for _ in range(3)]
    while len(list(out.glob("cells/*.json"))) < 3 and head.poll() is None:
        time.sleep(0.01)
    for process in (head, workers[0]):
        process.send_signal(signal.SIGKILL)
    codes = [process.wait() for process in (*workers, head)][:3]
    assert codes[0] in (0, -signal.SIGKILL) and codes[1:] == [0, 0]
    assert len(list(out.glob("cells/*.json"))) == 15
    assert without_times(run_benchmark(suite, out).rows()) == without_times(run_benchmark(suite).rows())
