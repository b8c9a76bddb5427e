"""`run_benchmark`: environments x policies, in parallel and resumable, to a results folder and tables."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from .engines import ENGINES, run_units
from .environments import make_env
from .errors import ResultsError, unknown_name
from .evaluation import Evaluation, evaluate
from .metrics import paired_difference, totals, worst_violations
from .policy import make_policy
from .results import (
    discard,
    git_revision,
    locked,
    plain_json,
    provenance,
    read_json,
    write_atomic,
    write_csv,
    write_json,
)
from .rollout import Episode
from .suite import EnvChoice, PolicyChoice, Suite, load_suite
from .table import format_number, format_table

COMPARED = ("score", "cost", "position_rms", "effort")  # columns with paired differences


class Unit(NamedTuple):
    """What is flown in one piece."""

    number: int
    env: EnvChoice
    policy: PolicyChoice
    episodes: int
    seed: int
    episode_folder: Path | None  # where to save flights

    @property
    def file_name(self) -> str:
        """Name of its file in cells/."""
        slug = "".join(c if c.isalnum() else "-" for c in f"{self.env.title}--{self.policy.title}")
        return f"{self.number:03d}-{slug[:80]}.json"


@dataclass(frozen=True, slots=True)
class Results:
    """What `run_benchmark` found; prints as one table per environment."""

    suite: Suite
    evaluations: tuple[Evaluation, ...]  # environments x policies, in the order of the suite

    def get(self, env: str, policy: str) -> Evaluation:
        """The evaluation of a policy in an environment, by their titles."""
        for unit, evaluation in zip(suite_units(self.suite), self.evaluations, strict=True):
            if (unit.env.title, unit.policy.title) == (env, policy):
                return evaluation
        raise KeyError(f"no evaluation of {policy!r} in {env!r}")

    def rows(self) -> list[dict[str, Any]]:
        """One row per environment x policy x flight."""
        units = suite_units(self.suite)
        return [
            {"env": unit.env.title, "policy": unit.policy.title, **record.row()}
            for unit, evaluation in zip(units, self.evaluations, strict=True)
            for record in evaluation.records
        ]

    def summary(self) -> list[dict[str, Any]]:
        """One row per environment x policy: means, half widths (_ci), paired differences (_minus_base)."""
        return [self._summary_row(unit) for unit in suite_units(self.suite)]

    def _summary_row(self, unit: Unit) -> dict[str, Any]:
        ours, base = self.get(unit.env.title, unit.policy.title), self.get(unit.env.title, self.suite.base)
        row: dict[str, Any] = {
            "env": unit.env.title,
            "policy": unit.policy.title,
            "episodes": len(ours.records),
        }
        for name, value in ours.summary().items():
            row[name], row[f"{name}_ci"] = value.mean, value.half_width
        for name in COMPARED:
            difference = paired_difference(ours.records, base.records, name)
            row[f"{name}_minus_base"], row[f"{name}_minus_base_ci"] = difference.mean, difference.half_width
        row |= totals(ours.records)
        row["iterations_max"] = max(record.iterations_max for record in ours.records)
        row |= {f"worst_{name}": value for name, value in worst_violations(ours.records).items()}
        row |= dict(
            zip(("decision_p50_ms", "decision_p99_ms", "decision_max_ms"), ours.decision_ms, strict=True)
        )
        return row

    def to_dict(self) -> dict[str, Any]:
        """As plain numbers for JSON."""
        return {"suite": self.suite.to_dict(), "evaluations": [one.to_dict() for one in self.evaluations]}

    def __str__(self) -> str:
        return "\n\n".join(self._table(env) for env in self.suite.envs)

    def _table(self, env: EnvChoice) -> str:
        base = self.suite.base
        header = [
            "policy",
            "score",
            f"- {base}",
            "+-",
            "cost",
            "RMS m",
            "steady m",
            "effort N^2",
            "violating %",
        ]
        header += ["worst", "crashes", "saturated %", "p50 ms", "p99 ms", "fallbacks"]
        lines = []
        for row in (row for row in self.summary() if row["env"] == env.title):
            worst = max(
                (value for key, value in row.items() if key.startswith("worst_")), default=float("nan")
            )
            numbers = [row["score"], row["score_minus_base"], row["score_minus_base_ci"], row["cost"]]
            numbers += [
                row["position_rms"],
                row["steady_rms"],
                row["effort"],
                100.0 * row["violation_share"],
                worst,
            ]
            failed = sum(row[name] for name in ("relaxed", "previous_plan", "clipped_sdre", "hover"))
            cells = [row["policy"], *map(format_number, numbers), str(row["crashed"])]
            cells += [format_number(100.0 * row["saturation_share"])]
            cells += [
                format_number(row["decision_p50_ms"]),
                format_number(row["decision_p99_ms"]),
                str(failed),
            ]
            lines.append(cells)
        seeds = f"seeds {self.suite.seed} to {self.suite.seed + self.suite.episodes - 1}"
        return f"{env.title}, {seeds}\n{format_table(header, lines)}"


def suite_units(suite: Suite, episode_folder: Path | None = None) -> list[Unit]:
    """All environments x policies."""
    pairs = [(env, policy) for env in suite.envs for policy in suite.policies]
    return [Unit(i, *pair, suite.episodes, suite.seed, episode_folder) for i, pair in enumerate(pairs)]


def fly_unit(unit: Unit) -> dict[str, Any]:
    """Fly one unit; the form in which it is stored in cells/."""
    begin = perf_counter()
    env = make_env(unit.env.id, **unit.env.kwargs)
    policy = make_policy(unit.policy.name, env, **unit.policy.kwargs)
    save = None if unit.episode_folder is None else _saver(unit)
    found = evaluate(policy, env, unit.episodes, unit.seed, on_episode=save)
    env.close()
    seconds = perf_counter() - begin
    return {"env": unit.env.title, "policy": unit.policy.title, "seconds": seconds, "found": found.to_plain()}


def _saver(unit: Unit) -> Callable[[Episode], None]:
    """Writes each flight to episodes/."""
    folder, stem = unit.episode_folder or Path(), unit.file_name.removesuffix(".json")

    def save(episode: Episode) -> None:
        arrays: dict[str, Any] = {
            key: value for key, value in episode._asdict().items() if isinstance(value, np.ndarray)
        }
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        write_atomic(folder / f"{stem}-{episode.seed}.npz", buffer.getvalue())

    return save


def run_benchmark(
    suite: str | Path | Mapping[str, Any] | Suite = "default",
    out: str | Path | None = None,
    *,
    engine: str = "processes",
    jobs: int = 1,
    save_episodes: bool = False,
    fresh: bool = False,
    on_unit: Callable[[int, int], None] | None = None,
) -> Results:
    """Fly every policy of a suite in every environment, from the same starts.

    An interrupted run goes on where it stopped when it is called again with the same folder: each finished
    unit (environment x policy) is stored at once. Decision times mean something with jobs = 1, or idle cores.

    Args:
        suite: Name of a shipped suite, path of a TOML file, mapping, or Suite.
        out: Results folder; None keeps the results in memory only.
        engine: "processes", "ray" or "dask".
        jobs: Units flown at a time, >= 1.
        save_episodes: Whether to write every flight to out/episodes.
        fresh: Whether to discard what the folder holds of an earlier run.
        on_unit: Called with (finished, all) at the beginning and after each unit.

    Raises:
        ValueError: If the suite, the engine or an option is not valid; before anything is flown.
        ResultsError: If the folder is in use, holds another suite, or cannot be written.
    """
    suite = load_suite(suite)
    if engine not in ENGINES:
        raise ValueError(unknown_name("engine", engine, ENGINES))
    if isinstance(jobs, bool) or not isinstance(jobs, int) or jobs < 1:
        raise ValueError(f"jobs must be a whole number >= 1, got {jobs!r}")
    if save_episodes and out is None:
        raise ValueError("save_episodes needs a folder: give out")
    folder = None if out is None else Path(out).absolute()
    _refuse_bad_units(suite)
    hold: AbstractContextManager[None] = nullcontext() if folder is None else locked(folder)
    with hold:
        units = suite_units(suite, folder / "episodes" if folder is not None and save_episodes else None)
        if folder is not None and fresh:
            discard(folder)
        done = _begin(folder, suite, units)
        report = on_unit or (lambda finished, total: None)
        report(len(done), len(units))
        for index, cell in run_units(
            fly_unit, [unit for unit in units if unit.number not in done], engine, jobs
        ):
            if folder is not None:
                write_json(folder / "cells" / units[index].file_name, cell)
            done[index] = cell
            report(len(done), len(units))
        results = Results(suite, tuple(Evaluation.from_plain(done[unit.number]["found"]) for unit in units))
        if folder is not None:
            write_csv(folder / "summary.csv", results.summary())
            write_csv(folder / "results.csv", results.rows())
    return results


def _refuse_bad_units(suite: Suite) -> None:
    """Make every environment and policy once, so that a mistake shows at once and not after an hour."""
    for choice in suite.envs:
        env = make_env(choice.id, **choice.kwargs)
        for policy in suite.policies:
            make_policy(policy.name, env, **policy.kwargs)
        env.close()


def _begin(folder: Path | None, suite: Suite, units: Sequence[Unit]) -> dict[int, dict[str, Any]]:
    """Write config.json, or check that it is this suite's; the finished units by index."""
    if folder is None:
        return {}
    config = folder / "config.json"
    if not config.exists():
        write_json(config, {"suite": plain_json(suite.to_dict()), **provenance()})
        return {}
    stored, asked = read_json(config), plain_json(suite.to_dict())
    if stored.get("suite") != asked:
        before = stored.get("suite") or {}
        differing = ", ".join(key for key, value in asked.items() if before.get(key) != value)
        raise ResultsError(
            f"{str(folder)!r} holds another suite (it differs in {differing}); choose another folder, "
            "or discard it with fresh=True (--fresh)"
        )
    revision = git_revision()
    if stored.get("git_revision") != revision:
        raise ResultsError(
            f"{str(folder)!r} was begun with revision {stored.get('git_revision')} and this is {revision}: "
            "they do not belong in one table; choose another folder, or discard it with fresh=True (--fresh)"
        )
    return dict(_stored_units(folder, units))


def _stored_units(folder: Path, units: Sequence[Unit]) -> Iterator[tuple[int, dict[str, Any]]]:
    for unit in units:
        path = folder / "cells" / unit.file_name
        if path.exists():
            yield unit.number, read_json(path)
