"""Which saved flights stand in a page: as many starts of each environment as it has room for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from baselines.evaluation.columns import Record

from ..sweeps.folder import Finished
from .flights import BadFlightError, read_flight
from .model import Flight
from .quantise import Blobs

_PER_FLIGHT = 1100  # bytes of JSON around a flight's series
_STRIDES = (1, 2, 4, 8, 16)
_NOTES = 12  # damaged flights that are listed one by one

Saved = list[tuple[Finished, Mapping[int, list[Record]]]]  # units of an environment, their flights by seed


class Shelf(NamedTuple):
    """What was taken."""

    flights: tuple[tuple[Flight, ...], ...]  # of each environment
    blobs: Blobs
    notes: tuple[str, ...]  # what was left out, in words


def fill_shelf(environments: Sequence[Sequence[Finished]], room: int, seed: int | None = None) -> Shelf:
    """Take flights until the page is full: the first start of every environment, then the second, and so on.

    The flights of all policies from one start come together or not at all. If not even the first starts fit,
    rows are thinned out, to every second, fourth, ... sample.

    Args:
        environments: Units of each.
        room: Bytes there are.
        seed: Start to take alone, where it is saved; all if None.
    """
    saved: list[Saved] = [[(one, one.flights()) for one in here] for here in environments]
    starts = [
        sorted({start for _, flights in here for start in flights if seed in (None, start)}) for here in saved
    ]
    for stride in _STRIDES:
        packer = _Packer(room, stride)
        if packer.pack(saved, starts):
            break
    notes = (
        [f"Of the flights one sample in {stride} is shown, to keep this page small."] if stride > 1 else []
    )
    if packer.left_out:
        notes.append(
            f"{packer.left_out} more saved flights are not in this page, to keep it small; quad-envs replay "
            "RUN --env ENV --seed N shows any of them."
        )
    bad = list(packer.bad)
    notes += bad[:_NOTES]
    if len(bad) > _NOTES:
        notes.append(f"{len(bad) - _NOTES} more flights are missing or damaged.")
    return Shelf(tuple(map(tuple, packer.flights)), packer.blobs, tuple(notes))


class _Packer:
    """Takes starts at one stride until they no longer fit."""

    def __init__(self, room: int, stride: int) -> None:
        self.room, self.stride, self.blobs = room, stride, Blobs()
        self.bad: dict[str, None] = {}
        self.flights: list[list[Flight]] = []
        self.count = self.left_out = 0
        self.full = False

    def pack(self, saved: Sequence[Saved], starts: Sequence[Sequence[int]]) -> bool:
        """Take what fits; whether that is at least the first start of each environment."""
        self.flights = [[] for _ in saved]
        complete = True
        for rank in range(max(map(len, starts), default=0)):
            for here, seeds, taken in zip(saved, starts, self.flights, strict=True):
                if rank < len(seeds):
                    taken += self._take(here, seeds[rank])
            complete &= rank > 0 or not self.full
        return complete

    def _take(self, here: Saved, seed: int) -> list[Flight]:
        """The flights of one start; none of them if they do not fit."""
        before, found = len(self.blobs), []
        if not self.full:
            found = [flight for one, flights in here if (flight := self._read(one, flights, seed))]
            size = self.blobs.size + (self.count + len(found)) * _PER_FLIGHT
            self.full = size > self.room
        if self.full:
            self.blobs.forget_after(before)
            self.left_out += sum(seed in flights for _, flights in here)
            return []
        self.count += len(found)
        return found

    def _read(self, one: Finished, flights: Mapping[int, list[Record]], seed: int) -> Flight | None:
        """A flight; None if it was not saved, or cannot be read, which is noted."""
        if seed not in flights:
            return None
        path, title = one.episode_file(seed), one.unit.policy.title
        try:
            return read_flight(path, title, flights[seed], one.task, self.blobs, self.stride)
        except BadFlightError as error:
            self.bad[str(error)] = None
            return None
