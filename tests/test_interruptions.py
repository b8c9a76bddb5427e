"""Ctrl-C, SIGTERM and SIGHUP end a command wherever they arrive: nothing is lost, nobody stays behind."""

from __future__ import annotations

import ctypes
import fcntl
import os
import signal
import subprocess
import sys
import termios
import threading
import time
from contextlib import suppress

import pytest
from processes import start_command
from stub_training import (
    stub,
    stubs,  # noqa: F401  puts the stubs into the registry
)

from baselines.__main__ import COMMANDS, main
from baselines.interruptions import HungUp, Terminated, exit_code, held, raise_lost, remembered
from baselines.policies.checkpoints import load_checkpoint
from baselines.training.runs import train

HELIX = "quad/HelixTracking-v0"


@pytest.fixture(autouse=True)
def hears_signals():
    """Whatever these tests were started from: a shell lets what runs in its background ignore Ctrl-C."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def press(number=signal.SIGINT):
    os.kill(os.getpid(), number)
    time.sleep(0.01)  # until Python has run the handler


def swallow():
    """Press Ctrl-C where nobody can catch what it raises: in a callback from C."""
    ctypes.CFUNCTYPE(None)(press)()


def test_an_interruption_that_nobody_could_catch_is_raised_where_it_is_asked_for(capsys):
    with pytest.raises(KeyboardInterrupt), remembered():
        swallow()
        raise_lost()
    assert capsys.readouterr().err == ""  # no "Exception ignored in"
    raise_lost()  # it is dealt with


def test_an_interruption_is_raised_at_once_where_it_can_be():
    reached = []
    with pytest.raises(KeyboardInterrupt), remembered():
        press()
        reached.append(1)
    assert not reached


def test_a_held_block_is_done_as_a_whole():
    done = []
    with pytest.raises(Terminated), remembered(terminate=True):
        with held():
            with held():
                press(signal.SIGTERM)
            done.append(1)
        done.append(2)
    assert done == [1]


def test_handlers_of_others_and_ignored_signals_are_left_alone():
    heard = []
    before = signal.signal(signal.SIGINT, lambda number, frame: heard.append(number))
    try:
        with remembered():
            press()
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        with remembered():
            press()
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
    assert heard == [signal.SIGINT]


def test_the_handlers_are_as_before_afterwards_and_other_threads_have_none():
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with remembered(terminate=True), remembered():
        assert signal.getsignal(signal.SIGTERM) is not before[1]
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before

    def body():
        with remembered():
            seen.append(signal.getsignal(signal.SIGINT))

    seen = []
    thread = threading.Thread(target=body)
    thread.start()
    thread.join()
    assert seen == [before[0]]


def pressing(at, how):
    """The stub, in which `how` happens in an update."""

    def learn(task_options, options, seed, spent, start=None):
        for found in stub(task_options, options, seed, spent, start):
            if found[0].update == at:
                how()
            yield found

    return learn


@pytest.fixture
def learner(monkeypatch):
    """Puts another generator behind the stub."""

    def put(learn):
        monkeypatch.setattr("baselines.training.runs.generator_of", lambda name: learn)

    return put


@pytest.mark.parametrize("how", [press, swallow])
def test_a_training_ends_at_ctrl_c_even_where_it_is_written_off(tmp_path, learner, how):
    learner(pressing(3, how))
    with pytest.raises(KeyboardInterrupt):
        train(HELIX, "stub", steps=5000, out=tmp_path / "run")
    load_checkpoint(tmp_path / "run")
    load_checkpoint(tmp_path / "run" / "last")


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)], ids=["Ctrl-C", "SIGTERM"]
)
def test_both_signals_save_the_run_and_end_with_the_code_of_the_shell(
    tmp_path, capsys, learner, number, code
):
    learner(pressing(3, lambda: press(number)))
    arguments = ["train", HELIX, "stub", "--steps", "5000", "--out", str(tmp_path / "run")]
    assert main(arguments) == code
    said = capsys.readouterr().err
    assert "the policy is saved. Resume with" in said and "Traceback" not in said
    learner(stub)
    assert main([*arguments, "--resume"]) == 0


def test_an_interrupted_evaluation_says_how_to_go_on(tmp_path, capsys, monkeypatch):
    from baselines.report import benchmark

    arguments = ["evaluate", HELIX, "hover", "--episodes", "2", "--out", str(tmp_path / "run")]
    with monkeypatch.context() as patched:
        patched.setattr(benchmark, "build_report", lambda run: press())
        assert main(arguments) == 130
    out, err = capsys.readouterr()
    assert out == "" and "the same command goes on with it" in err
    assert main(arguments) == 0
    assert "2 flights from seed 0" in capsys.readouterr().out


def test_a_run_that_ended_before_its_first_policy_begins_anew(tmp_path, capsys, learner):
    learner(pressing(1, press))
    arguments = ["train", HELIX, "stub", "--steps", "500", "--out", str(tmp_path / "run")]
    assert main(arguments) == 130
    assert "interrupted before the first policy" in capsys.readouterr().err
    learner(stub)
    assert main([*arguments, "--resume"]) == 0  # there is nothing that --fresh would discard


def test_a_policy_that_was_judged_is_saved_before_the_run_ends(tmp_path, monkeypatch):
    from baselines.training import run_folder

    save = run_folder.RunFolder.save_best

    def save_slowly(self, network, about):
        press()
        save(self, network, about)

    monkeypatch.setattr(run_folder.RunFolder, "save_best", save_slowly)
    with pytest.raises(KeyboardInterrupt):
        train(HELIX, "stub", steps=5000, out=tmp_path / "run")
    assert len((tmp_path / "run" / "curve.csv").read_text().splitlines()) == 2
    load_checkpoint(tmp_path / "run" / "last")


def test_commands_end_with_one_line_at_each_signal(capsys, monkeypatch):
    for number, code in ((signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)):
        monkeypatch.setitem(
            COMMANDS, "list", COMMANDS["list"]._replace(run=lambda options, number=number: press(number))
        )
        assert main(["list"]) == code
        assert capsys.readouterr() == ("", "quad-envs: interrupted\n")


def test_the_codes_are_those_of_the_shell():
    assert exit_code(KeyboardInterrupt()) == 128 + signal.SIGINT
    assert exit_code(Terminated()) == 128 + signal.SIGTERM
    assert exit_code(HungUp()) == 128 + signal.SIGHUP


def children(process):
    """Processes whose parent is this one."""
    with open(f"/proc/{process.pid}/task/{process.pid}/children") as file:
        return [int(number) for number in file.read().split()]


def alive(number):
    try:
        with open(f"/proc/{number}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def nobody_is_left(workers):
    """Whether these processes end soon."""
    assert workers
    for _ in range(100):
        if not any(map(alive, workers)):
            return True
        time.sleep(0.1)
    return False


LONG = 'envs = ["quad/HelixTracking-v0"]\npolicies = ["random", "hover", "lqr"]\nepisodes = 2000\n'


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
def test_no_process_stays_behind_a_sweep_that_was_ended(tmp_path, number, code):
    suite, out = tmp_path / "long.toml", tmp_path / "run"
    suite.write_text(LONG)
    with start_command("benchmark", suite, "--out", out, "--jobs", "2") as process:
        while not list(out.glob("cells/*.json")) and process.poll() is None:
            time.sleep(0.05)
        workers = children(process)
        process.send_signal(number)
        printed, said = process.communicate(timeout=60)
    assert process.returncode == code and printed == "" and "Resume with" in said
    assert nobody_is_left(workers)


@pytest.mark.slow
def test_a_sweep_ends_with_its_terminal(tmp_path):
    """The terminal is closed: what would be said to it is another error, and nobody is to stay behind."""
    suite, out = tmp_path / "long.toml", tmp_path / "run"
    suite.write_text(LONG)
    terminal, end = os.openpty()

    def sit_at_it():
        os.setsid()
        fcntl.ioctl(end, termios.TIOCSCTTY, 0)

    process = subprocess.Popen(
        [sys.executable, "-m", "baselines", "benchmark", str(suite), "--out", str(out), "--jobs", "2"],
        stdin=end,
        stdout=end,
        stderr=end,
        preexec_fn=sit_at_it,
    )
    os.close(end)
    os.set_blocking(terminal, False)
    while not list(out.glob("cells/*.json")) and process.poll() is None:
        time.sleep(0.05)
        with suppress(BlockingIOError):
            os.read(terminal, 100_000)
    workers = children(process)
    os.close(terminal)
    assert process.wait(timeout=60) == 129
    assert nobody_is_left(workers)
