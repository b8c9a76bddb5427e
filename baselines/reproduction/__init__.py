"""The dissertation's tables, claims and figures, each beside what this implementation gives."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path

from quad_envs.arguments.names import unknown_name

from ..evaluation.amounts import require_jobs
from ..files import locked
from ..report.figures import house_style
from ..sweeps.progress import Progress, said_seconds
from . import estimation_claims, estimation_tables, formation_claims, formation_tables, page, target_claims
from .identification import identification
from .regulation_claims import REGULATION_CLAIMS
from .results import Section
from .store import Store
from .store import as_json as written
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
    "identification": identification,
    "claims-4": claims_4,
    "claims-5": claims_5,
    "claims-6": claims_6,
    "claims-7": claims_7,
}


FIGURE_SECTIONS = ("figures-4", "figures-5", "figures-6", "figures-7", "beyond")
# In the order of the page, after each chapter's numbers its figures: about how long each takes on one core,
# s, from whose ratios follows the estimate of the time left.
SECONDS = {
    "table-4.1": 3.0,
    "table-4.2": 1.0,
    "identification": 17.0,
    "claims-4": 145.0,
    "figures-4": 23.0,
    "claims-5": 43.0,
    "figures-5": 12.0,
    "claims-6": 5.0,
    "figures-6": 6.0,
    "claims-7": 12.0,
    "figures-7": 8.0,
    "beyond": 20.0,
}
ORDER = tuple(SECONDS)


def section_names(what: Sequence[str] = (), figures: bool = False) -> list[str]:
    """Names of the sections that are asked for, each once.

    Args:
        what: Names in ORDER; none, or "all", for all of them.
        figures: Whether there is a folder for figures; without one, "all" leaves them out.

    Raises:
        ValueError: If a name is unknown, or figures are asked for by name without a folder.
    """
    for name in what:
        if name != "all" and name not in ORDER:
            raise ValueError(unknown_name("table, claims or figures", name, [*ORDER, "all"]))
        if name in FIGURE_SECTIONS and not figures:
            raise ValueError(f"{name} is drawn into a folder: add --out DIR")
    if not what or "all" in what:
        return [name for name in ORDER if figures or name not in FIGURE_SECTIONS]
    return list(dict.fromkeys(what))


def sections(what: Sequence[str] = (), jobs: int = 1, out: Path | None = None) -> Iterator[Section]:
    """The sections that are asked for, each as soon as it is flown.

    Args:
        what: Names in ORDER; none, or "all", for all of them.
        jobs: Flights in parallel, >= 1. Decision times are measured one flight at a time whatever it is.
        out: Folder of the figures; without one, there are none.

    Raises:
        ValueError: If a name is unknown, figures have no folder, or jobs < 1; at once, before the first.
        MissingPackageError: If figures are asked for and matplotlib is not installed; at once, too.
    """
    names = section_names(what, out is not None)
    require_jobs(jobs)
    if any(name in FIGURE_SECTIONS for name in names):
        with house_style():
            pass
    return (_section(name, jobs, out) for name in names)


def _section(name: str, jobs: int, out: Path | None) -> Section:
    if name in SECTIONS or out is None:
        return SECTIONS[name](jobs)
    from .figures import draw_section

    return draw_section(name, out, jobs)


def reproduce(what: Sequence[str] = (), jobs: int = 1, out: Path | None = None) -> list[Section]:
    """Reproduce tables, claims and, where there is a folder for them, figures; see `sections`."""
    return list(sections(what, jobs, out))


def run(what: list[str], out: Path | None, as_json: bool, jobs: int, fresh: bool = False) -> int:
    """The command: print the sections, and keep them in `out` where given.

    A section that is in `out` is read and not flown again, and what is there besides stays. After each
    section `out`/reproduce.json and the page `out`/reproduction.html are written anew: what is finished is
    there whenever the run ends.

    Raises:
        ValueError: As `sections` says, or if `fresh` is asked for without a folder.
        ResultsError: If `out` is in use, holds something else, or cannot be written.
    """
    if fresh and out is None:
        raise ValueError("--fresh needs a folder: --out DIR")
    sections(what, jobs, out)  # which refuses what cannot be done
    names = section_names(what, out is not None)
    with nullcontext() if out is None else locked(out):
        store = None if out is None else Store(out, ORDER, fresh)
        found = _run(names, store, jobs, as_json)
    if as_json:
        sys.stdout.write(written(found))
    elif out is not None:
        print(f"{out / page.NAME} has it all on one page")
    elif not what or "all" in what:
        print("Figures and the page are made with --out DIR.")
    return 0


def _run(names: list[str], store: Store | None, jobs: int, quiet: bool) -> list[Section]:
    """Read or make the sections, and keep them."""
    found = {name: section for name in names if store and (section := store.read(name)) is not None}
    left = [name for name in names if name not in found]
    if store is not None:
        store.publish(left)  # now, so that a folder that cannot be written ends the run before its flights
    for section in found.values():
        if not quiet:
            print(f"{section}\n")
    out = None if store is None else store.folder
    for section in _followed((_section(name, jobs, out) for name in left), left, quiet):
        found[section.name] = section
        if store is not None:
            store.keep(section)
            store.publish([name for name in names if name not in found])
    return [found[name] for name in names]


def _followed(asked: Iterator[Section], names: list[str], quiet: bool) -> Iterator[Section]:
    """The sections, each printed unless `quiet`; a bar says which one is at work, and the time left."""
    progress, done, everything = Progress("reproduce", len(names)), 0.0, sum(SECONDS[name] for name in names)
    progress.write(f"reproduce: {', '.join(names)}; about {said_seconds(everything)}")
    try:
        for name in names:
            progress.describe(name)
            section = next(asked)
            done += SECONDS[name]
            left = progress.move(done, everything)
            if not quiet:
                progress.write(f"{section}\n", sys.stdout)
                sys.stdout.flush()
            progress.write(f"{name}: {left or 'done'}")
            yield section
    finally:
        progress.close()
