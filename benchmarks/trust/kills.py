"""Commands that die before a file operation or at any moment, and are called again: nothing is lost or half.

A command runs in a child of this process, which has all modules and kernels at hand. A hook counts what it
does to files of its folder; before the k-th operation the child is gone, without a last word. Then the same
command goes on (`--resume` where it has that), and the folder must be that of a run which nobody disturbed,
but for times. A network goes on with other flights than those it has seen: its folder must be whole, nothing
in it doubled, and the same each time that it goes on from where it died.
"""

from __future__ import annotations

import csv
import io
import json
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from baselines.__main__ import main
from baselines.policies.checkpoints import load_checkpoint

from .found import Found

HELIX = "quad/HelixTracking-v0"
_SHORT = ("--set", "time_limit=1")
_OPERATIONS = frozenset(("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "shutil.rmtree"))
_TIMES = re.compile(r"seconds|decision|team_ms|command\b|commands|made_by|digest")
_SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
_GONE = 137  # exit code of a child that died as it was told
_SUITE = """
envs = [{id = "quad/HelixTracking-v0", kwargs = {time_limit = 1.0}}, "quad/Regulation-v0"]
policies = ["random", "lqr"]
episodes = 2
"""


class Job(NamedTuple):
    """A command that leaves a folder."""

    name: str
    arguments: tuple[str, ...]
    again: tuple[str, ...] = ()  # with which it goes on
    whole: Callable[[Path, Path], str] | None = None  # (undisturbed, folder) -> what is wrong; else: equal


def folder_of(job: Job, home: Path) -> Path:
    """Where it leaves what it makes."""
    return home / "out"


def essence(folder: Path) -> dict[str, Any]:
    """What is in a folder, without times and the words of the command."""
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_dir() or name == ".lock" or name.startswith("tensorboard"):
            continue
        if path.suffix == ".json":
            text = path.read_text().replace(str(folder.resolve()), "out")
            found[name] = repr(_timeless(json.loads(text)))
        elif path.suffix == ".csv":
            rows = csv.DictReader(io.StringIO(path.read_text()))
            found[name] = [_timeless(row) for row in rows]
        elif path.suffix == ".npz":
            with np.load(path) as arrays:
                found[name] = [
                    (key, arrays[key].tobytes()) for key in sorted(arrays) if not _TIMES.search(key)
                ]
        elif path.suffix == ".safetensors":
            network, _ = load_checkpoint(path.parent)  # its description has times
            found[name] = [array.tobytes() for array in (*network.weights, *network.biases)]
        elif path.suffix == ".html":
            found[name] = path.read_bytes().endswith(b"</html>\n")
        else:
            found[name] = path.read_bytes()
    return found


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _timeless(entry) for key, entry in value.items() if not _TIMES.search(str(key))}
    return [_timeless(entry) for entry in value] if isinstance(value, list) else value


def unequal(one: dict[str, Any], other: dict[str, Any]) -> str:
    """Names of files in which two folders differ."""
    names = [name for name in {**one, **other} if one.get(name) != other.get(name)]
    return f"differs in {', '.join(names[:4])}" if names else ""


def _trained(undisturbed: Path, folder: Path) -> str:
    """What is wrong with the folder of a training that went on."""
    curves = [essence(place)["curve.csv"] for place in (undisturbed, folder)]
    updates = [int(row["updates"]) for row in curves[1]]
    if updates != sorted(set(updates)):
        return f"evaluations are doubled: {updates}"
    if int(curves[1][-1]["steps"]) < int(curves[0][-1]["steps"]):
        return "less was trained than was asked for"
    _, last = load_checkpoint(folder / "last")
    _, best = load_checkpoint(folder)
    if last["updates"] != updates[-1] or best["updates"] not in updates:
        return "a policy is not on the curve"
    scores = [float(row["score"]) for row in curves[1]]
    if best["score"] != max(scores):
        return f"the best policy scores {best['score']}, and one on the curve {max(scores)}"
    said = json.loads((folder / "policy.json").read_text())
    return "" if said["digest"] == best["digest"] else "weights and description do not belong together"


JOBS = (
    Job("benchmark", ("benchmark", "suite.toml", "--out", "out")),
    Job("evaluate", ("evaluate", HELIX, "lqr", "--episodes", "2", *_SHORT, "--out", "out")),
    Job(
        "train",
        ("train", HELIX, "dagger", "--steps", "3000", *_SHORT, "--out", "out"),
        ("--resume",),
        _trained,
    ),
    Job(
        "tune",
        ("tune", HELIX, "lmpc", "--tuned", "Q", "--episodes", "144", *_SHORT, "--out", "out"),
        ("--resume",),
    ),
    Job("reproduce", ("reproduce", "table-4.2", "table-4.1", "--out", "out")),
)


class Ended(NamedTuple):
    """How a child ended."""

    code: int  # of the shell: 128 + signal where one ended it
    operations: int  # on files of its folder
    seconds: float


def call(
    arguments: Sequence[str], home: Path, dies_at: int = -1, blow: tuple[float, int] | None = None
) -> Ended:
    """Run a command in a child of this process.

    Args:
        arguments: Of the command.
        home: Its current folder.
        dies_at: Before which operation on files it is gone; never if negative.
        blow: After how many seconds which signal is sent.
    """
    read, write = os.pipe()
    begin = time.perf_counter()
    child = os.fork()
    if child == 0:
        os.close(read)
        _be_the_child(arguments, home, dies_at, write)
    os.close(write)
    if blow is not None:
        time.sleep(blow[0])
        os.kill(child, blow[1])
    with os.fdopen(read) as file:
        counted = file.read()
    _, status = os.waitpid(child, 0)
    code = os.waitstatus_to_exitcode(status)
    return Ended(128 - code if code < 0 else code, int(counted or 0), time.perf_counter() - begin)


def _be_the_child(arguments: Sequence[str], home: Path, dies_at: int, told: int) -> None:
    """Never returns."""
    code, count = 70, 0
    try:
        os.chdir(home)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)
        null = os.open(os.devnull, os.O_RDWR)
        for number in (0, 1, 2):
            os.dup2(null, number)
        inside = str(home / "out")

        def hook(event: str, details: tuple[Any, ...]) -> None:
            nonlocal count
            if event not in _OPERATIONS or isinstance(details[0], int):
                return
            path = os.fsdecode(details[0])
            # A name alone is one in a folder that shutil.rmtree has opened.
            within = event in ("os.remove", "os.rmdir") and "/" not in path
            if not (within or path.startswith((inside, "out"))):
                return
            if count == dies_at:
                os._exit(_GONE)
            count += 1

        sys.addaudithook(hook)
        code = main(arguments)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    finally:  # whatever happens: nothing of the parent's may be gone on with
        os.write(told, str(count).encode())
        os._exit(code)


def _prepared(home: Path) -> Path:
    shutil.rmtree(home, ignore_errors=True)
    home.mkdir(parents=True)
    (home / "suite.toml").write_text(_SUITE)
    return home


def _import_and_compile(job: Job, home: Path) -> None:
    """Have modules and kernels at hand, which all children share."""
    before = os.getcwd()
    with open(os.devnull, "w") as null, redirect_stdout(null), redirect_stderr(null):
        os.chdir(home)
        try:
            main(job.arguments)
        finally:
            os.chdir(before)


def _age(folder: Path) -> None:
    """What a dead writer left looks as if it were of yesterday: young files may belong to the living."""
    for path in folder.rglob(".*.tmp"):
        os.utime(path, (time.time() - 86_400.0,) * 2)


def goes_on(job: Job, undisturbed: Path, home: Path) -> str:
    """Call a command again after its death; what is wrong with what it leaves."""
    out = folder_of(job, home)
    copies = [out]
    if job.whole is not None:
        copies.append(home / "again" / "out")
        shutil.copytree(out, copies[1]) if out.exists() else copies[1].parent.mkdir()
        shutil.copy(home / "suite.toml", copies[1].parent)
    for copy in copies:
        if copy.exists():
            _age(copy)
        begun = (copy / "config.json").exists()  # else there is nothing to go on with
        ended = call((*job.arguments, *(job.again if begun else ())), copy.parent)
        used_up = job.whole is not None and ended.code == 2  # all of the budget: there is nothing left to do
        if ended.code != 0 and not used_up:
            return f"going on ended with code {ended.code}"
        if left := [path.name for path in copy.rglob("*") if path.name.endswith((".tmp", ".new"))]:
            return f"{left[0]} stays behind"
    if job.whole is None:
        return unequal(essence(undisturbed), essence(out))
    return job.whole(undisturbed, out) or unequal(*map(essence, copies))


def kills(seed: int = 0, jobs: Sequence[Job] = JOBS) -> Iterator[Found]:
    """Kills without end: of each command in turn, two before a file operation, then one at any moment."""
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory() as place:
        counted: dict[str, Ended] = {}
        for job in jobs:
            _import_and_compile(job, _prepared(Path(place) / job.name))
            counted[job.name] = call(job.arguments, _prepared(Path(place) / job.name))
            if counted[job.name].code != 0:
                yield Found(1, (f"{job.name}: ended with code {counted[job.name].code}, undisturbed",))
                return
        k = 0
        while True:
            for job in jobs:
                usual = counted[job.name]
                home = _prepared(Path(place) / "killed")
                if k % 3 == 2:
                    moment, number = rng.uniform(0.0, usual.seconds), rng.choice(_SIGNALS)
                    what = f"{job.name} with {number.name} after {moment:.3f} s"
                    ended = call(job.arguments, home, blow=(moment, number))
                else:
                    operation = rng.randrange(usual.operations)
                    what = f"{job.name} before operation {operation} of {usual.operations}"
                    ended = call(job.arguments, home, dies_at=operation)
                if ended.code == 0:
                    continue  # it was over before
                wrong = goes_on(job, folder_of(job, Path(place) / job.name), home)
                yield Found(1, (f"{what}: {wrong}",) if wrong else ())
            k += 1
