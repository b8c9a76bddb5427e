"""Nonsense of many kinds, drawn from a fixed seed: every failure is an error of ours, on one short line."""

from __future__ import annotations

import random

import pytest

from benchmarks.trust import inputs


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("team", [None, *inputs.TEAM_MODULES])
def test_options_of_environments_are_flown_or_refused_in_a_line(team):
    rng = random.Random(0 if team is None else inputs.TEAM_MODULES.index(team) + 1)
    said = [inputs.environment(rng, team) for _ in range(400 if team is None else 150)]
    assert [line for line in said if line] == []
    assert said.count(None) >= 3  # were flown


@pytest.mark.filterwarnings("ignore")
def test_options_of_policies_are_taken_or_refused_in_a_line():
    rng, envs = random.Random(4), inputs.environments()
    assert [line for line in (inputs.policy(rng, envs) for _ in range(400)) if line] == []


@pytest.mark.filterwarnings("ignore")
def test_commands_that_make_no_sense_end_with_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = random.Random(5)
    assert [line for line in (inputs.command(rng) for _ in range(250)) if line] == []


def test_texts_are_read_or_refused_with_the_place():
    rng = random.Random(6)
    assert [line for line in (inputs.text(rng) for _ in range(3000)) if line] == []


@pytest.mark.filterwarnings("ignore")
def test_suites_are_made_or_refused_in_a_line():
    rng = random.Random(7)
    assert [line for line in (inputs.suite(rng) for _ in range(1500)) if line] == []
