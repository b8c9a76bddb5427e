"""`run_benchmark`: environments x policies, in parallel and resumable, to a results folder and tables."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import KW_ONLY, dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

from quad_envs.arguments.checks import require_paths
from quad_envs.arguments.field_comments import called_with
from quad_envs.arguments.names import shown

from ..errors import ResultsError
from ..evaluation.amounts import require_jobs
from ..files import is_plain, locked, plain_json, write_atomic
from ..policies.environments import make_env
from ..policies.outside import name_of
from ..policies.registry import behind_filter, from_outside, is_trained, make_policy, policy_entry
from ..sweeps.choices import Condition, EnvChoice, PolicyChoice
from ..sweeps.comparison import Results
from ..sweeps.contenders import plans
from ..sweeps.engines import SHARED_FOLDER, check_engine
from ..sweeps.finished import check_unit
from ..sweeps.folder import read_config, read_run
from ..sweeps.protocol import refuse_taken_version, require_disjoint_starts
from ..sweeps.suite import BEST_MPC, Suite
from ..sweeps.suite_files import load_suite
from ..sweeps.sweep import Order, Sweep, Watcher, with_given
from ..sweeps.units import Given, Unit, suite_units, training_units
from .build import build_report, frontier_files
from .page import render_page


@dataclass(frozen=True, slots=True)
class BenchmarkRequest(Order):
    """The arguments of `run_benchmark`; the comment of a field is its documentation everywhere."""

    suite: str | Path | Mapping[str, Any] | Suite = "default"  # name of a shipped one, or path of a TOML file
    out: str | Path | None = None  # results folder; None keeps the results in memory only
    _: KW_ONLY
    policies: Mapping[str, Any] | None = (
        None  # label -> policy that flies beside those of the suite, in all of its environments: anything
        # with `predict`, a factory, or a name
    )


@called_with(BenchmarkRequest)
def run_benchmark(request: BenchmarkRequest) -> Results:
    """Fly every policy of a suite in every environment, from the same starts.

    Networks that the suite trains come first. An interrupted run goes on where it stopped when it is called
    again with the same folder: each finished unit (environment x policy) is stored at once; one whose flights
    are all asked for and were not saved is flown again, and so is one of a policy from outside this suite,
    whose code may have changed. The folder gets a report.html. Decision times of policies that fly
    one flight at a time, see `evaluate`, mean something with jobs = 1, or idle cores.

    What goes wrong in a unit ends this unit only: a warning says so at once, and `Results.failures` in the
    end. A process that dies is replaced, and what it was at is tried again.

    Raises:
        ValueError: If the suite, the engine or an option is not valid; before anything is flown.
        PolicyError: If everything that was to be flown broke off.
        ResultsError: If the folder is in use, holds another suite, or cannot be written.
    """
    require_paths(out=request.out, networks=request.networks)
    if not isinstance(request.policies, Mapping | None):
        raise ValueError(f"policies must be a mapping of labels, got {shown(request.policies)}")
    suite, given = _with_policies(load_suite(request.suite), request.policies or {})
    return fly_suite(suite, given, request.out, request)


def _with_policies(suite: Suite, policies: Mapping[str, Any]) -> tuple[Suite, dict[str, Given]]:
    """A suite with more policies, and those of them that are objects by their labels."""
    policies = {
        label: os.fspath(policy) if isinstance(policy, os.PathLike) else policy
        for label, policy in policies.items()
    }
    choices = [
        PolicyChoice(policy if isinstance(policy, str) else name_of(policy), label=label)
        for label, policy in policies.items()
    ]
    given = {label: Given(policy) for label, policy in policies.items() if not isinstance(policy, str)}
    return replace(suite, policies=(*suite.policies, *choices)), given


def fly_suite(
    suite: Suite,
    given: Mapping[str, Given],
    out: str | Path | None,
    order: Order,
) -> Results:
    """`run_benchmark` where some policies, by their titles, are objects."""
    check_engine(order.engine)
    if order.jobs is not None:
        require_jobs(order.jobs, here=order.engine == "processes")
    require_disjoint_starts(suite)
    refuse_taken_version(suite)
    _refuse_no_mpc(suite)
    _refuse_no_folder(suite, out, order)
    if order.engine == SHARED_FOLDER:
        _refuse_unshared(given, order)
    failed = _refuse_bad_units(suite, given)
    if out is not None:
        _refuse_objects(suite)
    folder = None if out is None else Path(out).absolute()
    with nullcontext() if folder is None else locked(folder):
        sweep = Sweep(suite, given, failed, folder, order)
        sweep.go()
        results = sweep.finish()
        if folder is not None:
            report = build_report(read_run(folder))
            write_atomic(folder / "report.html", render_page(report).encode())
            for name, picture in frontier_files(report).items():
                write_atomic(folder / name, picture.encode())
        return results


def _refuse_no_mpc(suite: Suite) -> None:
    """Differences to the best MPC need one in every environment."""
    for env in suite.envs if suite.base == BEST_MPC else ():
        if not any(plans(policy) and not policy.trace for policy in suite.policies_in(env)):
            raise ValueError(
                f"suite {suite.name!r} compares with the {BEST_MPC}, and no policy in {env.title!r} "
                "is an MPC: add one, such as lmpc, or set compare_with to the title of a policy"
            )


def _refuse_no_folder(suite: Suite, out: str | Path | None, order: Order) -> None:
    """Some of what is asked for needs a place."""
    if order.engine == SHARED_FOLDER and out is None:
        raise ValueError("engine 'folder' needs the folder: give out")
    if order.save_episodes and out is None:
        raise ValueError("save_episodes needs a folder: give out")
    if training_units(suite) and out is None and order.networks is None:
        raise ValueError(
            f"suite {suite.name!r} trains or tunes policies, which need a folder: give out or networks"
        )


def _refuse_objects(suite: Suite) -> None:
    """A folder holds arguments as JSON has them, to read them again."""
    choices: list[EnvChoice | Condition | PolicyChoice] = [*suite.envs, *suite.conditions, *suite.policies]
    for choice in choices:
        for name, value in choice.kwargs.items():
            if not is_plain(plain_json(value)):
                raise ValueError(
                    f"suite {suite.name!r}: {name} of {choice.title!r} is {shown(value)}, which a results "
                    "folder cannot hold: say it by name or as a mapping, as {'kind': 'helix'}, "
                    "or leave out the folder"
                )


def _refuse_unshared(given: Mapping[str, Given], order: Order) -> None:
    """What cannot be said in a folder does not reach those who work there."""
    if order.jobs is not None:
        raise ValueError("engine 'folder' has no jobs: start as many quad-envs worker OUT as you like")
    if given:
        raise ValueError(
            f"policy {next(iter(given))!r} is an object, which does not reach the workers of engine "
            "'folder': name it as module:factory, or choose another engine"
        )


def join_sweep(folder: str | Path, watcher: Watcher | None = None) -> tuple[int, tuple[str, ...]]:
    """Take part in a sweep that `run_benchmark(..., engine="folder")` has begun, until nothing is left.

    Args:
        folder: Its results folder.
        watcher: Follows what is trained and flown, by whomever.

    Returns:
        How many units are flown, and what was not to be had.

    Raises:
        ResultsError: If there is no such sweep, or it was begun with other sources.
    """
    home = Path(folder).absolute()
    if not (home / "config.json").is_file():
        raise ResultsError(
            f"no sweep has been begun in {str(folder)!r}: quad-envs benchmark SUITE --engine folder --out "
            f"{shlex.quote(str(folder))} begins one"
        )
    config, suite = read_config(home)
    if config.get("engine") != SHARED_FOLDER:
        raise ResultsError(
            f"the sweep in {str(folder)!r} has engine {config.get('engine')!r}, which no worker joins: go on "
            "with it with --engine folder"
        )
    order = Order(
        engine=SHARED_FOLDER,
        save_episodes=bool(config["save_episodes"]),
        networks=config["networks"],
        watcher=watcher,
    )
    sweep = Sweep(suite, {}, {}, home, order, joins=True)
    sweep.go()
    return len(sweep.flown), tuple(sweep.failed.values())


def _refuse_bad_units(suite: Suite, given: Mapping[str, Given]) -> dict[int, str]:
    """Make every environment and policy once, so that a mistake shows at once and not after an hour.

    Returns:
        Number of each unit whose policy is from outside and cannot be made -> why.
    """
    for training in training_units(suite):
        check_unit(training)
    failed = {}
    for _, group in groupby(with_given(suite_units(suite), given), key=lambda unit: unit.env.title):
        units = list(group)
        own = units[0].given.env
        env = make_env(units[0].env.id, **units[0].env.kwargs) if own is None else own
        for unit in units:
            try:
                if unit.policy.made is None:
                    _refuse_bad_policy(unit, env)
            except ValueError as error:
                if not from_outside(unit.source):
                    raise
                failed[unit.number] = str(error)
        if own is None:
            env.close()
    return failed


def _refuse_bad_policy(unit: Unit, env: Any) -> None:
    """Make a policy once."""
    try:
        make_policy(unit.source, env, **unit.options)
    except ValueError as error:
        known = from_outside(unit.source) or is_trained(unit.source)
        if known or env.unwrapped.task.mission in policy_entry(behind_filter(unit.source)).missions:
            raise
        raise ValueError(f"{error}. Say in the suite for which it is: envs = [...]") from error
