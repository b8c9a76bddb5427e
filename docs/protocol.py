"""Writes the tables of the pages that tell what `quad-bench-2026.1` found, README among them.

    python docs/protocol.py          # the pages anew from the numbers that are published
    python docs/protocol.py RUN      # publish those of a results folder first, with its frontiers

A run may be a part of the protocol: its environments, under the conditions in which it flew them, take the
place of what was published of them, and the others stay. Published are the rows of `contenders.csv` for each
environment, as they are, and what each run says of itself; means over environments are taken here.
docs/results/protocol.md has them all, docs/results/learned.md and README the best MPC beside the best
network. MkDocs does not read this file; a test holds the pages to what it writes.
"""

from __future__ import annotations

import csv
import json
import math
import re
import shutil
import statistics
import sys
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from baselines import load_suite
from baselines.files import write_atomic, write_csv
from baselines.report.answer import percent, rounded
from baselines.report.build import file_words
from baselines.sweeps.choices import is_for
from baselines.sweeps.contenders import ALL, VIOLATING, rank
from baselines.sweeps.suite import BEST_MPC, Suite

PLACE = Path(__file__).parent / "results"
PAGE, NUMBERS, FACTS = (PLACE / name for name in ("protocol.md", "protocol.csv", "protocol.json"))
ANSWER, README = PLACE / "learned.md", Path(__file__).parent.parent / "README.md"
NOMINAL = "nominal"
OF_A_RUN = ("git_revision", "platform", "versions")  # what is kept of what a run says of itself
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
        ValueError: If the folder holds no results of a protocol; results of another definition or of other
            starts than those that stay; or fewer policies than are published of a condition.
    """
    config = json.loads((run / "config.json").read_text("utf-8"))
    if not config.get("protocol"):
        raise ValueError(f"{str(run)!r} holds no results of a protocol: fly quad-bench-2026.1 into it")
    said = {name: config["protocol"][name] for name in ("version", "definition", "starts")}
    new = [row for row in _read(run / "contenders.csv") if row["env"] != ALL]
    places = dict.fromkeys(map(_place, new))
    envs = list(dict.fromkeys(env for env, _ in places))
    old = _read(NUMBERS) if NUMBERS.exists() else []
    stays = [row for row in old if _place(row) not in places]
    facts = json.loads(FACTS.read_text("utf-8")) if old else {"protocol": said, "runs": []}
    lost = {_cell(row) for row in old if _place(row) in places} - {_cell(row) for row in new}
    if facts["protocol"] == said and lost:
        raise ValueError(
            f"{str(run)!r} lacks {len(lost)} of the cells that are published, {', '.join(min(lost))!r} among "
            f"them: fly all of {', '.join(envs)}"
        )
    if facts["protocol"] != said and stays:
        raise ValueError(
            f"{str(run)!r} flew {said}, and published are numbers of {facts['protocol']}, which do not "
            f"compare: fly all environments again, or delete {NUMBERS.name} first"
        )
    conditions = {env: [condition for where, condition in places if where == env] for env in envs}
    flown = {"envs": conditions, "flown": config["protocol"]["flown"]}
    earlier = [one | {"envs": _left(one["envs"], places)} for one in facts["runs"]]
    runs = [*(one for one in earlier if one["envs"]), flown | {name: config[name] for name in OF_A_RUN}]
    write_atomic(FACTS, (json.dumps({"protocol": said, "runs": runs}, indent=1) + "\n").encode())
    suite = load_suite(said["version"])
    order = {env.title: k for k, env in enumerate(suite.envs)}
    under = {condition.label: k for k, condition in enumerate(suite.conditions)}
    tables = {table.label: k for k, table in enumerate(suite.tables)}
    place = lambda row: (order[row["env"]], tables[row["table"]], under[row["condition"]])  # noqa: E731
    write_csv(NUMBERS, sorted([*stays, *new], key=place))
    for env in envs:
        if NOMINAL in conditions[env]:
            _take_frontiers(run, file_words(env))


def _left(envs: Mapping[str, Sequence[str]], places: Container[tuple[str, str]]) -> dict[str, list[str]]:
    """Environments and conditions of a run that no other run has flown anew."""
    found = {env: [one for one in flown if (env, one) not in places] for env, flown in envs.items()}
    return {env: conditions for env, conditions in found.items() if conditions}


def _place(row: Row) -> tuple[str, str]:
    return row["env"], row["condition"]


def _cell(row: Row) -> tuple[str, ...]:
    return row["table"], row["env"], row["condition"], row["policy"]


def _take_frontiers(run: Path, stem: str) -> None:
    for old in PLACE.glob(f"frontier-{stem}-*.svg"):
        old.unlink()
    for drawing in run.glob(f"frontier-{stem}-{NOMINAL}-*.svg"):
        shutil.copyfile(drawing, PLACE / drawing.name.replace(f"{NOMINAL}-", ""))


def _read(path: Path) -> list[Row]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def published() -> list[Row]:
    """Contenders, but for those that only trace the frontier, and their means over environments."""
    rows = [row for row in _read(NUMBERS) if not row["trace"]]
    return [*rows, *_means(rows)]


def _means(rows: Rows) -> Iterator[Row]:
    """Of those that flew in every environment of a table under a condition, where there are several.

    Intervals of the environments are independent: half the width of their mean's is the root of the sum of
    squares, by their number.
    """
    for table, condition in dict.fromkeys((row["table"], row["condition"]) for row in rows):
        here = [row for row in rows if (row["table"], row["condition"]) == (table, condition)]
        envs = list(dict.fromkeys(row["env"] for row in here))
        for policy in dict.fromkeys(row["policy"] for row in here):
            own = [row for row in here if row["policy"] == policy]
            if 1 < len(envs) == len(own):
                yield _mean(own)


def _mean(rows: Rows) -> Row:
    first, size = rows[0], len(rows)
    minus = [_number(row, "score_minus_base") for row in rows]
    half = [_half(row) for row in rows]
    mean, width = sum(minus) / size, math.hypot(*half) / size
    same = {name: first[name] for name in ("table", "condition", "policy", "kind", "mpc")}
    summed = {name: sum(int(row[name]) for row in rows) for name in ("crashed", "flights")}
    means = {name: sum(_number(row, name) for row in rows) / size for name in ("score", "violation_share")}
    found = {
        "env": ALL,
        "environments": size,
        "base": first["policy"] if all(row["policy"] == row["base"] for row in rows) else BEST_MPC,
        "decision_p50_ms": statistics.median(_number(row, "decision_p50_ms") for row in rows),
        "score_minus_base": mean,
        "score_minus_base_low": mean - width,
        "score_minus_base_high": mean + width,
    }
    return same | {name: str(value) for name, value in (summed | means | found).items()}


def _half(row: Row) -> float:
    """Half the width of the interval of the difference from the best MPC; nothing for itself."""
    if row["policy"] == row["base"]:
        return 0.0
    return 0.5 * (_number(row, "score_minus_base_high") - _number(row, "score_minus_base_low"))


def tables() -> str:
    """The tables as Markdown, an environment after the other."""
    facts = json.loads(FACTS.read_text("utf-8"))
    suite = load_suite(facts["protocol"]["version"])
    sections = list(_sections([one.label for one in suite.tables], published()))
    titles = [line[3:].strip() for line in sections if line.startswith("## ")]
    links = " · ".join(f"[{title}](#{file_words(title)})" for title in titles)
    return "\n".join([_origin(facts, suite), f"{links}\n", *sections]) + "\n"


def _origin(facts: dict[str, Any], suite: Suite) -> str:
    """Which environments were flown at which revision, and which were not."""
    said, runs = facts["protocol"], facts["runs"]
    every = {
        env.title: [one.label for one in suite.conditions if is_for(one.envs, env)] for env in suite.envs
    }
    left = _left(every, {(env, one) for run in runs for env in run["envs"] for one in run["envs"][env]})

    def named(envs: Mapping[str, Sequence[str]]) -> str:
        """Environments, with their conditions where they are not all of them."""
        some = {env: "" if len(of) == len(every[env]) else f" ({'; '.join(of)})" for env, of in envs.items()}
        return ", ".join(f"{env}{conditions}" for env, conditions in some.items())

    missing = named(left)
    parts = [
        f"{named(run['envs'])} at revision {run['git_revision'][:7]} (digest `{run['flown']}`)"
        for run in runs
    ]
    return (
        f"Definition `{said['definition']}`, judged starts {said['starts']['judging']}. "
        f"Flown: {'; '.join(parts)}. "
        f"{f'Not flown: {missing}.' if missing else 'That is all of it.'}\n"
    )


def _sections(labels: Sequence[str], rows: Rows) -> Iterator[str]:
    for env in dict.fromkeys(row["env"] for row in rows):
        for label in labels:
            here = [row for row in rows if row["env"] == env and row["table"] == label]
            if not here:
                continue
            yield f"## {env[0].upper()}{env[1:]}, {label}\n"
            plain = [row for row in here if row["condition"] == NOMINAL]
            yield _markdown(_NUMBERS, sorted(plain, key=_rank))
            yield _conditions(here)
            picture = f"frontier-{file_words(env)}-{file_words(label)}.svg"
            if (PLACE / picture).exists():
                yield f"![Score against quadratic cost, {env}, {label}]({picture})\n"


def _number(row: Row, name: str) -> float:
    return float(row.get(name) or math.nan)


def _rank(row: Row) -> float:
    return -_number(row, "score")


def _spread(name: str) -> Callable[[Row], str]:
    """A mean with the half width of its interval."""

    def cell(row: Row) -> str:
        value, low, high = (_number(row, name + end) for end in ("", "_low", "_high"))
        said = rounded(value, 0.5 * (high - low)) if math.isfinite(value) else ""
        return said.replace(" ", "\N{NO-BREAK SPACE}")

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
    "minus the frontier": _spread("score_minus_frontier"),
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
    size = {row["condition"]: row.get("environments", "") for row in rows}
    names = {name: f"{name}, mean of {size[name]}" if size[name] else name for name in found}
    return _markdown({"score": _policy} | {names[name]: partial(cell, name) for name in found}, plain)


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
            where = f"mean of {here[0]['environments']}" if env == ALL else env
            lines.append([f"{where}, {condition}", *found])
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
    """Of single vehicles."""
    told = [row for row in published() if not _of_teams(row["table"])]
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
