"""Commands that die at any moment and are called again leave what they would have left undisturbed."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
from stub_training import stubs  # noqa: F401

import baselines.training.tuning as tuning
from baselines import train, tune
from baselines.policies.checkpoints import DESCRIPTION, WEIGHTS, load_checkpoint
from benchmarks.trust.kills import JOBS, essence, kills

HELIX = "quad/HelixTracking-v0"
SHORT = {"time_limit": 1.0}  # 20 steps
GENERATION = 4 * tuning.FLIGHTS


class Leaves(Exception):
    """What a dying process raises in these tests, where it must not end the tests."""


def die_at(monkeypatch, module, name, call):
    """Let a function of a module raise instead of its so-manieth call."""
    real, calls = getattr(module, name), itertools.count()

    def counted(*arguments, **options):
        if next(calls) == call:
            raise Leaves
        return real(*arguments, **options)

    monkeypatch.setattr(module, name, counted)


@pytest.mark.parametrize("call", range(1, 5))
def test_a_search_that_died_between_its_files_goes_on_bit_for_bit(tmp_path, monkeypatch, call):
    few = {"fields": ("R",), "env_kwargs": SHORT, "episodes": 3 * GENERATION}
    undisturbed = tune(HELIX, "lmpc", out=tmp_path / "a", **few)
    with monkeypatch.context() as patched, pytest.raises(Leaves):
        die_at(patched, tuning, "write_csv" if call % 2 else "write_json", call)
        tune(HELIX, "lmpc", out=tmp_path / "b", **few)
    found = tune(HELIX, "lmpc", out=tmp_path / "b", resume=True, **few)
    assert found.options == undisturbed.options
    assert essence(tmp_path / "a") == essence(tmp_path / "b")


def test_a_search_that_ended_before_its_first_candidate_begins_anew(tmp_path, monkeypatch):
    few = {"fields": ("R",), "env_kwargs": SHORT, "episodes": GENERATION}
    with monkeypatch.context() as patched, pytest.raises(Leaves):
        die_at(patched, tuning, "write_json", 1)  # the first is config.json
        tune(HELIX, "lmpc", out=tmp_path / "a", **few)
    assert len(tune(HELIX, "lmpc", out=tmp_path / "a", resume=True, **few).curve) == 2


def training(out, **changes):
    return train(HELIX, "stub", out=out, **{"steps": 1000, "env_kwargs": SHORT, **changes})


def test_a_session_that_died_between_last_and_best_is_made_whole(tmp_path, monkeypatch):
    from baselines.training import run_folder

    def die(*arguments):
        raise Leaves

    with monkeypatch.context() as patched, pytest.raises(Leaves):
        patched.setattr(run_folder.RunFolder, "save_best", die)
        training(tmp_path)
    assert not (tmp_path / WEIGHTS).exists() and not (tmp_path / "curve.csv").exists()
    found = training(tmp_path, resume=True)
    _, best = load_checkpoint(tmp_path)
    assert best["score"] == max(point.score for point in found.curve)
    updates = [point.updates for point in found.curve]
    assert updates == sorted(set(updates)) and updates[0] == 1


@pytest.mark.parametrize("name", [WEIGHTS, DESCRIPTION, "curve.csv", "config.json"])
def test_a_training_that_was_being_discarded_is_not_gone_on_with(tmp_path, monkeypatch, name):
    training(tmp_path)
    real = Path.unlink

    def unlink(path, missing_ok=False):
        if path == tmp_path / name:
            raise Leaves
        real(path, missing_ok)

    with monkeypatch.context() as patched, pytest.raises(Leaves):
        patched.setattr(Path, "unlink", unlink)
        training(tmp_path, fresh=True)
    training(tmp_path, resume=True)
    _, said = load_checkpoint(tmp_path / "last")
    assert said["resumed"] == 0


@pytest.mark.slow
def test_what_was_killed_goes_on_to_what_an_undisturbed_run_gives():
    pytest.importorskip("torch", reason="dagger trains with it")
    found = list(itertools.islice(kills(seed=1), 4 * len(JOBS)))
    assert [line for one in found for line in one.wrong] == []
