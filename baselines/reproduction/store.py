"""The folder of a reproduction: a file per section, so that a later run goes on and takes nothing back.

config.json            versions, sources and command
sections/NAME.json     a finished section, as Python reads it
figures/               what the sections draw
reproduce.json         all finished sections
reproduction.html      the same as a page
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..errors import ResultsError
from ..files import provenance, read_json, write_atomic, write_json
from . import page
from .results import Cell, Claim, Measured, Plate, Section

_CONFIG, _ALL = "config.json", "reproduce.json"


class Store:
    """What is finished of a reproduction.

    Args:
        folder: Where it is or goes. It is locked by whoever makes a store.
        order: Names of all sections, in the order of the page.
        fresh: Whether to discard what is there.

    Raises:
        ResultsError: If the folder holds something else, or what other sources gave.
    """

    def __init__(self, folder: Path, order: Sequence[str], fresh: bool) -> None:
        self.folder, self._order = folder, order
        config, now = folder / _CONFIG, provenance()
        _refuse_foreign(folder)
        if fresh:
            for name in order:
                self._path(name).unlink(missing_ok=True)
        elif config.exists():
            _refuse_other_sources(folder, read_json(config), now["source"], bool(self.found()))
        write_json(config, {"reproduction": list(order), **now})

    def _path(self, name: str) -> Path:
        return self.folder / "sections" / f"{name}.json"

    def found(self) -> list[Section]:
        """All finished sections, in order."""
        return [section for name in self._order if (section := self.read(name)) is not None]

    def read(self, name: str) -> Section | None:
        """A finished section whose figures are there; None if there is none."""
        path = self._path(name)
        if not path.exists():
            return None
        said = read_json(path)
        try:
            section = _section(said)
        except (KeyError, TypeError) as error:
            raise ResultsError(
                f"{str(path)!r} is no section ({error!r}); delete it to fly it again"
            ) from error
        files = (self.folder / file for plate in section.plates for file in plate.files)
        return section if all(file.exists() for file in files) else None

    def keep(self, section: Section) -> None:
        """Store a section."""
        text = json.dumps(_plain(section), indent=1)  # with NaN, which Python reads back
        write_atomic(self._path(section.name), (text + "\n").encode())

    def publish(self, left: Sequence[str]) -> None:
        """Write what is finished as one file and as a page, which names what is left."""
        found = self.found()
        write_atomic(self.folder / _ALL, as_json(found).encode())
        write_atomic(self.folder / page.NAME, page.render(found, self.folder, list(left)).encode())


def as_json(found: Sequence[Section]) -> str:
    """Sections as JSON for others."""
    return json.dumps({"sections": [section.to_dict() for section in found]}, indent=2) + "\n"


def _refuse_foreign(folder: Path) -> None:
    """Check that what would be overwritten is of an earlier reproduction."""
    config = folder / _CONFIG
    if config.exists():
        said = read_json(config)
        if isinstance(said, dict) and "reproduction" in said and "source" in said:
            return
        what = _CONFIG
    else:
        found = [name for name in (_ALL, page.NAME) if (folder / name).exists()]
        if not found:
            return
        what = found[0]
    raise ResultsError(
        f"{str(folder)!r} holds a {what} that no reproduction of this version has written; choose another "
        "folder, or move it away"
    )


def _refuse_other_sources(folder: Path, said: dict[str, Any], now: str, sections: bool) -> None:
    if sections and said["source"] != now:
        raise ResultsError(
            f"{str(folder)!r} holds sections that other sources gave, revision {said.get('git_revision')}: "
            "their numbers do not mix; choose another folder, or discard them with --fresh"
        )


def _plain(section: Section) -> dict[str, Any]:
    parts = ("cells", "claims", "plates")
    return section._asdict() | {name: [one._asdict() for one in getattr(section, name)] for name in parts}


def _section(said: dict[str, Any]) -> Section:
    cells: Any = [Cell(**cell) if "printed" in cell else Measured(**cell) for cell in said["cells"]]
    plates = tuple(
        Plate(**{**plate, "claims": tuple(plate["claims"]), "files": tuple(plate["files"])})
        for plate in said["plates"]
    )
    claims = [Claim(**claim) for claim in said["claims"]]
    return Section(**{**said, "cells": cells, "claims": claims, "plates": plates})
