"""A reproduction in a folder goes on where it stopped, and takes nothing back."""

import json
import math

import pytest

import baselines.reproduction as package
from baselines import ResultsError, run_benchmark
from baselines.__main__ import main
from baselines.files import locked
from baselines.reproduction import page, run, store
from baselines.reproduction.results import Cell, Claim, Measured, Section

CLAIM = Claim("4-a", "It <holds>.", "HOLDS", {"n": math.nan, "by": {"lmpc": 1.5, "word": "yes"}}, own=True)
MADE = {
    "table-4.1": Section("table-4.1", "A table", [Cell("helix", "RMS, m", 0.5, 0.25)], [], fitted="chosen"),
    "claims-5": Section("claims-5", "Claims", [Measured("line", "lag, m", 1.0, math.inf)], [CLAIM]),
}


@pytest.fixture
def made(monkeypatch):
    """Names of the sections that are made."""
    names = []

    def maker(name):
        return lambda jobs: names.append(name) or MADE[name]

    for name in MADE:
        monkeypatch.setitem(package.SECTIONS, name, maker(name))
    return names


def test_a_section_is_read_back_as_it_was(tmp_path):
    kept = store.Store(tmp_path, package.ORDER, fresh=False)
    for section in MADE.values():
        kept.keep(section)
    assert repr(kept.found()) == repr(list(MADE.values()))  # as nan != nan


def test_a_later_run_adds_to_what_is_there_and_flies_nothing_twice(tmp_path, made, capsys):
    assert run(["claims-5"], tmp_path, False, 1) == 0
    assert run(["table-4.1"], tmp_path, False, 1) == 0
    assert run(["table-4.1", "claims-5"], tmp_path, True, 1) == 0
    assert made == ["claims-5", "table-4.1"]
    told = json.loads((tmp_path / "reproduce.json").read_text())["sections"]
    assert [section["name"] for section in told] == ["table-4.1", "claims-5"]
    assert "It &lt;holds&gt;." in (tmp_path / page.NAME).read_text()
    assert run(["claims-5"], tmp_path, False, 1, fresh=True) == 0
    assert made == ["claims-5", "table-4.1", "claims-5"]
    assert len(json.loads((tmp_path / "reproduce.json").read_text())["sections"]) == 1


def test_an_interrupted_run_goes_on(tmp_path, made, monkeypatch):
    real = package.SECTIONS["claims-5"]

    def stop(jobs):
        raise KeyboardInterrupt

    monkeypatch.setitem(package.SECTIONS, "claims-5", stop)
    with pytest.raises(KeyboardInterrupt):
        run(["table-4.1", "claims-5"], tmp_path, False, 1)
    assert "interrupted: claims-5" in (tmp_path / page.NAME).read_text()
    monkeypatch.setitem(package.SECTIONS, "claims-5", real)
    run(["table-4.1", "claims-5"], tmp_path, False, 1)
    assert made == ["table-4.1", "claims-5"] and "interrupted" not in (tmp_path / page.NAME).read_text()


def test_what_is_not_ours_is_left_alone(tmp_path, made):
    (tmp_path / "a").mkdir()
    (tmp_path / "a/reproduce.json").write_text("mine")
    with pytest.raises(ResultsError, match=r"holds a reproduce\.json that no reproduction"):
        run(["claims-5"], tmp_path / "a", False, 1, fresh=True)
    assert (tmp_path / "a/reproduce.json").read_text() == "mine"
    suite = {"name": "s", "envs": ["quad/HelixTracking-v0"], "policies": ["hover"], "episodes": 1}
    run_benchmark(suite, tmp_path / "b")
    assert main(["reproduce", "claims-5", "--out", str(tmp_path / "b")]) == 2
    with locked(tmp_path / "c"), pytest.raises(ResultsError, match="in use by process"):
        run(["claims-5"], tmp_path / "c", False, 1)
    assert not made


def test_sections_of_other_sources_are_not_mixed(tmp_path, made, monkeypatch):
    run(["claims-5"], tmp_path, False, 1)
    real = store.provenance()
    monkeypatch.setattr(store, "provenance", lambda: real | {"source": "another"})
    with pytest.raises(ResultsError, match="that other sources gave"):
        run(["table-4.1"], tmp_path, False, 1)
    run(["table-4.1"], tmp_path, False, 1, fresh=True)
    assert made == ["claims-5", "table-4.1"]


def test_a_damaged_section_is_named(tmp_path, made):
    run(["claims-5"], tmp_path, False, 1)
    (tmp_path / "sections/claims-5.json").write_text("{}")
    with pytest.raises(ResultsError, match=r"claims-5\.json' is no section .* delete it"):
        run(["claims-5"], tmp_path, False, 1)
    with pytest.raises(ValueError, match="--fresh needs a folder"):
        run([], None, False, 1, fresh=True)
