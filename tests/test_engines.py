"""Units of a sweep run elsewhere: processes that die, clusters that are joined, other versions."""

import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from baselines import run_benchmark
from baselines.errors import ResultsError
from baselines.evaluation.evaluate import Evaluation
from baselines.policies.trained import SHIPPED
from baselines.sweeps import engines
from baselines.sweeps.engines import run_units
from baselines.sweeps.inputs import read_files
from baselines.sweeps.suite import EnvChoice, PolicyChoice
from baselines.sweeps.unit_flights import fly_unit
from baselines.sweeps.units import Unit

SUITE = {
    "name": "small",
    "envs": [{"id": "quad/HelixTracking-v0", "kwargs": {"time_limit": 1.0}}, "quad/LineTracking-v0"],
    "policies": ["hover", "lqr", "feedback-linearization"],
    "episodes": 3,
}


class Job(NamedTuple):
    """A unit of these tests."""

    number: int
    folder: Path
    deadly: bool = False


def work(job):
    """Square the number; a deadly job ends its process each time, a number of 3 only at the first time."""
    first = job.folder / f"{job.number}.seen"
    if job.deadly or (job.number == 3 and not first.exists()):
        first.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if job.number == 5:
        raise RuntimeError("five is\nnot liked")
    return {"square": job.number**2, "process": os.getpid()}


def write_table(path):
    """A trajectory to follow."""
    t = np.linspace(0.0, 10.0, 21)
    rows = np.column_stack([t, 0.2 * t, 0.0 * t, -1.0 + 0.0 * t])
    np.savetxt(path, rows, delimiter=",", header="t,x,y,z", comments="")


def without_times(rows):
    return [{key: value for key, value in row.items() if "decision" not in key} for row in rows]


def test_a_unit_that_fails_or_whose_process_dies_leaves_the_others_alone(tmp_path):
    jobs = [Job(number, tmp_path, deadly=number == 4) for number in range(7)]
    found = dict(run_units(work, jobs, "processes", 2))
    assert sorted(found) == list(range(7))
    assert [found[number]["square"] for number in (0, 1, 2, 3, 6)] == [0, 1, 4, 9, 36]
    assert "process ended without an answer" in found[4]["failure"]
    assert found[5]["failure"] == "RuntimeError: five is not liked"


def test_in_one_process_a_unit_that_fails_leaves_the_others_alone_too(tmp_path):
    found = dict(run_units(work, [Job(number, tmp_path) for number in (5, 6)], "processes", None))
    assert found[5]["failure"] == "RuntimeError: five is not liked" and found[6]["square"] == 36
    (last,) = run_units(work, [Job(5, tmp_path)], "processes", 1)  # as that of a sweep that goes on
    assert last == (5, {"failure": "RuntimeError: five is not liked"})


def test_a_worker_with_other_sources_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(engines, "source_digest", lambda: "another")
    with pytest.raises(ResultsError, match=r"other sources .* install the same version of quad-envs"):
        list(run_units(work, [Job(number, tmp_path) for number in range(2)], "processes", 2))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes have no parents here")
def test_processes_end_soon_after_a_sweep_that_is_killed(tmp_path):
    code = (
        "import sys, time; sys.path.insert(0, 'tests')\n"
        "from test_engines import *\n"
        "for number, found in run_units(work, [Job(i, Path(sys.argv[1])) for i in (0, 1)], 'processes', 2):\n"
        "    print(found['process'], flush=True)\n"
        "time.sleep(60)\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        workers = {int(process.stdout.readline()) for _ in range(2)}
        process.kill()
    end = time.monotonic() + 20.0
    while alive := [pid for pid in workers if Path(f"/proc/{pid}").exists()]:
        assert time.monotonic() < end, alive
        time.sleep(0.2)


def test_a_unit_brings_its_files_to_where_they_are_not(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_table("ref.csv")
    shutil.copytree(SHIPPED / "apg-helix", "net")
    env = EnvChoice("quad/HelixTracking-v0", {"reference": "ref.csv", "tilt_limit": 0.4})
    unit = Unit(0, env, PolicyChoice("safe:./net"), "safe:./net", 2, 0, 1)
    here = fly_unit(unit)
    away = unit._replace(files=read_files(unit))
    shutil.rmtree("net")
    Path("ref.csv").unlink()
    there = pickle.loads(pickle.dumps(away))
    found = [Evaluation.from_plain(flown["cell"]["found"]) for flown in (here, fly_unit(there))]
    assert [record.score for record in found[0].records] == [record.score for record in found[1].records]
    assert found[0].policy == found[1].policy
    with pytest.raises(FileNotFoundError):
        fly_unit(unit)


class Cluster:
    """A Dask cluster of two processes on this machine, each in a folder of its own."""

    def __init__(self, home):
        self.home, self.workers = home, []
        where = home / "scheduler.json"
        self.scheduler = self._start("scheduler", "--port", "0", "--host", "127.0.0.1", "--no-dashboard",
                                     "--scheduler-file", str(where))  # fmt: skip
        while not where.exists() or not where.read_text().endswith("}"):
            time.sleep(0.1)
        self.address = json.loads(where.read_text())["address"]
        self.add()
        self.add()

    def _start(self, *words):
        return subprocess.Popen(
            [sys.executable, "-m", "distributed.cli.dask_" + words[0], *words[1:]],
            cwd=self.home,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def add(self):
        """Another worker."""
        words = ["worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
        self.workers.append(self._start(*words))

    def close(self):
        """End all of it."""
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    import dask

    (tmp_path / "cluster").mkdir()
    found = Cluster(tmp_path / "cluster")
    with dask.config.set({"scheduler-address": found.address}):
        yield found
    found.close()


@pytest.mark.slow  # starts three processes that import everything, and trains two networks
def test_a_sweep_joins_a_dask_cluster_whose_workers_die_and_finds_the_same(cluster, tmp_path, monkeypatch):
    """The workers are in another folder, so that the relative path of the table means nothing to them."""
    monkeypatch.chdir(tmp_path)
    write_table("ref.csv")
    train = {"name": "apg", "train": {"steps": 2000, "seeds": [0, 1]}, "envs": ["quad/HelixTracking-v0"]}
    table = {"id": "quad/LineTracking-v0", "kwargs": {"reference": "ref.csv"}}
    suite = {**SUITE, "envs": ["quad/HelixTracking-v0", table], "policies": ["hover", "lqr", train]}
    killed = []

    def on_unit(count, total):
        if count in (1, 3) and len(killed) < count:
            cluster.workers[len(killed)].kill()
            killed.append(count)
            cluster.add()

    there = run_benchmark(suite, "there", engine="dask", on_unit=on_unit)
    assert killed and not there.failures and len(there.trainings) == 2
    shutil.copytree("there/networks", "here/networks")
    here = run_benchmark(suite, "here", jobs=2)
    assert without_times(there.rows()) == without_times(here.rows())
    names = [sorted(path.name for path in Path(place, "episodes").iterdir()) for place in ("there", "here")]
    assert names[0] == names[1] and len(names[0]) == 12
