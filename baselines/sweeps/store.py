"""The results folder as a sweep writes it: blocks of flights, each with the digest of what it depends on."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import ResultsError
from ..evaluation.evaluate import Evaluation
from ..files import (
    RESULTS_FORMAT,
    plain_json,
    provenance,
    read_json,
    refuse_foreign,
    write_atomic,
    write_json,
)
from .inputs import digest_of, read_files, repeatable
from .protocol import protocol_facts, refuse_other_version
from .shared import CLAIMS
from .suite import Suite
from .units import Unit

BLOCK = 500  # flights at most that are stored, and lost, together
CELLS, EPISODES = "cells", "episodes"  # folders
_MIXING = ("numpy", "numba", "scipy")  # packages whose versions change numbers


class Cell(NamedTuple):
    """A file of the folder: flights of one unit from consecutive starts."""

    path: Path
    digest: str
    starts: range

    @classmethod
    def at(cls, path: Path) -> Cell:
        """What the name of a file says."""
        _, digest, first, count = path.stem.rsplit("-", 3)
        return cls(path, digest, range(int(first), int(first) + int(count)))


class Stored(NamedTuple):
    """What a cell holds."""

    found: Evaluation
    task: dict[str, Any]  # its parameters
    flights_saved: int  # the first ones


def read_cell(path: Path) -> Stored:
    """Read a cell.

    Raises:
        ResultsError: If it is none of ours, or damaged.
    """
    cell = read_json(path)
    try:
        return Stored(Evaluation.from_plain(cell["found"]), dict(cell["task"]), int(cell["flights_saved"]))
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ResultsError(
            f"{str(path)!r} is not a finished unit ({error!r}); delete it to fly this unit again"
        ) from error


def cells_of(folder: Path, unit: Unit) -> list[Cell]:
    """The stored blocks of a unit, by their starts."""
    found = []
    for path in (folder / CELLS).glob(f"{unit.name}-*.json"):
        try:
            found.append(Cell.at(path))
        except ValueError as error:
            raise ResultsError(f"{str(path)!r} is no file of ours; move it away") from error
    return sorted(found, key=lambda cell: cell.starts.start)


class Store:
    """What of a suite is in its folder; without a folder, nothing.

    Args:
        folder: The results folder, which is begun if it is empty; None to keep nothing.
        suite: Whose results it holds. More or fewer flights are no other suite.
        all_flights: Whether a block counts only if each of its flights was saved.
        about: What config.json says besides. None: another process has begun the sweep, and this one joins,
            which deletes nothing.

    Raises:
        ResultsError: If the folder holds something else, or was begun with other sources or versions.
    """

    def __init__(
        self, folder: Path | None, suite: Suite, all_flights: bool, about: Mapping[str, Any] | None
    ) -> None:
        self.folder, self._all_flights, self._joins = folder, all_flights, about is None
        self._digests: dict[int, str] = {}  # by the number of the unit
        if folder is not None:
            _begin(folder, suite, about)

    def found(self, unit: Unit) -> list[Evaluation]:
        """The stored blocks of a unit; those that no longer stand for it are deleted."""
        if self.folder is None:
            return []
        files = read_files(unit)
        digest = self._digests[unit.number] = digest_of(unit, files)
        kept, changed = [], False
        for cell in cells_of(self.folder, unit):
            changed |= cell.digest != digest
            good = (repeatable(unit) or self._joins) and cell.digest == digest
            if not good or not self._complete(unit, cell):
                if self._joins:
                    continue
                cell.path.unlink()
                for seed in cell.starts:
                    (self.folder / EPISODES / unit.episode_name(seed)).unlink(missing_ok=True)
            else:
                kept.append(read_cell(cell.path).found)
        if changed and not self._joins:
            what = ", ".join(files) or "files that are gone"
            text = (
                f"{unit.policy.title!r} flies again in {unit.env.title!r}: what it reads has changed ({what})"
            )
            warnings.warn(text, stacklevel=5)
        return kept

    def _complete(self, unit: Unit, cell: Cell) -> bool:
        """Whether every flight was saved, where each is wanted."""
        assert self.folder is not None
        episodes = self.folder / EPISODES
        return not self._all_flights or all((episodes / unit.episode_name(k)).exists() for k in cell.starts)

    def keep(self, unit: Unit, block: Unit, flown: Mapping[str, Any]) -> None:
        """Store a block that has been flown: its flights, then the cell that stands for them."""
        if self.folder is None:
            return
        for name, content in flown["flights"].items():
            write_atomic(self.folder / EPISODES / name, content)
        write_json(self.folder / CELLS / f"{self.name_of(unit, block)}.json", flown["cell"])

    def name_of(self, unit: Unit, block: Unit) -> str:
        """Name of the cell of a block."""
        return f"{unit.name}-{self._digests[unit.number]}-{block.seed}-{block.episodes}"

    def fail(self, unit: Unit, block: Unit, why: str) -> None:
        """Say to others at this folder that a block is not to be had."""
        assert self.folder is not None
        write_json(self.folder / CELLS / f"{self.name_of(unit, block)}.failed", why)

    def outcome(self, unit: Unit, block: Unit) -> Evaluation | str | None:
        """What has become of a block, by whomever: its flights, why it failed, or None."""
        assert self.folder is not None
        path = self.folder / CELLS / f"{self.name_of(unit, block)}.json"
        if path.exists():
            return read_cell(path).found
        failed = path.with_suffix(".failed")
        return str(read_json(failed)) if failed.exists() else None


def blocks_left(unit: Unit, stored: Sequence[Evaluation]) -> Iterator[Unit]:
    """The starts that no stored block has, in blocks; decisions are timed in the first one alone."""
    have = {seed for one in stored for seed in range(one.seed, one.seed + one.flights)}
    left = [seed for seed in unit.starts if seed not in have]
    while left:
        count = 1
        while count < min(len(left), BLOCK) and left[count] == left[0] + count:
            count += 1
        timed = None if left[0] == unit.seed else ()
        yield unit._replace(seed=left[0], episodes=count, timed=timed)
        del left[:count]


def _begin(folder: Path, suite: Suite, about: Mapping[str, Any] | None) -> None:
    """Check that what is there is this suite's; who does not join writes config.json."""
    refuse_foreign(folder)
    config, asked = folder / "config.json", plain_json(suite.to_dict())
    now, facts = provenance(), protocol_facts(suite)
    if config.exists():
        stored = read_json(config)
        refuse_other_version(folder, stored, suite)
        _refuse_other(folder, stored, asked, now)
    if about is not None:
        for path in (*folder.glob(f"{CELLS}/*.failed"), *folder.glob(f"{CLAIMS}/*.json")):
            path.unlink()  # of an earlier run: what failed is tried again
        said = {"format": RESULTS_FORMAT, "suite": asked, **about}
        write_json(config, {**said, **({"protocol": facts} if facts else {}), **now})


def _refuse_other(
    folder: Path, stored: Mapping[str, Any], asked: Mapping[str, Any], now: Mapping[str, Any]
) -> None:
    remedy = "choose another folder, or discard it with fresh=True (--fresh)"
    if stored.get("format", 1) != RESULTS_FORMAT:
        raise ResultsError(f"{str(folder)!r} was begun by another version, in another format; {remedy}")
    before = stored.get("suite") or {}
    differing = [key for key, value in asked.items() if key != "episodes" and before.get(key) != value]
    if differing:
        raise ResultsError(
            f"{str(folder)!r} holds another suite (it differs in {', '.join(differing)}); {remedy}"
        )
    if stored.get("source") != now["source"]:
        raise ResultsError(
            f"{str(folder)!r} was begun with other sources, revision {stored.get('git_revision')}: their "
            f"numbers do not mix; {remedy}"
        )
    versions = stored.get("versions") or {}
    for name in _MIXING:
        if versions.get(name) != now["versions"][name]:
            raise ResultsError(
                f"{str(folder)!r} was begun with {name} {versions.get(name)}, and here is "
                f"{now['versions'][name]}: their numbers do not mix; {remedy}"
            )
