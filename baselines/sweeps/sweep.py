"""One run of a suite: what is left to train and to fly, the folder that stores it, and what was found."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from ..errors import PolicyError
from ..evaluation.evaluate import Evaluation
from ..files import FAILURES, discard, write_csv, write_json
from .comparison import Failure, Results
from .crews import Block, crew_of
from .store import Store, blocks_left
from .suite import Suite
from .units import Given, TrainingUnit, Unit, suite_units, training_units

REPORTED = 2  # flights of each unit that are saved for the report where not all are asked for


class Watcher(Protocol):
    """Who follows a sweep."""

    def trained(self, finished: int, total: int) -> None:
        """So many of the networks are there; called before the first, too, if there are any."""

    def ready(self, left: Sequence[Unit]) -> None:
        """All is checked, and networks are trained: these blocks of flights are going to fly."""

    def moved(self, block: Unit) -> None:
        """A block of flights was flown just now, here or elsewhere."""

    def flown(self, unit: Unit, found: Evaluation) -> None:
        """With this block, all of a unit is flown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """How a suite is to be flown; the comment of a field is its documentation everywhere."""

    engine: str = (
        "processes"  # or "ray" or "dask", or "folder": everybody who calls `quad-envs worker OUT` takes part
    )
    jobs: int | None = None  # units flown at a time; one here, all that a cluster has, if not given
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
        *,
        joins: bool = False,  # a sweep that another process has begun
    ) -> None:
        self.suite, self.failed, self.folder, self.order = suite, failed, folder, order
        home = Path(order.networks or (folder or Path()) / "networks").absolute()
        self.to_train = training_units(suite, home)
        saved = 0 if folder is None else suite.episodes if order.save_episodes else REPORTED
        self.units = with_given(suite_units(suite, saved, home), given)
        if folder is not None and order.fresh:
            discard(folder)
        about = {"save_episodes": order.save_episodes, "networks": str(home), "engine": order.engine}
        self.store = Store(folder, suite, order.save_episodes, None if joins else about)
        self.crew = crew_of(order.engine, order.jobs, self.store)
        self.parts: dict[int, list[Evaluation]] = {}  # blocks that are flown, by the number of their unit
        self.flown: dict[int, Evaluation] = {}  # whole units
        self.trained: dict[int, dict[str, Any]] = {}

    def go(self) -> None:
        """Train, then fly what is left; each block of flights is stored at once."""
        self._report()
        for number in self.failed:
            self._warn(number)
        self._train()
        blocks = self.crew.order(self._left())
        self._report()
        watcher = self.order.watcher
        if watcher is not None:
            watcher.ready([block.part for block in blocks])
        for block, found in self.crew.flights(blocks):
            if isinstance(found, str):
                self._fail(block.unit.number, found)
            else:
                self._add(block.unit, found)
            self._report()
            if watcher is not None:
                watcher.moved(block.part)
                if block.unit.number in self.flown:
                    watcher.flown(block.unit, self.flown[block.unit.number])

    def _train(self) -> None:
        watcher, count = self.order.watcher, len(self.to_train)
        if watcher is not None and self.to_train:
            watcher.trained(0, count)
        for number, training in self.crew.trainings(self.to_train):
            if "failure" in training:
                self._lose(self.to_train[number], training["failure"])
                continue
            self.trained[number] = training
            self._report()
            if watcher is not None:
                watcher.trained(len(self.trained), count)

    def _left(self) -> list[Block]:
        """Blocks of flights that are not stored."""
        left = []
        for unit in self.units:
            if unit.number not in self.failed:
                stored = self.store.found(unit)
                for part in stored:
                    self._add(unit, part)
                left += [Block(unit, part) for part in blocks_left(unit, stored)]
        return left

    def _add(self, unit: Unit, part: Evaluation) -> None:
        """A block is there; with the last one its unit is whole."""
        parts = self.parts.setdefault(unit.number, [])
        parts.append(part)
        found = Evaluation.joined(parts, unit.starts)  # a folder may hold others, too
        if found.flights == unit.episodes:
            self.flown[unit.number] = found

    def _report(self) -> None:
        if self.order.on_unit is not None:
            self.order.on_unit(self.done, len(self.to_train) + len(self.units))

    def _lose(self, training: TrainingUnit, why: str) -> None:
        """Nothing flies that needs this network, or what was to be tuned."""
        what = "trained" if training.policy.train is not None else "tuned"
        for unit in self.units:
            if unit.policy is training.policy and unit.policy_name == str(training.folder):
                self._fail(unit.number, f"it could not be {what}: {why}")

    def _fail(self, number: int, why: str) -> None:
        """A unit is not to be had; of one in several blocks this is said once."""
        if number not in self.failed:
            self.failed[number] = why
            self._warn(number)

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
            tuple(self.flown[unit.number] for unit in flown),
            tuple(self.trained.get(unit.number, {}) for unit in self.to_train),
            failures,
        )
        if self.folder is not None:
            _write_tables(self.folder, results)
        return results


def _write_tables(folder: Path, results: Results) -> None:
    """The tables of a finished run."""
    write_csv(folder / "summary.csv", results.summary())
    write_csv(folder / "results.csv", results.each_row(), results.row_columns())
    (folder / FAILURES).unlink(missing_ok=True)
    if results.failures:
        write_json(folder / FAILURES, [failure._asdict() for failure in results.failures])
    if results.suite.learned:
        write_csv(folder / "contenders.csv", results.contender_rows())
