"""Nonsense for every public entry: what is not refused on one short line of ours is wrong, or works.

Each try draws its nonsense from a seed. Entries are the options of environments and policies, commands,
texts, suites, and the signatures of what `baselines` and `quad_envs` export, and of options of controllers.
"""

from __future__ import annotations

import datetime
import inspect
import io
import math
import os
import random
import re
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import fields
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import baselines
import controllers
import quad_envs
from baselines.__main__ import COMMANDS, main
from baselines.cli.values import read_value
from baselines.policies.registry import TEAM_POLICIES, TRACKING_POLICIES, make_policy, policy_options
from baselines.sweeps.suite_files import suite_from_dict
from quad_envs import cooperative_estimation_v0, formation_v0, target_tracking_v0
from quad_envs.envs.tracking.options import TrackingOptions

from . import drawn
from .found import Found, tried

LONGEST = 2100  # characters of a line that the command line prints
HELIX = "quad/HelixTracking-v0"
TEAM_MODULES: tuple[Any, ...] = (formation_v0, target_tracking_v0, cooperative_estimation_v0)
SCALARS = [
    *(0, 1, -1, 2, 10**6, 10**60, -(10**60), True, False, None, 0.5, -0.5, 1e-300, 1e300, 1e39),
    *(math.nan, math.inf, -math.inf, 2.5, "", "x", "reference", "helix", "auto", "x" * 10_000, b"x", 1j),
    *(datetime.date(1979, 5, 27), object, np.float32(1.0), np.int64(7), np.bool_(True), {1, 2}),
]
_WORDS = (
    *("x", "", "-", "--", "=", "{", "[1,", "{a: 1, a: 2}", "true", "NaN", "1e400", "-1", "0", "1979-05-27"),
    *("[" * 3000 + "]" * 3000, "x" * 100_000, "9" * 5000, "\udcff", "\n", "\0", "{kind: helix}", "b'x'"),
    *(HELIX, "hover", "lmpc", "no/such/folder", "/dev/null", "kappa=0.3", "mass"),
)
_FLAGS = (
    "--set",
    "--policy-set",
    "--hyper",
    "--seed",
    "--starts",
    "--seconds",
    "--steps",
    "--from",
    "--engine",
)
_OPTIONS = ("kappa", "preview", "reference", "start", "render_mode", "vehicle", "randomize", "id")
_SUITE_KEYS = (
    *("name", "envs", "policies", "episodes", "seed", "compare_with", "conditions", "description", "nam"),
)
_SUITE_TABLES = {
    "envs": ("id", ["id", "kwargs", "label"]),
    "policies": ("name", ["name", "kwargs", "label", "envs", "train", "shipped"]),
    "conditions": ("label", ["label", "kwargs", "envs"]),
}


def nonsense(rng: random.Random, depth: int = 0) -> Any:
    """A value of any kind."""
    kind = rng.randrange(10 if depth < 3 else 6)
    if kind < 6:
        return rng.choice(SCALARS)
    if kind == 6:
        return {rng.choice(["kind", "x", "mass", "t", "force"]): nonsense(rng, depth + 1) for _ in range(2)}
    entries = [nonsense(rng, depth + 1) for _ in range(rng.choice([0, 1, 2, 3, 3, 4, 12]))]
    return entries if kind == 7 else tuple(entries) if kind == 8 else [[0.5, 1.0, -2.0]] * len(entries)


def flies(env: Any) -> str:
    """What is wrong with an environment that was accepted: it begins and moves, seen in finite numbers."""
    first = drawn.reset(env, 0)
    moved = drawn.step(env, np.random.default_rng(0)).observations
    return "" if np.isfinite(first).all() and np.isfinite(moved).all() else "what is seen is not finite"


def environment(rng: random.Random, team: Any = None) -> str | None:
    """Options of environments; None if they were flown, else what is wrong with how they were refused."""
    made: Callable[..., Any]
    if team is None:
        made, options = partial(gymnasium.make, HELIX), TrackingOptions
    else:
        made, options = team.parallel_env, team.raw_env.options_type
    names = [*(one.name for one in fields(options) if one.name != "env_id"), "render_mode", "render_size"]
    kwargs = {rng.choice(names): nonsense(rng) for _ in range(rng.choice([1, 1, 2]))}
    if isinstance(kwargs.get("render_mode"), str):
        return ""  # a word is another test's
    try:
        env = made(**kwargs)
    except ValueError as error:
        return "" if 0 < len(str(error)) < LONGEST else f"{kwargs}: a message of {len(str(error))} characters"
    except TypeError as error:
        # Of an unknown name, and Gymnasium's own of a number of steps.
        known = re.match("unexpected keyword|Expect the `max_episode_steps`", str(error))
        return "" if known else f"{kwargs}: {error}"
    except FileNotFoundError:
        return ""
    wrong = flies(env)
    return f"{kwargs}: {wrong}" if wrong else None


def policy(rng: random.Random, envs: dict[str, Any]) -> str:
    """An option of a policy."""
    table = rng.choice([TEAM_POLICIES, TRACKING_POLICIES])
    name = rng.choice(list(table))
    kwargs = {rng.choice(list(policy_options(name)) or ["x"]): nonsense(rng)}
    try:
        make_policy(name, envs[table[name].missions[0]], **kwargs)
    except ValueError as error:
        return "" if str(error) else f"{name} {kwargs}: an error without words"
    return ""


def environments() -> dict[str, Any]:
    """One of each mission."""
    return {
        "formation": formation_v0.parallel_env(vehicles=3, formation="triangle"),
        "target-tracking": target_tracking_v0.parallel_env(),
        "estimation": cooperative_estimation_v0.parallel_env(),
        "tracking": gymnasium.make(HELIX),
    }


def arguments(rng: random.Random) -> list[str]:
    """Arguments of a command that are right to a part."""
    head: list[str] = rng.choice([[], ["evaluate", HELIX, "hover"], [rng.choice(list(COMMANDS))]])
    tail = [
        rng.choice(_FLAGS),
        rng.choice([rng.choice(_WORDS), f"{rng.choice(_OPTIONS)}={rng.choice(_WORDS)}"]),
    ]
    more = [rng.choice(_WORDS) for _ in range(rng.choice([0, 0, 1]))]
    return [*head, *more, *tail, "--episodes", rng.choice(["0", rng.choice(_WORDS)])]


def command(rng: random.Random) -> str:
    """A command that makes no sense ends with one line and code 2, and leaves nothing here."""
    given, out, err = arguments(rng), io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            code: Any = main(given)
        except SystemExit as end:
            code = end.code
    shown, said = [one[:60] for one in given], err.getvalue()
    if code != 2 or out.getvalue():
        return f"{shown}: code {code}"
    if said.count("\n") != 1 or len(said) >= LONGEST + 100 or "Traceback" in said:
        return f"{shown}: {said[:300]}"
    left = list(Path().iterdir())
    return f"{shown}: leaves {left[0]}" if left else ""


def text(rng: random.Random) -> str:
    """A text of the command line is read, or refused with the place."""
    given = "".join(rng.choice("{}[]:=,'\" ab1.-\\") for _ in range(rng.randrange(30)))
    try:
        read_value(given)
    except ValueError as error:
        return "" if 0 < len(str(error)) < 200 else f"{given!r}: a message of {len(str(error))} characters"
    return ""


def suite(rng: random.Random) -> str:
    """A suite is made, or refused in a line."""
    data: dict[str, Any] = {"envs": [HELIX], "policies": ["hover"], "episodes": 1}
    if rng.random() < 0.5:
        data[rng.choice(_SUITE_KEYS)] = nonsense(rng)
    else:
        which = rng.choice(list(_SUITE_TABLES))
        key, known = _SUITE_TABLES[which]
        data[which] = [{key: {"id": HELIX, "name": "ppo"}.get(key, "a")}]
        data[which][0][rng.choice(known)] = nonsense(rng)
    try:
        suite_from_dict(data)
    except ValueError as error:
        return "" if str(error) else f"{data}: an error without words"
    return ""


_SHORT = {"time_limit": 0.5}
_RIGHT: dict[str, dict[str, Any]] = {  # arguments with which entries work
    "evaluate": {"policy": "hover", "env": HELIX, "episodes": 1},
    "run_benchmark": {
        "suite": {"envs": [{"id": HELIX, "kwargs": _SHORT}], "policies": ["hover"], "episodes": 1}
    },
    "train": {"env_id": HELIX, "algorithm": "dagger", "steps": 100, "out": "out", "env_kwargs": _SHORT},
    "tune": {
        "env_id": HELIX,
        "policy": "lmpc",
        "episodes": 32,
        "fields": ("R",),
        "out": "out",
        "env_kwargs": _SHORT,
    },
    "make_policy": {"name": "hover", "env": HELIX},
    "check_policy": {"policy": "hover", "env": HELIX},
    "load_policy": {},
    "export_policy": {"source": "none", "folder": "out"},
    "safe": {},
}
_HOOKS = (
    "watcher",
    "on_episode",
    "on_unit",
    "algorithm",
    "networks",
    "engine",
    "jobs",
)  # other people's code


def entries() -> dict[str, Callable[..., Any]]:
    """What is exported and can be called with plain values."""
    found = {name: getattr(baselines, name) for name in _RIGHT}
    for module in (quad_envs, controllers):
        for name in dir(module):
            entry = getattr(module, name)
            ours = module is quad_envs or name.endswith("Options")  # others take tasks, models and arrays
            if ours and not name.startswith("_") and callable(entry) and _is_plain(entry):
                found[f"{module.__name__}.{name}"] = entry
    return found


def _is_plain(entry: Any) -> bool:
    """Whether it takes values, and is neither a protocol nor an array's view."""
    if getattr(entry, "_is_protocol", False) or (inspect.isclass(entry) and issubclass(entry, tuple)):
        return False
    try:
        inspect.signature(entry)
    except (TypeError, ValueError):
        return False
    return True


def call(rng: random.Random, entry: Callable[..., Any], right: dict[str, Any]) -> str:
    """One argument, or two, of an entry are nonsense; the others are right, or their defaults."""
    names = [
        parameter.name
        for parameter in inspect.signature(entry).parameters.values()
        if parameter.kind not in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL)
        and parameter.name not in _HOOKS
    ]
    missing = [
        parameter.name
        for parameter in inspect.signature(entry).parameters.values()
        if parameter.default is parameter.empty and parameter.name in names and parameter.name not in right
    ]
    chosen = dict.fromkeys([*missing, *(rng.choice(names) for _ in range(rng.choice([1, 1, 2])) if names)])
    given = right | {name: nonsense(rng) for name in chosen}
    told = {name: repr(given[name])[:80] for name in chosen}
    before = set(Path().rglob("*"))
    try:
        entry(**given)
    except (ValueError, TypeError, OSError, baselines.TrainingError) as error:
        if isinstance(error, OSError) and error.filename is None:
            raise
        said = str(error)
        for value in given.values():  # a long text may be said
            said = said.replace(value, "") if isinstance(value, str) and value else said
        if not 0 < len(said) < LONGEST:
            return f"{told}: a message of {len(said)} characters"
        if isinstance(error, TypeError) and not re.search("|".join(map(re.escape, names)), said):
            return f"{told}: {error}"
        half = [path for path in set(Path().rglob("*")) - before if path.is_file() and path.name != ".lock"]
        return f"{told}: refused, and leaves {half[0]}" if half else ""
    return ""


def inputs(seed: int) -> Iterator[Found]:
    """Nonsense without end, for each kind of entry in turn."""
    home = os.getcwd()
    with tempfile.TemporaryDirectory() as place, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        envs, every = environments(), list(entries().items())
        os.chdir(place)
        try:
            for k in count():
                rng = random.Random(f"{seed} {k}")
                name, entry = every[k // 6 % len(every)]
                kinds: list[tuple[str, Callable[[], str | None]]] = [
                    ("environment", lambda rng=rng: environment(rng, rng.choice([None, *TEAM_MODULES]))),
                    ("policy", lambda rng=rng: policy(rng, envs)),
                    ("command", lambda rng=rng: command(rng)),
                    ("text", lambda rng=rng: text(rng)),
                    ("suite", lambda rng=rng: suite(rng)),
                    (name, lambda rng=rng, name=name, entry=entry: call(rng, entry, _RIGHT.get(name, {}))),
                ]
                yield tried(*kinds[k % len(kinds)])
                for path in Path().iterdir():
                    _remove(path)
        finally:
            os.chdir(home)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink()
