"""One run of a suite: what is left to train and to fly, the folder that stores it, and what was found."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from ..errors import PolicyError, ResultsError
from ..evaluation.evaluate import Evaluation
from ..files import (
    FAILURES,
    RESULTS_FORMAT,
    discard,
    plain_json,
    provenance,
    read_json,
    refuse_foreign,
    source_digest,
    write_csv,
    write_json,
)
from ..policies.registry import from_outside
from .comparison import Failure, Results
from .engines import run_units
from .finished import train_unit
from .protocol import protocol_facts, refuse_other_version
from .stages import price
from .suite import Suite
from .unit_flights import fly_unit, timed_unit
from .units import Given, Unit, suite_units, training_units

REPORTED = 2  # flights of each unit that are saved for the report where not all are asked for


class Watcher(Protocol):
    """Who follows a sweep."""

    def trained(self, finished: int, total: int) -> None:
        """So many of the networks are there; called before the first, too, if there are any."""

    def ready(self, left: Sequence[Unit]) -> None:
        """All is checked, and networks are trained: these units are going to fly."""

    def flown(self, unit: Unit, found: Evaluation) -> None:
        """A unit was flown just now, or came from another process."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """How a suite is to be flown; the comment of a field is its documentation everywhere."""

    engine: str = "processes"  # or "ray" or "dask"
    jobs: int = 1  # units flown at a time
    save_episodes: bool = (
        False  # whether to write every flight to out/episodes, and not only the first REPORTED of each unit,
        # which the report shows
    )
    fresh: bool = False  # whether to discard what the folder holds of an earlier run, but for networks
    networks: str | Path | None = (
        None  # where networks that the suite trains are, or go; out/networks if not given; those that are
        # trained as the suite wants are taken as they are
    )
    on_unit: Callable[[int, int], None] | None = (
        None  # called with (finished, all) at the beginning and after each unit
    )
    watcher: Watcher | None = None  # follows what is trained and flown


def with_given(units: Sequence[Unit], given: Mapping[str, Given]) -> list[Unit]:
    """Units with the objects that fly in them, by the titles of their policies."""
    return [unit._replace(given=given.get(unit.policy.title, Given())) for unit in units]


class Sweep:
    """One run of a suite: the units to train and to fly, those that are done, and the folder of both."""

    def __init__(
        self,
        suite: Suite,
        given: Mapping[str, Given],
        failed: dict[int, str],
        folder: Path | None,
        order: Order,
    ) -> None:
        self.suite, self.failed, self.folder, self.order = suite, failed, folder, order
        home = Path(order.networks or (folder or Path()) / "networks").absolute()
        all_flights = order.save_episodes
        episodes = None if folder is None else folder / "episodes"
        self.to_train = training_units(suite, home)
        units = suite_units(suite, episodes, suite.episodes if all_flights else REPORTED, home)
        self.units = with_given(units, given)
        if folder is not None and order.fresh:
            discard(folder)
        self.flown = _begin(folder, suite, self.units, all_flights)  # cells by the number of their unit
        self.trained: dict[int, dict[str, Any]] = {}

    def go(self) -> None:
        """Train, then fly what is left; each flown unit is stored at once."""
        engine, jobs = self.order.engine, self.order.jobs
        report = self.order.on_unit or (lambda finished, total: None)
        total = len(self.to_train) + len(self.units)
        left = [unit for unit in self.units if not (unit.number in self.flown or unit.number in self.failed)]
        report(self.done, total)
        for number in self.failed:
            self._warn(number)
        watcher = self.order.watcher
        if watcher is not None and self.to_train:
            watcher.trained(0, len(self.to_train))
        for number, training in run_units(train_unit, self.to_train, engine, jobs):
            self.trained[number] = training
            report(self.done, total)
            if watcher is not None:
                watcher.trained(len(self.trained), len(self.to_train))
        if jobs == 1:  # in parallel the long ones would be left over in the end
            places = {unit.env.title: i for i, unit in reversed(list(enumerate(left)))}
            left.sort(key=lambda unit: (places[unit.env.title], price(unit)))
        if watcher is not None:
            watcher.ready(left)
        if jobs > 1:  # before others take the cores
            left = [timed_unit(unit) for unit in left]
        for number, cell in run_units(fly_unit, left, engine, jobs):
            if "failure" in cell:
                self.failed[number] = cell["failure"]
                self._warn(number)
            else:
                if self.folder is not None:
                    write_json(self.folder / "cells" / self.units[number].file_name, cell)
                self.flown[number] = cell
            report(self.done, total)
            if watcher is not None and number in self.flown:
                watcher.flown(self.units[number], Evaluation.from_plain(cell["found"]))

    def _warn(self, number: int) -> None:
        """Say at once, and not only in the end, that one of several units broke off."""
        unit, why = self.units[number], self.failed[number]
        if len(self.units) > 1:
            text = f"{unit.policy.title!r} does not fly in {unit.env.title}: {why}"
            warnings.warn(text, stacklevel=5)

    @property
    def done(self) -> int:
        """Units that are trained, flown, or cannot be flown."""
        return len(self.trained) + len(self.flown) + len(self.failed)

    def finish(self) -> Results:
        """What was found; its tables are written."""
        flown = [unit for unit in self.units if unit.number in self.flown]
        failures = tuple(
            Failure(unit.env.title, unit.policy.title, self.failed[unit.number])
            for unit in self.units
            if unit.number in self.failed
        )
        if not flown:
            raise PolicyError(failures[0].message)
        results = Results(
            self.suite,
            tuple(Evaluation.from_plain(self.flown[unit.number]["found"]) for unit in flown),
            tuple(self.trained[unit.number] for unit in self.to_train),
            failures,
        )
        if self.folder is not None:
            _write_tables(self.folder, results)
        return results


def _write_tables(folder: Path, results: Results) -> None:
    """The tables of a finished run."""
    write_csv(folder / "summary.csv", results.summary())
    write_csv(folder / "results.csv", results.rows())
    (folder / FAILURES).unlink(missing_ok=True)
    if results.failures:
        write_json(folder / FAILURES, [failure._asdict() for failure in results.failures])
    if results.suite.learned:
        write_csv(folder / "contenders.csv", results.contender_rows())


def _begin(
    folder: Path | None, suite: Suite, units: Sequence[Unit], all_flights: bool
) -> dict[int, dict[str, Any]]:
    """Write config.json, or check that it is this suite's; the finished units by index."""
    if folder is None:
        return {}
    refuse_foreign(folder)
    config = folder / "config.json"
    if not config.exists():
        facts = protocol_facts(suite)
        said = {"format": RESULTS_FORMAT, "suite": plain_json(suite.to_dict())}
        write_json(config, {**said, **({"protocol": facts} if facts else {}), **provenance()})
        return {}
    stored, asked = read_json(config), plain_json(suite.to_dict())
    refuse_other_version(folder, stored, suite)
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
    """Units that have their cell and, where all are asked for, every flight.

    Nothing tells whether the code or the weights of a policy from outside have changed: it flies again.
    """
    for unit in units:
        path = folder / "cells" / unit.file_name
        if not unit.named or (unit.policy.made is None and from_outside(unit.source)):
            path.unlink(missing_ok=True)
            continue
        if path.exists() and not (all_flights and any(not file.exists() for file in unit.episode_files())):
            yield unit.number, read_json(path)
