"""What the commands `list`, `evaluate` and `benchmark` do."""

from __future__ import annotations

import json
import os
import shlex
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from quad_envs.arguments.names import shortened, shown, unknown_name

from ..interruptions import exit_code, raise_lost
from .options import BenchmarkOptions, EvaluateOptions, ListOptions, read_assignments

_FAILED = 1  # a policy from outside broke off

# What the multi-agent environments are, for `list`, which loads none of them.
TEAM_KINDS = {
    "quad/Formation-v0": "formation: quadrotors take and keep their slots behind a leader",
    "quad/TargetTracking-v0": "target-tracking: quadrotors keep their slots beside a target they measure",
    "quad/CooperativeEstimation-v0": "estimation: vehicles on rails estimate the motion of a target",
}


def say(text: str) -> None:
    """A line for the person at the terminal; results alone go to stdout."""
    print(text, file=sys.stderr, flush=True)


@contextmanager
def progress(total: int, unit: str) -> Iterator[Any]:
    """A progress bar on a terminal, nothing in a pipe."""
    from tqdm import tqdm

    with tqdm(total=total, unit=unit, file=sys.stderr, disable=None, leave=False) as bar:
        yield bar


@contextmanager
def plain_warnings() -> Iterator[None]:
    """Print what an environment warns of as one line on stderr, each text once."""
    said: set[str] = set()

    def show(message: Warning | str, *details: Any, **more: Any) -> None:
        text = shortened(str(message))
        if text not in said:
            said.add(text)
            say(f"quad-envs: warning: {text}")

    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        # A worker whose memory grew is replaced, and what it had begun is done again: nobody has to know.
        warnings.filterwarnings("ignore", "A worker stopped while some jobs were given", UserWarning)
        warnings.showwarning = show
        yield


def list_names(options: ListOptions) -> int:
    """Print what there is, or the options of one environment, policy or training algorithm."""
    if options.name:
        return _list_options(options)
    shelves = _shelves()
    if options.json:
        print(json.dumps({shelf.key: shelf.entries for shelf in shelves}, indent=1))
        return 0
    for shelf in shelves:
        entries = shelf.entries or ({"-": shelf.if_empty} if shelf.if_empty else {})
        if not entries:
            continue
        print(shelf.title)
        for name, entry in entries.items():
            text = entry if isinstance(entry, str) else ", ".join(f"{k}={v!r}" for k, v in entry.items())
            print(f"  {name:29} {text}")
    print("\nquad-envs list NAME shows the options of an environment, a policy or a training algorithm,")
    print("and what a vehicle, a trained policy or a suite is; quad-envs list columns what tables say")
    print("safe:NAME puts a safety filter in front of any policy for one vehicle")
    return 0


class _Shelf(NamedTuple):
    """Names of one kind."""

    key: str  # in JSON
    title: str
    entries: dict[str, Any]  # name -> what it is, or its options
    if_empty: str = ""


def _shelves() -> list[_Shelf]:
    """All that has a name."""
    from quad_envs.registration import TRACKING
    from quad_envs.vehicles import VEHICLES

    from ..policies.outside import installed_policies
    from ..policies.registry import TEAM_POLICIES, TRACKING_POLICIES
    from ..policies.trained import shipped_policies
    from ..sweeps.suite_files import suite_names
    from ..training.algorithms import ALGORITHMS

    vehicles = {
        name: f"{vehicle.about}, thrust-to-weight {vehicle.thrust_to_weight:.2g} ({vehicle.source})"
        for name, vehicle in VEHICLES.items()
    }
    policies = {name: entry.description for name, entry in TRACKING_POLICIES.items()}
    team = {
        name: f"{entry.description}; for {', '.join(entry.missions)}{' (privileged)' * entry.privileged}"
        for name, entry in TEAM_POLICIES.items()
    }
    algorithms = {
        name: f"{entry.description}; for {', '.join(entry.missions)}" for name, entry in ALGORITHMS.items()
    }
    none_trained = "none; quad-envs train ENV ALGORITHM makes one"
    return [
        _Shelf("environments", "environments of one vehicle (Gymnasium)", TRACKING),
        _Shelf("team_environments", "environments of several vehicles (PettingZoo)", TEAM_KINDS),
        _Shelf("vehicles", "vehicles: --set vehicle=NAME", vehicles),
        _Shelf("policies", "policies for one vehicle", policies),
        _Shelf("team_policies", "policies for several vehicles", team),
        _Shelf("trained_policies", "trained policies", shipped_policies(), none_trained),
        _Shelf("installed_policies", "policies of other packages", installed_policies()),
        _Shelf("algorithms", "training algorithms", algorithms),
        _Shelf("suites", "suites", suite_names()),
    ]


def _list_options(options: ListOptions) -> int:
    from dataclasses import fields

    from quad_envs.arguments.field_comments import field_comments
    from quad_envs.envs.tracking.options import TrackingOptions
    from quad_envs.registration import TEAMS, TRACKING

    from ..policies.outside import installed_policies
    from ..policies.registry import (
        TEAM_POLICIES,
        TRACKING_POLICIES,
        behind_filter,
        from_outside,
        policy_comments,
        policy_options,
    )
    from ..training.algorithms import ALGORITHMS, options_of
    from ..training.hyperparameters import hyperparameters, plain_options

    env_id = options.name.rpartition(":")[-1]
    names = [*TRACKING, *TEAMS, *TRACKING_POLICIES, *TEAM_POLICIES, *installed_policies(), *ALGORITHMS]
    comments: dict[str, str] = {}
    flag = title = ""
    if env_id in (*TRACKING, *TEAMS):
        kind = TrackingOptions
        if env_id in TEAMS:
            kind = import_module(TEAMS[env_id]).raw_env.options_type
        values = {entry.name: entry.default for entry in fields(kind) if entry.init}
        values |= TRACKING.get(env_id, {})
        del values["env_id"]
        flag, comments = "--set", field_comments(kind)
    elif options.name in ALGORITHMS:
        values, flag = plain_options(hyperparameters(options.name, "")), "train --hyper"
        comments = field_comments(options_of(options.name))
    elif options.name in names or behind_filter(options.name) != options.name or from_outside(options.name):
        values, flag = policy_options(options.name), "--policy-set"
        comments = policy_comments(options.name)
    elif ":" in options.name:
        values, flag, comments = _own_env_options(options.name), "--set", field_comments(TrackingOptions)
    else:
        values, title = _without_options(options.name, names)
    if options.json:
        print(json.dumps(values, indent=1, default=str))
        return 0
    print(title or f"options of {options.name} and their defaults; on the command line {flag} KEY=VALUE")
    for name, value in values.items():
        text = comments.get(name, "")
        print(f"  {name:20} {f'{value!r:16} # {text}' if text else repr(value)}")
    return 0


def _own_env_options(name: str) -> dict[str, Any]:
    """Options of an environment of the user's, `module:id`, with the arguments that it is registered with.

    Raises:
        ValueError: If there is none of this name, or it is not one of this suite with other arguments.
    """
    from dataclasses import fields

    from quad_envs.envs.tracking.options import TrackingOptions

    from ..policies.environments import make_env, task_of

    env = make_env(name)
    task_of(env)
    known = {entry.name: entry.default for entry in fields(TrackingOptions) if entry.init}
    values = known | dict(env.unwrapped.spec.kwargs)
    del values["env_id"]
    return values


def _without_options(name: str, known: list[str]) -> tuple[dict[str, Any], str]:
    """What is known of a vehicle, a trained policy, a suite or a column of the tables, and a title.

    Args:
        name: Of it.
        known: What else `list` shows, for the message.

    Raises:
        ValueError: If nothing has this name.
    """
    from quad_envs.vehicles import VEHICLES

    from ..evaluation.columns import COLUMNS
    from ..policies.outside import named_in_file
    from ..policies.trained import describe_folder, describe_shipped, shipped_policies
    from ..sweeps.contenders import CONTENDER_COLUMNS
    from ..sweeps.suite_files import load_suite, suite_names

    if name in VEHICLES:
        return VEHICLES[name].values(), f"values of {name}; on the command line --set vehicle={name}"
    if name in shipped_policies():
        said = describe_shipped(name)
        return said, f"{name} has no options; it flies with quad-envs evaluate {said['env_id']} {name}"
    if name in suite_names():
        suite = load_suite(name)
        titles: dict[str, Any] = {
            "envs": [env.title for env in suite.envs],
            "policies": list(dict.fromkeys(policy.contender for policy in suite.policies)),
            "conditions": [condition.title for condition in suite.conditions],
            "tables": [table.title for table in suite.tables],
        }
        numbers = {"episodes": suite.episodes, "seed": suite.seed}
        values = {key: value for key, value in titles.items() if value} | numbers
        return values, f"quad-envs benchmark {name} flies this"
    columns = COLUMNS | CONTENDER_COLUMNS
    if name == "columns" or name in columns:
        chosen = columns.values() if name == "columns" else [columns[name]]
        others = "the policy that others are compared with"
        said = {one.name: "; ".join(filter(None, (one.unit, *one.notes))) for one in chosen}
        about = {key: text.format(base=others) for key, text in said.items()}
        return about, "columns of the tables, each with its unit and what it says"
    if os.path.isdir(name):
        said = describe_folder(name)
        where = said.get("env_id", "ENV")
        return said, f"{name} has no options; it flies with quad-envs evaluate {where} {shlex.quote(name)}"
    in_file = named_in_file(name)
    if in_file:
        raise ValueError(f"unknown name {shown(name)}; {in_file}")
    every = dict.fromkeys((*known, *VEHICLES, *shipped_policies(), *suite_names()))
    raise ValueError(unknown_name("name", name, every))


def evaluate_one(options: EvaluateOptions) -> int:
    """Fly one policy in one environment and print the numbers."""
    from ..evaluation.evaluate import fly_and_measure
    from ..policies.environments import make_env
    from ..policies.registry import make_policy, policy_name
    from ..policies.unfamiliar import unfamiliar
    from ..report.benchmark import run_benchmark
    from ..sweeps.choices import EnvChoice, PolicyChoice
    from ..sweeps.suite import Suite

    env_kwargs = read_assignments("--set", options.set)
    policy_kwargs = read_assignments("--policy-set", options.policy_set)
    for flag, given in (("--save-episodes", options.save_episodes), ("--fresh", options.fresh)):
        if given and options.out is None:
            raise ValueError(f"{flag} needs a folder: --out FOLDER")
    if options.out is not None:
        choices = (EnvChoice(options.env, env_kwargs),), (PolicyChoice(options.policy, policy_kwargs),)
        suite = Suite("evaluate", *choices, options.episodes, options.seed)
        try:
            with plain_warnings():
                results = run_benchmark(
                    suite, options.out, save_episodes=options.save_episodes, fresh=options.fresh
                )
        except KeyboardInterrupt as interruption:
            say(f"interrupted; what was flown is in {options.out}, and the same command goes on with it")
            return exit_code(interruption)
        found = results.evaluations[0]
        _say_where(options.out)
    else:
        with plain_warnings():
            env = make_env(options.env, **env_kwargs)
        policy = make_policy(options.policy, env, **policy_kwargs)
        with progress(options.episodes, "flight") as bar:
            count = lambda episode: bar.update(episode.seed - options.seed + 1 - bar.n)  # noqa: E731
            found = fly_and_measure(policy, env, options.episodes, options.seed, on_episode=count)
        found = replace(found, policy=policy_name(policy, options.policy))
    for remark in unfamiliar(options.policy, options.env, env_kwargs):
        say(f"note: {remark}")
    print(json.dumps(found.to_dict(), indent=1, allow_nan=False) if options.json else found)
    return 0


def benchmark_suite(options: BenchmarkOptions) -> int:
    """Fly a suite, print its tables, and leave a results folder."""
    from ..report.benchmark import fly_suite
    from ..sweeps.budget import budget_of
    from ..sweeps.choices import PolicyChoice
    from ..sweeps.stages import SweepProgress
    from ..sweeps.suite_files import load_suite
    from ..sweeps.sweep import Order

    suite = load_suite(options.suite)
    changes = {
        name: getattr(options, name) for name in ("episodes", "seed") if getattr(options, name) is not None
    }
    suite = suite.only(options.only) if options.only else suite
    suite = replace(suite.quick() if options.quick else suite, **changes)
    suite = replace(suite, policies=(*suite.policies, *map(PolicyChoice, options.policy)))
    out = options.out or Path("runs") / f"{suite.name}-{datetime.now():%Y%m%d-%H%M%S}"
    finished, watcher = -1, SweepProgress()

    def on_unit(count: int, total: int) -> None:
        nonlocal finished
        if finished < 0 and suite.learned:  # all is checked, and nothing begun
            say(budget_of(suite).said(options.jobs or 1))
        finished = count
        raise_lost()

    order = Order(
        engine=options.engine,
        jobs=options.jobs,
        save_episodes=options.save_episodes,
        fresh=options.fresh,
        networks=options.networks,
        on_unit=on_unit,
        watcher=watcher,
    )
    with plain_warnings():
        try:
            results = fly_suite(suite, {}, out, order)
        except KeyboardInterrupt as interruption:
            said = f"interrupted; what was flown is stored, {max(finished, 0)} units whole"
            say(f"{said}. Resume with: {_resume(options, out)}")
            return exit_code(interruption)
        finally:
            watcher.close()
    print(json.dumps(results.to_dict(), indent=1, allow_nan=False) if options.json else results)
    _say_where(out)
    return _FAILED if results.failures else 0


def _say_where(out: Path) -> None:
    say(f"results in {out}")
    say(f"report: {out / 'report.html'}")


def _resume(options: BenchmarkOptions, out: Path) -> str:
    words = ["quad-envs benchmark", shlex.quote(options.suite), f"--out {shlex.quote(str(out))}"]
    for name in ("episodes", "seed"):
        value = getattr(options, name)
        words += [] if value is None else [f"--{name} {value}"]
    words += [f"--policy {shlex.quote(name)}" for name in options.policy]
    words += [f"--engine {options.engine}"] if options.engine != "processes" else []
    words += [f"--jobs {options.jobs}"] if options.jobs is not None else []
    words += [f"--only {shlex.quote(name)}" for name in options.only]
    words += ["--quick"] if options.quick else []
    words += [f"--networks {shlex.quote(str(options.networks))}"] if options.networks else []
    words += ["--save-episodes"] if options.save_episodes else []
    return " ".join(words)
