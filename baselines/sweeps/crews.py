"""Who trains and flies the units of a sweep, and how what they give comes into the results folder."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from ..evaluation.evaluate import Evaluation
from ..files import locked, read_json, write_atomic, write_json
from .engines import SHARED_FOLDER, run_units, tried
from .finished import begun, train_elsewhere, train_unit
from .inputs import read_files
from .shared import CLAIMS, Task, share
from .stages import price
from .store import Store
from .unit_flights import fly_unit, timed_unit
from .units import TrainingUnit, Unit


class Block(NamedTuple):
    """Flights to fly in one piece."""

    unit: Unit  # of which they are a part
    part: Unit  # the same with these starts alone


class Crew(Protocol):
    """What a sweep asks of those who do its work."""

    def trainings(self, units: Sequence[TrainingUnit]) -> Iterator[tuple[int, dict[str, Any]]]:
        """Train, and yield (number, what `train_unit` gives, or "failure") as it is there."""

    def order(self, blocks: list[Block]) -> list[Block]:
        """Blocks in the order in which they are flown."""

    def flights(self, blocks: Sequence[Block]) -> Iterator[tuple[Block, Evaluation | str]]:
        """Fly and store, and yield each block with its flights, or why there are none."""


def crew_of(engine: str, jobs: int | None, store: Store) -> Crew:
    """Those who work for an engine."""
    if engine == SHARED_FOLDER:
        assert store.folder is not None
        return Shared(store, store.folder)
    if engine == "processes":
        return Processes(store, jobs or 1)
    return Cluster(store, engine, jobs)


class Processes:
    """This process, or several of this machine."""

    def __init__(self, store: Store, jobs: int) -> None:
        self._store, self._jobs = store, jobs

    def trainings(self, units: Sequence[TrainingUnit]) -> Iterator[tuple[int, dict[str, Any]]]:
        """Train where each goes on if it has been begun."""
        return run_units(train_unit, units, "processes", self._jobs)

    def order(self, blocks: list[Block]) -> list[Block]:
        """Quick ones first if one flies after another; in parallel the long ones would be left over."""
        return quick_first(blocks) if self._jobs == 1 else blocks

    def flights(self, blocks: Sequence[Block]) -> Iterator[tuple[Block, Evaluation | str]]:
        """Fly; where several fly at a time, decisions are timed before all others take the cores."""
        parts = [block.part if self._jobs == 1 else _timed(block.part) for block in blocks]
        return _flown(self._store, blocks, parts, "processes", self._jobs)


class Cluster:
    """Machines that share nothing with this one: files go along, and come back, by value."""

    def __init__(self, store: Store, engine: str, jobs: int | None) -> None:
        self._store, self._engine, self._jobs = store, engine, jobs

    def trainings(self, units: Sequence[TrainingUnit]) -> Iterator[tuple[int, dict[str, Any]]]:
        """Train elsewhere; what was begun goes on here, where its folder is."""
        away = [unit for unit in units if not begun(unit)]
        yield from run_units(train_unit, [unit for unit in units if begun(unit)], "processes", 1)
        for number, done in run_units(train_elsewhere, away, self._engine, self._jobs):
            if "failure" in done:
                yield number, done
                continue
            folder = next(unit.folder for unit in away if unit.number == number)
            with locked(folder):
                for name, content in done["files"].items():
                    write_atomic(folder / name, content)
            yield number, done["training"]

    def order(self, blocks: list[Block]) -> list[Block]:
        """As they are."""
        return blocks

    def flights(self, blocks: Sequence[Block]) -> Iterator[tuple[Block, Evaluation | str]]:
        """Time decisions here, and fly elsewhere."""
        parts = [_timed(block.part)._replace(files=read_files(block.part)) for block in blocks]
        return _flown(self._store, blocks, parts, self._engine, self._jobs)


class Shared:
    """All processes at one results folder; this one does what nobody else is at."""

    def __init__(self, store: Store, folder: Path) -> None:
        self._store, self._folder = store, folder

    def trainings(self, units: Sequence[TrainingUnit]) -> Iterator[tuple[int, dict[str, Any]]]:
        """Train what nobody else trains, and wait for the others: flights need the networks."""
        tasks = []
        for unit in units:
            path = self._folder / CLAIMS / f"{unit.folder.name}.json"
            tasks.append(
                Task(
                    unit.number,
                    unit.folder.name,
                    partial(_read, path),
                    partial(_train, unit, path),
                    partial(_not_trained, path),
                )
            )
        return share(tasks, self._folder)

    def order(self, blocks: list[Block]) -> list[Block]:
        """Quick ones first."""
        return quick_first(blocks)

    def flights(self, blocks: Sequence[Block]) -> Iterator[tuple[Block, Evaluation | str]]:
        """Fly what nobody else flies, and read what others have flown."""
        tasks = [
            Task(
                i,
                self._store.name_of(*block),
                partial(self._store.outcome, *block),
                partial(self._fly, block),
                partial(self._not_flown, block),
            )
            for i, block in enumerate(blocks)
        ]
        for i, outcome in share(tasks, self._folder):
            yield blocks[i], outcome

    def _fly(self, block: Block) -> Evaluation | str:
        found = _kept(self._store, block, tried(fly_unit, block.part))
        return self._not_flown(block, found) if isinstance(found, str) else found

    def _not_flown(self, block: Block, why: str) -> str:
        self._store.fail(*block, why)
        return why


def quick_first(blocks: Sequence[Block]) -> list[Block]:
    """Environment by environment, the quick policies first."""
    places = {block.part.env.title: i for i, block in reversed(list(enumerate(blocks)))}
    return sorted(blocks, key=lambda block: (places[block.part.env.title], price(block.part)))


def _timed(part: Unit) -> Unit:
    return timed_unit(part) if part.timed is None else part


def _flown(
    store: Store, blocks: Sequence[Block], parts: Sequence[Unit], engine: str, jobs: int | None
) -> Iterator[tuple[Block, Evaluation | str]]:
    numbered = [part._replace(number=i) for i, part in enumerate(parts)]
    for i, flown in run_units(fly_unit, numbered, engine, jobs):
        yield blocks[i], _kept(store, blocks[i], flown)


def _kept(store: Store, block: Block, flown: dict[str, Any]) -> Evaluation | str:
    """Store what a block gave."""
    if "failure" in flown:
        return str(flown["failure"])
    store.keep(*block, flown)
    return Evaluation.from_plain(flown["cell"]["found"])


def _read(path: Path) -> Any:
    return read_json(path) if path.exists() else None


def _train(unit: TrainingUnit, path: Path) -> dict[str, Any]:
    found = tried(train_unit, unit)
    write_json(path, found)
    return found


def _not_trained(path: Path, why: str) -> dict[str, Any]:
    write_json(path, {"failure": why})
    return {"failure": why}
