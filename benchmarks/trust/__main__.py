"""Try to break things, and say how often each figure of trust was tried and how often it failed.

`python -m benchmarks.trust` tries all figures, `python -m benchmarks.trust soak kills --seconds 60` some of
them for as long, `--number 1000` each so many times. Tries are drawn from `--seed`.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

from baselines.evaluation.table import format_table

from .found import Figure
from .inputs import inputs
from .kills import kills
from .malformed import malformed
from .observations import fliers, observations
from .problems import problems
from .repeat import repeat, rows
from .soak import soak

FIGURES = {
    "soak": Figure("soak of every id with random options", 10_000_000, "steps", soak, "MB that memory grew"),
    "problems": Figure("random OCP-QPs, beside DAQP", 100_000, "problems", problems, "difference from DAQP"),
    "observations": Figure(
        f"wild observations, {len(fliers())} policies", 10_000 * len(fliers()), "decisions", observations
    ),
    "inputs": Figure("nonsense for public entries", 3000, "calls", inputs),
    "kills": Figure("commands killed and called again", 100, "kills", kills),
    "malformed": Figure("malformed files, hostile names", 200, "files", malformed),
    "repeat": Figure("same seed, same bits", 1000, "comparisons", repeat),
    "rows": Figure("networks among more flights and among fewer", 20, "comparisons", rows),
}
SECONDS = 60.0
_KEPT = 20  # failures of a figure that are said


class Outcome(NamedTuple):
    """What became of a figure."""

    figure: str
    tried: int
    failed: int
    worst: float
    seconds: float
    wrong: tuple[str, ...]


def try_out(name: str, number: int | None, seconds: float, seed: int) -> Outcome:
    """Try a figure so many times, or for so long, whichever comes first."""
    begin, tried, failed, worst = perf_counter(), 0, 0, 0.0
    wrong: list[str] = []
    for found in FIGURES[name].tries(seed):
        tried, failed, worst = tried + found.tried, failed + bool(found.wrong), max(worst, found.worst)
        wrong += found.wrong[: _KEPT - len(wrong)]
        if perf_counter() - begin >= seconds or (number is not None and tried >= number):
            break
    return Outcome(name, tried, failed, worst, perf_counter() - begin, tuple(wrong))


def table(outcomes: list[Outcome]) -> str:
    """Outcomes as they are printed."""
    rows = []
    for one in outcomes:
        figure = FIGURES[one.figure]
        worst = f"{one.worst:.1e} ({figure.worst})" if figure.worst else "-"
        asked = f"{figure.asked} {figure.unit}"
        rows.append([figure.title, asked, str(one.tried), str(one.failed), worst, f"{one.seconds:.0f}"])
    return format_table(["figure", "asked", "tried", "failed", "worst", "s"], rows)


def main() -> int:
    """Try, print the table, and what failed; 1 if something did."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.trust", description=__doc__.splitlines()[0])
    parser.add_argument("figures", nargs="*", metavar="FIGURE", help=f"of {', '.join(FIGURES)}; all if none")
    parser.add_argument(
        "--number", type=int, help="tries of each; as many as the table asks for, if not given"
    )
    parser.add_argument(
        "--seconds", type=float, default=SECONDS, help="at most for each (default %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="file that gets the outcomes, too")
    given = parser.parse_args()
    unknown = [name for name in given.figures if name not in FIGURES]
    if unknown:
        parser.error(f"unknown figure {unknown[0]!r}: there are {', '.join(FIGURES)}")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    outcomes = []
    for name in given.figures or FIGURES:
        number = FIGURES[name].asked if given.number is None else given.number
        outcomes.append(try_out(name, number, given.seconds, given.seed))
        print(
            f"{name}: {outcomes[-1].tried} tried, {outcomes[-1].failed} failed", file=sys.stderr, flush=True
        )
        for line in outcomes[-1].wrong:
            print(f"  {line}", file=sys.stderr, flush=True)
    print(table(outcomes))
    if given.json:
        given.json.write_text(json.dumps([one._asdict() for one in outcomes], indent=1) + "\n")
    return int(any(one.failed for one in outcomes))


if __name__ == "__main__":
    sys.exit(main())
