"""Writes the tables of docs/results/protocol.md from the published results of `quad-bench-2026.1`.

    python docs/protocol.py          # the page anew from the numbers that are published
    python docs/protocol.py RUN      # publish those of a results folder first, with its frontiers

Published are `contenders.csv` of the run, as it is, and what the run says of itself. MkDocs does not read
this file; a test holds the page to what it writes.
"""

from __future__ import annotations

import csv
import json
import math
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

from baselines.files import write_atomic
from baselines.report.answer import percent, rounded

PLACE = Path(__file__).parent / "results"
PAGE, NUMBERS, FACTS = (PLACE / name for name in ("protocol.md", "protocol.csv", "protocol.json"))
NOMINAL = "nominal"
KEPT = ("protocol", "versions", "git_revision", "platform")  # of what a run says of itself
_BLOCK = re.compile(r"(<!-- tables: python docs/protocol.py -->\n).*?(<!-- end of tables -->)", re.DOTALL)

Rows = Sequence[dict[str, str]]


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


def published() -> list[dict[str, str]]:
    """Contenders as published, but for those that only trace the frontier."""
    with NUMBERS.open(encoding="utf-8", newline="") as file:
        return [row for row in csv.DictReader(file) if not row["trace"]]


def tables() -> str:
    """The tables as Markdown, an environment after the other."""
    facts, rows = json.loads(FACTS.read_text("utf-8")), published()
    return "\n".join([_origin(facts), *_sections(facts["tables"], rows)]) + "\n"


def _origin(facts: dict[str, dict[str, str]]) -> str:
    said = facts["protocol"]
    part = "all of it" if said["whole"] else "a part of it"
    return (
        f"Flown: {part}, digest `{said['flown']}`, of definition `{said['definition']}`, at revision "
        f"{facts['git_revision'][:7]}; judged starts {said['starts']['judging']}.\n"
    )


def _sections(listed: Sequence[dict[str, str]], rows: Rows) -> Iterator[str]:
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


def _number(row: dict[str, str], name: str) -> float:
    return float(row.get(name) or math.nan)


def _rank(row: dict[str, str]) -> float:
    return -_number(row, "score")


def _spread(name: str) -> Callable[[dict[str, str]], str]:
    """A mean with the half width of its interval."""

    def cell(row: dict[str, str]) -> str:
        value, low, high = (_number(row, name + end) for end in ("", "_low", "_high"))
        return rounded(value, 0.5 * (high - low)) if math.isfinite(value) else ""

    return cell


def _plain(name: str, said: str) -> Callable[[dict[str, str]], str]:
    def cell(row: dict[str, str]) -> str:
        value = _number(row, name)
        return format(value, said) if math.isfinite(value) else ""

    return cell


def _policy(row: dict[str, str]) -> str:
    return f"`{row['policy']}`"


def _minus(row: dict[str, str]) -> str:
    return "" if row["policy"] == row["base"] else _spread("score_minus_base")(row)


def _crashes(row: dict[str, str]) -> str:
    return f"{_number(row, 'crashed'):.0f} of {row['flights']}"


_NUMBERS: dict[str, Callable[[dict[str, str]], str]] = {
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


def _markdown(columns: dict[str, Callable[[dict[str, str]], str]], rows: Rows) -> str:
    """A table; columns in which nobody has a number are left out."""
    cells = {name: [cell(row) for row in rows] for name, cell in columns.items()}
    said = {name: column for name, column in cells.items() if any(column)}
    lines = ["| " + " | ".join(said) + " |", "|---" * len(said) + "|"]
    lines += ["| " + " | ".join(one) + " |" for one in zip(*said.values(), strict=True)]
    return "\n".join(lines) + "\n"


def _conditions(rows: Rows) -> str:
    """Scores under every condition, the best in bold, with the crashes and violations there were."""
    found = list(dict.fromkeys(row["condition"] for row in rows))
    if len(found) < 2:
        return ""
    flown = {(row["policy"], row["condition"]): row for row in rows}
    best = {name: min(_rank(row) for row in rows if row["condition"] == name) for name in found}

    def cell(condition: str, of: dict[str, str]) -> str:
        row = flown.get((of["policy"], condition))
        return "" if row is None else _score(row, _rank(row) == best[condition])

    plain = sorted((row for row in rows if row["condition"] == NOMINAL), key=_rank)
    return _markdown({"score": _policy} | {name: partial(cell, name) for name in found}, plain)


def _score(row: dict[str, str], best: bool) -> str:
    """A score, in bold if it is the best, with the crashes and violations there were."""
    score, violating = f"{_number(row, 'score'):.3f}", _number(row, "violation_share")
    notes = [f"{_crashes(row)} crash"] * (_number(row, "crashed") > 0.0)
    notes += [f"{percent(violating)} violating"] * (violating > 0.01)
    score = f"**{score}**" if best else score
    return f"{score} ({', '.join(notes)})" if notes else score


def renewed() -> str:
    """The text of the page with today's tables."""
    return _BLOCK.sub(lambda match: match[1] + tables() + match[2], PAGE.read_text(encoding="utf-8"))


if __name__ == "__main__":
    if sys.argv[1:]:
        publish(Path(sys.argv[1]))
    PAGE.write_text(renewed(), encoding="utf-8")
    print(PAGE)
