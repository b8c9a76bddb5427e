"""What a results folder holds, read for the report: configuration, finished units, saved flights."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from baselines.errors import ResultsError
from baselines.evaluation.columns import Record
from baselines.evaluation.evaluate import Evaluation
from baselines.evaluation.team_metrics import by_flight
from baselines.files import FAILURES, RESULTS_FORMAT, plain_json, read_json
from baselines.sweeps.choices import EnvChoice, PolicyChoice
from baselines.sweeps.comparison import Results
from baselines.sweeps.contenders import Contender, contender_of
from baselines.sweeps.protocol import check_stored
from baselines.sweeps.store import EPISODES, cells_of, read_cell
from baselines.sweeps.suite import BEST_MPC, Suite
from baselines.sweeps.units import Unit, suite_units
from quad_envs.constraints import TOLERANCE
from quad_envs.limits import UNITS
from quad_envs.tasks import BaseTask


class Finished(NamedTuple):
    """A unit of the suite that has been flown."""

    unit: Unit
    evaluation: Evaluation
    task: dict[str, Any]
    flights_saved: int  # the first ones
    episodes: Path  # their folder

    def episode_file(self, seed: int) -> Path:
        """Where a flight is, if it was saved."""
        return self.episodes / self.unit.episode_name(seed)

    def flights(self) -> dict[int, list[Record]]:
        """Seeds whose flight was saved -> records of its vehicles."""
        return dict(islice(by_flight(self.evaluation.records).items(), self.flights_saved))


class Flown(NamedTuple):
    """An environment under a condition."""

    env: EnvChoice
    place: str  # title of the environment alone
    condition: str
    results: Results  # its table
    here: list[Finished]  # its units


class Run(NamedTuple):
    """A results folder."""

    folder: Path
    config: dict[str, Any]
    suite: Suite
    finished: tuple[Finished, ...]
    units: int  # that the suite has
    failures: tuple[str, ...] = ()  # policies from outside that did not fly, and why

    def environments(self) -> list[Flown]:
        """Environments of which something is flown, under each condition."""
        out = []
        for place in self.suite.envs:
            for condition, env in self.suite.flown(place).items():
                here = [one for one in self.finished if one.unit.env.title == env.title]
                if here:
                    out.append(Flown(env, place.title, condition, _results(self.suite, env, here), here))
        return out

    def contenders(self, here: Sequence[Finished], table: str = "") -> list[Contender]:
        """Who is compared in an environment: what has all of its seeds, but for points of a trace.

        Args:
            here: What was flown there.
            table: Label of the table; all of them if empty.
        """
        groups: dict[str, list[Finished]] = {}
        for one in here:
            tables = one.unit.policy.tables
            if not one.unit.policy.trace and (not table or not tables or table in tables):
                groups.setdefault(one.unit.policy.contender, []).append(one)
        found = []
        for name, group in groups.items():
            policy = group[0].unit.policy
            seeds = [other for other in self.suite.policies if _same(other, policy)]
            if len(group) == len(seeds):
                evaluations = tuple(one.evaluation for one in group)
                title = group[0].unit.env.title
                found.append(contender_of(title, "", name, policy, evaluations, ()))
        return found


def _same(one: PolicyChoice, other: PolicyChoice) -> bool:
    """Whether they are seeds of one contender in the same environments."""
    return (one.contender, one.envs) == (other.contender, other.envs)


def _results(suite: Suite, env: EnvChoice, here: Sequence[Finished]) -> Results:
    """The table of one environment, with the policies that have been flown there."""
    # What they name are others than this one.
    policies = tuple(replace(one.unit.policy, envs=(), conditions=(), tables=()) for one in here)
    base = suite.base if suite.base in (BEST_MPC, *(policy.title for policy in policies)) else ""
    part = Suite(suite.name, (env,), policies, suite.episodes, suite.seed, base)
    return Results(part, tuple(one.evaluation for one in here))


def task_facts(task: BaseTask) -> dict[str, Any]:
    """Parameters of a task for the report, as plain numbers: all but the layout of the observation."""
    facts = {key: value for key, value in asdict(task).items() if key != "layout"}
    derived = {
        "constraint_names": task.constraint_names,
        "constraint_units": [UNITS[name] for name in task.constraint_names],
        "force_max": task.force_max.tolist(),
        "hover_force": task.hover_force,
        "rotors": (task.params.rotor_positions() / task.params.arm).tolist(),
        "tolerance": TOLERANCE,
        "mission": task.mission,
    }
    plain: dict[str, Any] = plain_json(facts | derived)
    return plain


def read_run(folder: Path) -> Run:
    """Read a results folder, finished or not.

    Raises:
        ResultsError: If there is none, nothing in it is finished, or another version has written it.
    """
    config, suite = read_config(folder)
    units = suite_units(suite, suite.episodes)
    stored = [(unit, [cell.path for cell in cells_of(folder, unit)]) for unit in units]
    read = (_finished(unit, paths, folder / EPISODES) for unit, paths in stored if paths)
    finished = tuple(one for one in read if one.evaluation.flights == suite.episodes)  # others are under way
    if not finished:
        raise ResultsError(
            f"nothing in {str(folder)!r} is finished yet; run the same command again: it "
            "goes on where it stopped"
        )
    return Run(folder, config, suite, finished, len(units), _failures(folder))


def read_config(folder: Path) -> tuple[dict[str, Any], Suite]:
    """What config.json of a results folder says, and the suite in it.

    Raises:
        ResultsError: If there is none, or another version has written it.
    """
    if not (folder / "config.json").is_file():
        what = "is not a results folder: it has no config.json" if folder.is_dir() else "does not exist"
        raise ResultsError(
            f"{str(folder)!r} {what}; make one with: quad-envs benchmark --out FOLDER, or "
            "quad-envs evaluate ENV POLICY --out FOLDER"
        )
    config = read_json(folder / "config.json")
    _check_format(folder, config)
    try:
        suite = Suite.from_dict(config["suite"])
    except (KeyError, TypeError, ValueError) as error:
        raise ResultsError(f"the suite in {str(folder / 'config.json')!r} is not valid: {error}") from error
    check_stored(folder, config, suite)
    return config, suite


def _failures(folder: Path) -> tuple[str, ...]:
    """What failures.json says; a folder of before has none."""
    path = folder / FAILURES
    found = read_json(path) if path.is_file() else []
    try:
        return tuple(f"{one['policy']} did not fly in {one['env']}: {one['message']}" for one in found)
    except (KeyError, TypeError) as error:
        raise ResultsError(f"{str(path)!r} is not ours ({error!r}); delete it") from error


def read_contenders(folder: Path) -> dict[str, list[dict[str, str]]]:
    """Rows of contenders.csv by the title of the environment as flown; none where nothing was trained."""
    path = folder / "contenders.csv"
    out: dict[str, list[dict[str, str]]] = {}
    if not path.is_file():
        return out
    try:
        with open(path, newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                title = f"{row['env']}, {row['condition']}" if row["condition"] else row["env"]
                out.setdefault(title, []).append(row)
    except (csv.Error, KeyError, ValueError) as error:
        raise ResultsError(f"{str(path)!r} is not ours ({error!r}); delete it") from error
    return out


def _check_format(folder: Path, config: Any) -> None:
    """Refuse what this version cannot read."""
    if not isinstance(config, Mapping) or not isinstance(config.get("suite"), Mapping):
        raise ResultsError(
            f"{str(folder / 'config.json')!r} is not that of a results folder; choose another one"
        )
    found = config.get("format", 1)
    if found != RESULTS_FORMAT:
        version = dict(config.get("versions") or {}).get("quad-envs", "?")
        raise ResultsError(
            f"{str(folder)!r} has results of format {found}, written by quad-envs {version}, and this "
            f"version reads format {RESULTS_FORMAT}: fly them again with --fresh, or make the report with "
            "the version that wrote them"
        )


def _finished(unit: Unit, paths: Sequence[Path], episodes: Path) -> Finished:
    """What the cells of a unit say."""
    blocks = [read_cell(path) for path in paths]
    found = Evaluation.joined([block.found for block in blocks], unit.starts)
    saved = sum(block.flights_saved for block in blocks)
    return Finished(unit, found, blocks[0].task, saved, episodes)
