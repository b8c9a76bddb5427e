"""`run_benchmark`: environments x policies, in parallel and resumable, to a results folder and tables."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_envs.tasks import TeamTask

from .checks import require_whole
from .comparison import Results
from .engines import check_engine, run_units
from .environments import make_env
from .errors import ResultsError
from .evaluation import Evaluation, evaluate
from .policy import is_trained, make_policy, mission_of, policy_entry
from .report import read_run, render_report
from .report.folder import task_facts
from .results import (
    RESULTS_FORMAT,
    discard,
    locked,
    plain_json,
    provenance,
    read_json,
    refuse_foreign,
    source_digest,
    write_atomic,
    write_csv,
    write_json,
)
from .rollout import Episode
from .suite import PolicyChoice, Suite, is_for
from .suite_files import load_suite
from .trained import shipped_name
from .training.finished import train_unit, training_plan
from .units import Unit, suite_units, training_units

REPORTED = 2  # flights of each unit that are saved for the report where not all are asked for


def fly_unit(unit: Unit) -> dict[str, Any]:
    """Fly one unit; the form in which it is stored in cells/."""
    begin = perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # said once before the first unit
        env = make_env(unit.env.id, **unit.env.kwargs)
    policy = make_policy(unit.policy_name, env, **unit.policy.kwargs)
    save = None if unit.episode_folder is None else _saver(unit, env)
    found = evaluate(policy, env, unit.episodes, unit.seed, on_episode=save)
    env.close()
    seconds = perf_counter() - begin
    return {
        "env": unit.env.title,
        "policy": unit.policy.title,
        "seconds": seconds,
        "task": task_facts(env.unwrapped.task),
        "flights_saved": len(unit.episode_files()),
        "found": found.to_plain(),
    }


def _saver(unit: Unit, env: Any) -> Callable[[Episode], None]:
    """Writes the flights that are wanted to episodes/, each when all vehicles of a team have given theirs."""
    team: list[Episode] = []

    def save(episode: Episode) -> None:
        team.append(episode)
        if len(team) < episode.team_size:
            return
        arrays: dict[str, Any] = flight_arrays(team) | _shared_arrays(env)
        team.clear()
        path = unit.episode_file(episode.seed)
        if path is None:
            return
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        write_atomic(path, buffer.getvalue())

    return save


def _shared_arrays(env: Any) -> dict[str, NDArray[Any]]:
    """What a team has in common in the flight that just ended: the target's rows r, v, and who hears whom.

    `graphs` (M, N, N) are the weights that hold at some step, and `graph_of_step` (T+1,) says which.
    """
    task = env.unwrapped.task
    if not isinstance(task, TeamTask):
        return {}
    found = {"graphs": env.unwrapped.graphs.graphs, "graph_of_step": env.unwrapped.graphs.which}
    return found | ({"target": env.unwrapped.target} if task.layout.target else {})


def flight_arrays(team: Sequence[Episode]) -> dict[str, NDArray[Any]]:
    """The arrays of a flight in the form of episodes/*.npz.

    Of one vehicle those of its Episode. Of a team the same and its signals, stacked with the vehicles first,
    with `agent` their names and `lengths` the steps that each flew: what lies behind, where one left early,
    is nan, or zero where there are only whole numbers.
    """
    plain = [
        {key: value for key, value in episode._asdict().items() if isinstance(value, np.ndarray)}
        | {key: np.asarray(value) for key, value in episode.signals.items()}
        for episode in team
    ]
    if not team[0].agent:
        return plain[0]
    out = {key: _stack_ragged([arrays[key] for arrays in plain]) for key in plain[0]}
    out["agent"] = np.array([episode.agent for episode in team])
    out["lengths"] = np.array([len(episode.rewards) for episode in team])
    out["crashed"] = np.array([episode.crashed for episode in team])
    return out


def _stack_ragged(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
    longest = max(len(array) for array in arrays)
    fill = np.nan if np.issubdtype(arrays[0].dtype, np.floating) else 0
    out = np.full((len(arrays), longest, *arrays[0].shape[1:]), fill, dtype=arrays[0].dtype)
    for row, array in zip(out, arrays, strict=True):
        row[: len(array)] = array
    return out


def run_benchmark(
    suite: str | Path | Mapping[str, Any] | Suite = "default",
    out: str | Path | None = None,
    *,
    engine: str = "processes",
    jobs: int = 1,
    save_episodes: bool = False,
    fresh: bool = False,
    networks: str | Path | None = None,
    on_unit: Callable[[int, int], None] | None = None,
) -> Results:
    """Fly every policy of a suite in every environment, from the same starts.

    Networks that the suite trains come first. An interrupted run goes on where it stopped when it is called
    again with the same folder: each finished unit (environment x policy) is stored at once; one whose flights
    are all asked for and were not saved is flown again. The folder gets a report.html. Decision times mean
    something with jobs = 1, or idle cores.

    Args:
        suite: Name of a shipped suite, path of a TOML file, mapping, or Suite.
        out: Results folder; None keeps the results in memory only.
        engine: "processes", "ray" or "dask".
        jobs: Units flown at a time, >= 1.
        save_episodes: Whether to write every flight to out/episodes, and not only the first REPORTED of each
            unit, which the report shows.
        fresh: Whether to discard what the folder holds of an earlier run, but for trained networks.
        networks: Where networks that the suite trains are, or go; out/networks if not given. Those that are
            trained as the suite wants are taken as they are.
        on_unit: Called with (finished, all) at the beginning and after each unit.

    Raises:
        ValueError: If the suite, the engine or an option is not valid; before anything is flown.
        ResultsError: If the folder is in use, holds another suite, or cannot be written.
    """
    suite = load_suite(suite)
    check_engine(engine)
    require_whole("jobs", jobs, 1)
    _refuse_no_folder(suite, out, networks, save_episodes)
    _refuse_bad_units(suite)
    folder = None if out is None else Path(out).absolute()
    with nullcontext() if folder is None else locked(folder):
        sweep = _Sweep(suite, folder, networks, save_episodes, fresh)
        sweep.go(engine, jobs, on_unit or (lambda finished, total: None))
        return sweep.finish()


class _Sweep:
    """One run of a suite: the units to train and to fly, those that are done, and the folder of both."""

    def __init__(
        self, suite: Suite, folder: Path | None, networks: str | Path | None, all_flights: bool, fresh: bool
    ) -> None:
        self.suite, self.folder = suite, folder
        home = Path(networks or (folder or Path()) / "networks").absolute()
        episodes = None if folder is None else folder / "episodes"
        self.to_train = training_units(suite, home)
        self.units = suite_units(suite, episodes, suite.episodes if all_flights else REPORTED, home)
        if folder is not None and fresh:
            discard(folder)
        self.flown = _begin(folder, suite, self.units, all_flights)  # cells by the number of their unit
        self.trained: dict[int, dict[str, Any]] = {}

    def go(self, engine: str, jobs: int, report: Callable[[int, int], None]) -> None:
        """Train, then fly what is left; each flown unit is stored at once."""
        total = len(self.to_train) + len(self.units)
        left = [unit for unit in self.units if unit.number not in self.flown]
        report(len(self.flown), total)
        for number, training in run_units(train_unit, self.to_train, engine, jobs):
            self.trained[number] = training
            report(len(self.trained) + len(self.flown), total)
        for number, cell in run_units(fly_unit, left, engine, jobs):
            if self.folder is not None:
                write_json(self.folder / "cells" / self.units[number].file_name, cell)
            self.flown[number] = cell
            report(len(self.trained) + len(self.flown), total)

    def finish(self) -> Results:
        """What was found; the tables and the report of it are written."""
        results = Results(
            self.suite,
            tuple(Evaluation.from_plain(self.flown[unit.number]["found"]) for unit in self.units),
            tuple(self.trained[unit.number] for unit in self.to_train),
        )
        if self.folder is not None:
            _write_tables(self.folder, results)
            write_atomic(self.folder / "report.html", render_report(read_run(self.folder)).encode())
        return results


def _write_tables(folder: Path, results: Results) -> None:
    """The tables of a finished run."""
    write_csv(folder / "summary.csv", results.summary())
    write_csv(folder / "results.csv", results.rows())
    if results.suite.learned:
        write_csv(folder / "contenders.csv", results.contender_rows())


def _refuse_no_folder(
    suite: Suite, out: str | Path | None, networks: str | Path | None, save_episodes: bool
) -> None:
    """Some of what is asked for needs a place."""
    if save_episodes and out is None:
        raise ValueError("save_episodes needs a folder: give out")
    if training_units(suite) and out is None and networks is None:
        raise ValueError(f"suite {suite.name!r} trains networks, which need a folder: give out or networks")


def _refuse_bad_units(suite: Suite) -> None:
    """Make every environment and policy once, so that a mistake shows at once and not after an hour."""
    for unit in training_units(suite):
        training_plan(unit)
    for choice in suite.envs:
        for flown in suite.flown(choice).values():
            env = make_env(flown.id, **flown.kwargs)
            for policy in suite.policies:
                if policy.train is None and is_for(policy.envs, choice):
                    _refuse_bad_policy(policy, env)
            env.close()


def _refuse_bad_policy(policy: PolicyChoice, env: Any) -> None:
    """Make a policy once."""
    if policy.shipped:
        make_policy(shipped_name(policy.name, env.unwrapped.task.env_id), env, **policy.kwargs)
        return
    try:
        make_policy(policy.name, env, **policy.kwargs)
    except ValueError as error:
        trained = is_trained(policy.name)
        if trained or mission_of(env.unwrapped.task) in policy_entry(policy.name).missions:
            raise
        raise ValueError(f"{error}. Say in the suite for which it is: envs = [...]") from error


def _begin(
    folder: Path | None, suite: Suite, units: Sequence[Unit], all_flights: bool
) -> dict[int, dict[str, Any]]:
    """Write config.json, or check that it is this suite's; the finished units by index."""
    if folder is None:
        return {}
    refuse_foreign(folder)
    config = folder / "config.json"
    if not config.exists():
        write_json(config, {"format": RESULTS_FORMAT, "suite": plain_json(suite.to_dict()), **provenance()})
        return {}
    stored, asked = read_json(config), plain_json(suite.to_dict())
    if stored.get("suite") != asked:
        before = stored.get("suite") or {}
        differing = ", ".join(key for key, value in asked.items() if before.get(key) != value)
        raise ResultsError(
            f"{str(folder)!r} holds another suite (it differs in {differing}); choose another folder, "
            "or discard it with fresh=True (--fresh)"
        )
    if stored.get("source") != source_digest():
        raise ResultsError(
            f"{str(folder)!r} was begun with other sources, revision {stored.get('git_revision')}: their "
            "numbers do not mix; choose another folder, or discard it with fresh=True (--fresh)"
        )
    return dict(_stored_units(folder, units, all_flights))


def _stored_units(
    folder: Path, units: Sequence[Unit], all_flights: bool
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Units that have their cell and, where all are asked for, every flight."""
    for unit in units:
        path = folder / "cells" / unit.file_name
        if path.exists() and not (all_flights and any(not file.exists() for file in unit.episode_files())):
            yield unit.number, read_json(path)
