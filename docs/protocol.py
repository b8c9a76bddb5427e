"""Writes the tables of the pages that tell what `quad-bench-2026.1` found, README among them.

    python docs/protocol.py          # the pages anew from the numbers that are published
    python docs/protocol.py RUN      # publish those of a results folder first, with its frontiers

Published are `contenders.csv` of the run, as it is, and what the run says of itself. docs/results/protocol.md
has them all, docs/results/learned.md and README the best MPC beside the best network. MkDocs does not read
this file; a test holds the pages to what it writes.
"""

from __future__ import annotations

import csv
import json
import math
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

from baselines.files import write_atomic
from baselines.report.answer import percent, rounded
from baselines.sweeps.contenders import VIOLATING, rank

PLACE = Path(__file__).parent / "results"
PAGE, NUMBERS, FACTS = (PLACE / name for name in ("protocol.md", "protocol.csv", "protocol.json"))
ANSWER, README = PLACE / "learned.md", Path(__file__).parent.parent / "README.md"
NOMINAL = "nominal"
KEPT = ("protocol", "versions", "git_revision", "platform")  # of what a run says of itself
# What README shows of it: environments and conditions.
SHOWN = [
    ("Helix", NOMINAL),
    ("Corridor", NOMINAL),
    ("Helix", "gusts"),
    ("Helix", "sensor noise"),
    ("Helix", "weak rotors, far starts"),
    ("Helix", "unseen racetrack"),
]
_BLOCK = re.compile(r"(<!-- tables: python docs/protocol.py -->\n).*?(<!-- end of tables -->)", re.DOTALL)

Row = dict[str, str]
Rows = Sequence[Row]


def publish(run: Path) -> None:
    """Take the numbers, the facts and the frontiers of a results folder.

    Raises:
        ValueError: If the folder holds no results of a protocol.
    """
    config = json.loads((run / "config.json").read_text("utf-8"))
    if not config.get("protocol"):
        raise ValueError(f"{str(run)!r} holds no results of a protocol: fly quad-bench-2026.1 into it")
    facts = {name: config[name] for name in KEPT} | {"tables": config["suite"]["tables"]}
    shutil.copyfile(run / "contenders.csv", NUMBERS)
    write_atomic(FACTS, (json.dumps(facts, indent=1) + "\n").encode())
    for old in PLACE.glob("frontier-*.svg"):
        old.unlink()
    for drawing in run.glob(f"frontier-*-{NOMINAL}-*.svg"):
        shutil.copyfile(drawing, PLACE / drawing.name.replace(f"{NOMINAL}-", ""))


def published() -> list[Row]:
    """Contenders as published, but for those that only trace the frontier."""
    with NUMBERS.open(encoding="utf-8", newline="") as file:
        return [row for row in csv.DictReader(file) if not row["trace"]]


def tables() -> str:
    """The tables as Markdown, an environment after the other."""
    facts, rows = json.loads(FACTS.read_text("utf-8")), published()
    return "\n".join([_origin(facts), *_sections(facts["tables"], rows)]) + "\n"


def _origin(facts: dict[str, Row]) -> str:
    said = facts["protocol"]
    part = "all of it" if said["whole"] else "a part of it"
    return (
        f"Flown: {part}, digest `{said['flown']}`, of definition `{said['definition']}`, at revision "
        f"{facts['git_revision'][:7]}; judged starts {said['starts']['judging']}.\n"
    )


def _sections(listed: Sequence[Row], rows: Rows) -> Iterator[str]:
    for env in dict.fromkeys(row["env"] for row in rows):
        for table in listed:
            here = [row for row in rows if row["env"] == env and row["table"] == table["label"]]
            if not here:
                continue
            yield f"## {env[0].upper()}{env[1:]}, {table['label']}\n"
            plain = [row for row in here if row["condition"] == NOMINAL]
            yield _markdown(_NUMBERS, sorted(plain, key=_rank))
            yield _conditions(here)
            picture = f"frontier-{env.lower()}-{table['label'].replace(' ', '-')}.svg"
            if (PLACE / picture).exists():
                yield f"![Score against quadratic cost, {env}, {table['label']}]({picture})\n"


def _number(row: Row, name: str) -> float:
    return float(row.get(name) or math.nan)


def _rank(row: Row) -> float:
    return -_number(row, "score")


def _spread(name: str) -> Callable[[Row], str]:
    """A mean with the half width of its interval."""

    def cell(row: Row) -> str:
        value, low, high = (_number(row, name + end) for end in ("", "_low", "_high"))
        return rounded(value, 0.5 * (high - low)) if math.isfinite(value) else ""

    return cell


def _plain(name: str, said: str) -> Callable[[Row], str]:
    def cell(row: Row) -> str:
        value = _number(row, name)
        return format(value, said) if math.isfinite(value) else ""

    return cell


def _policy(row: Row) -> str:
    return f"`{row['policy']}`"


def _minus(row: Row) -> str:
    return "" if row["policy"] == row["base"] else _spread("score_minus_base")(row)


def _crashes(row: Row) -> str:
    return f"{_number(row, 'crashed'):.0f} of {row['flights']}"


_NUMBERS: dict[str, Callable[[Row], str]] = {
    "policy": _policy,
    "score": _spread("score"),
    "minus the best MPC": _minus,
    "quadratic cost": _spread("quadratic_cost"),
    "constraint cost": _plain("constraint_cost", ".3g"),
    "violating": lambda row: percent(_number(row, "violation_share")),
    "crashes": _crashes,
    "RMS, m": _plain("position_rms", ".3f"),
    "effort, N²": _plain("effort", ".3f"),
    "decision, ms": _plain("decision_p50_ms", ".2g"),
    "made in, CPU-s": _plain("training_cpu_s", ".0f"),
}


def _markdown(columns: dict[str, Callable[[Row], str]], rows: Rows) -> str:
    """A table; columns in which nobody has a number are left out."""
    cells = {name: [cell(row) for row in rows] for name, cell in columns.items()}
    said = {name: column for name, column in cells.items() if any(column)}
    return _table(list(said), zip(*said.values(), strict=True))


def _table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    found = ["| " + " | ".join(cells) + " |" for cells in (head, *lines)]
    return "\n".join([found[0], "|---" * len(head) + "|", *found[1:]]) + "\n"


def _conditions(rows: Rows) -> str:
    """Scores under every condition, the best in bold, with the crashes and violations there were."""
    found = list(dict.fromkeys(row["condition"] for row in rows))
    if len(found) < 2:
        return ""
    flown = {(row["policy"], row["condition"]): row for row in rows}
    best = {name: min(_rank(row) for row in rows if row["condition"] == name) for name in found}

    def cell(condition: str, of: Row) -> str:
        row = flown.get((of["policy"], condition))
        return "" if row is None else _score(row, _rank(row) == best[condition])

    plain = sorted((row for row in rows if row["condition"] == NOMINAL), key=_rank)
    return _markdown({"score": _policy} | {name: partial(cell, name) for name in found}, plain)


def _score(row: Row, best: bool) -> str:
    """A score, in bold if it is the best, with the crashes and violations there were."""
    score, violating = f"{_number(row, 'score'):.3f}", _number(row, "violation_share")
    notes = [f"{_crashes(row)} crash"] * (_number(row, "crashed") > 0.0)
    notes += [f"{percent(violating)} violating"] * (violating > VIOLATING)
    score = f"**{score}**" if best else score
    return f"{score} ({', '.join(notes)})" if notes else score


def _judged(row: Row) -> tuple[float, ...]:
    """As the protocol finds its best MPC: less is better."""
    crashed = _number(row, "crashed") / float(row["flights"])
    return rank(crashed, _number(row, "violation_share"), _number(row, "score"))


def _is_mpc(row: Row) -> bool:
    return row["mpc"] == "True"


def _is_network(row: Row) -> bool:
    return bool(row["kind"]) and row["kind"] not in ("controller", "tuned", "outside")


_SIDES = {"best MPC": _is_mpc, "best network": _is_network}


def sides(cells: Sequence[tuple[str, str]], paired: bool) -> str:
    """The best MPC beside the best network in each table, as Markdown.

    Args:
        cells: Environments and conditions, one row each; those that nobody has flown are left out.
        paired: Whether to say the difference, from the same starts.
    """
    rows = published()
    labels = [label for label in dict.fromkeys(row["table"] for row in rows) if not _of_teams(label)]
    lines = []
    for env, condition in cells:
        here = [row for row in rows if (row["env"], row["condition"]) == (env, condition)]
        if here:
            found = [cell for label in labels for cell in _beside(here, label, paired)]
            lines.append([f"{env}, {condition}", *found])
    return _table(["", *[f"{label}: {side}" for label in labels for side in _SIDES]], lines)


def _beside(rows: Rows, label: str, paired: bool) -> Iterator[str]:
    """Cells of the best of each side of a table."""
    here = [row for row in rows if row["table"] == label]
    best = [min(filter(belongs, here), key=_judged, default=None) for belongs in _SIDES.values()]
    leads = min(filter(None, best), key=_judged, default=None)
    for row in best:
        minus = _minus(row) if row and paired else ""  # the best MPC is who others are compared with
        said = f"; {minus}" if minus else ""
        yield f"{_policy(row)} {_score(row, row is leads)}{said}" if row else ""


def _of_teams(label: str) -> bool:
    return label.startswith("teams")


def _all_cells() -> list[tuple[str, str]]:
    """Of single vehicles, without the means over environments, which name no best MPC."""
    told = [row for row in published() if not _of_teams(row["table"]) and row["base"]]
    return list(dict.fromkeys((row["env"], row["condition"]) for row in told))


PAGES = {
    PAGE: tables,
    ANSWER: lambda: sides(_all_cells(), paired=True),
    README: lambda: sides(SHOWN, paired=False),
}


def renewed(page: Path) -> str:
    """The text of one of PAGES with today's tables."""
    made = PAGES[page]()
    return _BLOCK.sub(lambda match: match[1] + made + match[2], page.read_text(encoding="utf-8"))


if __name__ == "__main__":
    if sys.argv[1:]:
        publish(Path(sys.argv[1]))
    for page in PAGES:
        page.write_text(renewed(page), encoding="utf-8")
        print(page)
