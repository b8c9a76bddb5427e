"""The dissertation's tables and claims, each beside what this implementation gives."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from quad_envs.names import unknown_name

from ..results import write_atomic
from . import estimation_claims, estimation_tables, formation_claims, formation_tables, target_claims
from .regulation_claims import REGULATION_CLAIMS
from .results import Section
from .tables import table_4_1, table_4_2
from .tracking_claims import TRACKING_CLAIMS


def claims_4(jobs: int = 1) -> Section:
    """The claims of chapter 4 and of section 9.2."""
    claims = [claim(jobs) for claim in (*TRACKING_CLAIMS, *REGULATION_CLAIMS)]
    return Section("claims-4", "Claims of chapter 4 (and of section 9.2)", [], claims)


def _unprinted(chapter: int) -> str:
    """Chapters 5 to 7 show figures alone: there are claims to test, and a prototype to compare with."""
    return (
        f"Claims of chapter {chapter} (it prints no numbers, its figures are images; "
        "beside ours those of an independent prototype)"
    )


def claims_5(jobs: int = 1) -> Section:
    """The claims of chapter 5 on formation flight."""
    return Section("claims-5", _unprinted(5), formation_tables.tables(jobs), formation_claims.claims(jobs))


def claims_6(jobs: int = 1) -> Section:
    """The claims of chapter 6 on cooperative estimation; batched, so that `jobs` changes nothing."""
    return Section("claims-6", _unprinted(6), estimation_tables.tables(), estimation_claims.claims())


def claims_7(jobs: int = 1) -> Section:
    """The claims of chapter 7 on both together."""
    return Section("claims-7", _unprinted(7), target_claims.table(jobs), target_claims.claims(jobs))


SECTIONS: dict[str, Callable[[int], Section]] = {
    "table-4.1": table_4_1,
    "table-4.2": table_4_2,
    "claims-4": claims_4,
    "claims-5": claims_5,
    "claims-6": claims_6,
    "claims-7": claims_7,
}


def sections(what: Sequence[str] = (), jobs: int = 1) -> Iterator[Section]:
    """The sections that are asked for, each as soon as it is flown.

    Args:
        what: Names in SECTIONS; none, or "all", for all of them.
        jobs: Flights in parallel, >= 1. Decision times are measured one flight at a time whatever it is.

    Raises:
        ValueError: If a name is unknown or jobs < 1; at once, before the first section.
    """
    for name in what:
        if name != "all" and name not in SECTIONS:
            raise ValueError(unknown_name("table or claims", name, [*SECTIONS, "all"]))
    if isinstance(jobs, bool) or not isinstance(jobs, int) or jobs < 1:
        raise ValueError(f"jobs must be a whole number >= 1, got {jobs!r}")
    names = list(SECTIONS) if not what or "all" in what else list(dict.fromkeys(what))
    return (SECTIONS[name](jobs) for name in names)


def reproduce(what: Sequence[str] = (), jobs: int = 1) -> list[Section]:
    """Reproduce tables and claims; see `sections`."""
    return list(sections(what, jobs))


def run(what: list[str], out: Path | None, as_json: bool, jobs: int) -> int:
    """The command: print the sections, and write them to `out`/reproduce.json where given."""
    asked = sections(what, jobs)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    found = []
    for section in asked:
        found.append(section)
        if not as_json:
            print(section, end="\n\n", flush=True)
    text = json.dumps({"sections": [section.to_dict() for section in found]}, indent=2) + "\n"
    if as_json:
        sys.stdout.write(text)
    if out is not None:
        write_atomic(out / "reproduce.json", text.encode())
    return 0
