"""Nonsense of many kinds, drawn from a fixed seed: every failure is an error of ours, on one short line."""

from __future__ import annotations

import datetime
import math
import random
import re

import gymnasium as gym
import numpy as np
import pytest

from baselines.__main__ import COMMANDS, main
from baselines.cli.values import read_value
from baselines.policies.registry import TEAM_POLICIES, TRACKING_POLICIES, make_policy, policy_options
from baselines.sweeps.suite_files import suite_from_dict
from quad_envs import cooperative_estimation_v0, formation_v0, target_tracking_v0

LONGEST = 2100  # characters of a line that the command line prints
TEAM_MODULES = (formation_v0, target_tracking_v0, cooperative_estimation_v0)
SCALARS = [
    *(0, 1, -1, 2, 10**6, 10**60, -(10**60), True, False, None, 0.5, -0.5, 1e-300, 1e300, 1e39),
    *(math.nan, math.inf, -math.inf, 2.5, "", "x", "reference", "helix", "auto", "x" * 10_000, b"x", 1j),
    *(datetime.date(1979, 5, 27), object, np.float32(1.0), np.int64(7), np.bool_(True), {1, 2}),
]


def nonsense(rng, depth=0):
    """A value of any kind."""
    kind = rng.randrange(10 if depth < 3 else 6)
    if kind < 6:
        return rng.choice(SCALARS)
    if kind == 6:
        return {rng.choice(["kind", "x", "mass", "t", "force"]): nonsense(rng, depth + 1) for _ in range(2)}
    entries = [nonsense(rng, depth + 1) for _ in range(rng.choice([0, 1, 2, 3, 3, 4, 12]))]
    return entries if kind == 7 else tuple(entries) if kind == 8 else [[0.5, 1.0, -2.0]] * len(entries)


def flies(env):
    """What was accepted begins and moves without a complaint, and is seen in finite numbers."""
    observation, _ = env.reset(seed=0)
    first = observation if isinstance(observation, np.ndarray) else np.stack(list(observation.values()))
    assert np.isfinite(first).all()
    if isinstance(observation, np.ndarray):
        moved = env.step(np.zeros(env.action_space.shape, np.float32))[0]
    else:
        space = env.action_space(env.agents[0])
        moved = env.step({name: np.zeros(space.shape, np.float32) for name in env.agents})[0]
        moved = np.stack(list(moved.values()))
    assert np.isfinite(moved).all()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("team", [None, *TEAM_MODULES])
def test_options_of_environments_are_flown_or_refused_in_a_line(team):
    rng = random.Random(0 if team is None else TEAM_MODULES.index(team) + 1)
    make = (
        (lambda **kwargs: gym.make("quad/HelixTracking-v0", **kwargs)) if team is None else team.parallel_env
    )
    kind = (
        gym.make("quad/HelixTracking-v0").unwrapped._batch.options
        if team is None
        else team.raw_env.options_type
    )
    names = [*(name for name in kind.__dataclass_fields__ if name != "env_id"), "render_mode", "render_size"]
    accepted = 0
    for _ in range(400 if team is None else 150):
        kwargs = {rng.choice(names): nonsense(rng) for _ in range(rng.choice([1, 1, 2]))}
        if kwargs.get("render_mode") is not None and isinstance(kwargs["render_mode"], str):
            continue  # a word is another test's
        try:
            env = make(**kwargs)
        except ValueError as error:
            assert 0 < len(str(error)) < LONGEST, kwargs
            continue
        except TypeError as error:
            # Of an unknown name, and Gymnasium's own of a number of steps.
            assert re.match("unexpected keyword|Expect the `max_episode_steps`", str(error)), kwargs
            continue
        except FileNotFoundError:
            continue
        accepted += 1
        flies(env)
    assert accepted >= 3


@pytest.mark.filterwarnings("ignore")
def test_options_of_policies_are_taken_or_refused_in_a_line():
    rng = random.Random(4)
    team = {
        "formation": formation_v0.parallel_env(vehicles=3, formation="triangle"),
        "target-tracking": target_tracking_v0.parallel_env(),
        "estimation": cooperative_estimation_v0.parallel_env(),
        "tracking": gym.make("quad/HelixTracking-v0"),
    }
    for name, entry in {**TEAM_POLICIES, **TRACKING_POLICIES}.items():
        options = list(policy_options(name)) or ["x"]
        for _ in range(25):
            kwargs = {rng.choice(options): nonsense(rng)}
            try:
                make_policy(name, team[entry.missions[0]], **kwargs)
            except ValueError as error:
                assert 0 < len(str(error)), (name, kwargs)


def command(rng):
    """Arguments that are right to a part."""
    text = lambda: rng.choice(  # noqa: E731
        [
            *(
                "x",
                "",
                "-",
                "--",
                "=",
                "{",
                "[1,",
                "{a: 1, a: 2}",
                "true",
                "NaN",
                "1e400",
                "-1",
                "0",
                "1979-05-27",
            ),
            *(
                "[" * 3000 + "]" * 3000,
                "x" * 100_000,
                "9" * 5000,
                "\udcff",
                "\n",
                "\0",
                "{kind: helix}",
                "b'x'",
            ),
            *("quad/HelixTracking-v0", "hover", "lmpc", "no/such/folder", "/dev/null", "kappa=0.3", "mass"),
        ]
    )
    flags = [
        "--set",
        "--policy-set",
        "--hyper",
        "--seed",
        "--starts",
        "--seconds",
        "--steps",
        "--from",
        "--engine",
    ]
    options = rng.choice(
        ["kappa", "preview", "reference", "start", "render_mode", "vehicle", "randomize", "id"]
    )
    head = rng.choice([[], ["evaluate", "quad/HelixTracking-v0", "hover"], [rng.choice(list(COMMANDS))]])
    tail = [rng.choice(flags), rng.choice([text(), f"{options}={text()}"])]
    return [
        *head,
        *(text() for _ in range(rng.choice([0, 0, 1]))),
        *tail,
        "--episodes",
        rng.choice(["0", text()]),
    ]


@pytest.mark.filterwarnings("ignore")
def test_commands_that_make_no_sense_end_with_one_line(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = random.Random(5)
    for _ in range(250):
        arguments = command(rng)
        try:
            code = main(arguments)
        except SystemExit as end:
            code = end.code
        out, err = capsys.readouterr()
        shown = [one[:60] for one in arguments]
        assert code == 2 and out == "", shown
        assert err.count("\n") == 1 and len(err) < LONGEST + 100 and "Traceback" not in err, (
            shown,
            err[:300],
        )
    assert not list(tmp_path.iterdir())


def test_texts_are_read_or_refused_with_the_place():
    rng = random.Random(6)
    for _ in range(3000):
        text = "".join(rng.choice("{}[]:=,'\" ab1.-\\") for _ in range(rng.randrange(30)))
        try:
            read_value(text)
        except ValueError as error:
            assert 0 < len(str(error)) < 200, text


@pytest.mark.filterwarnings("ignore")
def test_suites_are_made_or_refused_in_a_line():
    rng = random.Random(7)
    right = {"envs": ["quad/HelixTracking-v0"], "policies": ["hover"], "episodes": 1}
    keys = [
        "name",
        "envs",
        "policies",
        "episodes",
        "seed",
        "compare_with",
        "conditions",
        "description",
        "nam",
    ]
    tables = {
        "envs": ("id", ["id", "kwargs", "label"]),
        "policies": ("name", ["name", "kwargs", "label", "envs", "train", "shipped"]),
        "conditions": ("label", ["label", "kwargs", "envs"]),
    }
    for _ in range(1500):
        data = dict(right)
        if rng.random() < 0.5:
            data[rng.choice(keys)] = nonsense(rng)
        else:
            which = rng.choice(list(tables))
            key, known = tables[which]
            data[which] = [{key: {"id": "quad/HelixTracking-v0", "name": "ppo"}.get(key, "a")}]
            data[which][0][rng.choice(known)] = nonsense(rng)
        try:
            suite_from_dict(data)
        except ValueError as error:
            assert 0 < len(str(error)), data
