"""From a results folder to the report: leaderboards, and as many flights as a page of 3 MB can hold."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from baselines.errors import ResultsError
from baselines.evaluation.evaluate import NO_SPANNING_TREE
from quad_envs.arguments.names import unknown_name

from ..sweeps.choices import TableChoice
from ..sweeps.folder import Finished, Flown, Run, read_contenders
from ..sweeps.protocol import protocol_facts
from .answer import answer
from .frontier import as_file
from .leaderboard import contender_board, leaderboard
from .model import PAGE_FORMAT, Answer, Board, Environment, Report
from .page import render_page
from .shelf import fill_shelf

PAGE_BYTES = 2_900_000  # a page stays below 3 MB


class Choice(NamedTuple):
    """The flight on which a replay opens; what is not chosen is the first there is."""

    env: str = ""  # title in the suite, or its id
    policy: str = ""  # title; the base and the best if empty
    seed: int | None = None


def render_report(run: Run, choice: Choice | None = None) -> str:
    """The page of a run; see `build_report`."""
    return render_page(build_report(run, choice))


def build_report(run: Run, choice: Choice | None = None) -> Report:
    """All that the page shows.

    Flights stand in it environment by environment and start by start, those of all policies together. If not
    even the first start of each environment fits, their rows are thinned out; the notes say so.

    Args:
        run: The folder.
        choice: To show one start of one environment only, and to begin with it.

    Raises:
        ResultsError: If what is chosen is not there.
    """
    environments = run.environments()
    wanted = None if choice is None else _resolve(run, choice)
    if wanted is not None:
        environments = [entry for entry in environments if entry.env.title == wanted["env"]]
    contenders = read_contenders(run.folder)
    boards = [_environment(run, flown, contenders.get(flown.env.title, ())) for flown in environments]
    notes, provenance = _notes_of_run(run), _provenance(run)
    answers = _answers(run, environments)
    bare = Report(PAGE_FORMAT, run.suite.name, provenance, notes, answers, tuple(boards), (), wanted)
    room = PAGE_BYTES - len(render_page(bare).encode())
    shelf = fill_shelf(
        [_to_show(flown.here) for flown in environments], room, None if wanted is None else wanted["seed"]
    )
    shown = (env._replace(flights=found) for env, found in zip(boards, shelf.flights, strict=True))
    return bare._replace(notes=(*notes, *shelf.notes), environments=tuple(shown), blobs=shelf.blobs.texts())


def _tables(run: Run) -> list[TableChoice]:
    """Of the suite; one without a label where it has none."""
    return list(run.suite.tables) or [TableChoice("")]


def _environment(run: Run, flown: Flown, compared: Sequence[Mapping[str, str]]) -> Environment:
    """All but the flights."""
    env, results = flown.env, flown.results
    base = results.base_of(env.title)
    columns, rows = leaderboard(results.summary(), base)
    trees = [one.evaluation.spanning_tree for one in flown.here]
    boards = []
    for table in _tables(run):
        board = contender_board(compared, table.label, table.about)
        if board is not None:
            boards.append(_with_flights(board, answer([run.contenders(flown.here, table.label)]), flown.here))
    return Environment(
        title=env.title,
        place=flown.place,
        condition=flown.condition,
        id=env.id,
        kwargs=env.kwargs,
        task=flown.here[0].task,
        base=base,
        note=NO_SPANNING_TREE if False in trees else "",
        columns=columns,
        rows=rows,
        answer=Answer() if boards else answer([run.contenders(flown.here)]),
        boards=tuple(boards),
    )


def _with_flights(board: Board, found: Answer, here: Sequence[Finished]) -> Board:
    """A board that names flights, of each contender those that are shown, in place of contenders."""
    flown = {one.unit.policy.contender: one.unit.policy.title for one in _to_show(here)}
    names = {flown[name]: row for name, row in board.names.items() if name in flown}
    pair = tuple(flown[name] for name in found.pair if name in flown)
    return board._replace(names=names, answer=found._replace(pair=pair))


def _answers(run: Run, environments: Sequence[Flown]) -> tuple[str, ...]:
    """Over all environments under the condition in which most were flown."""
    conditions = [flown.condition for flown in environments]
    most = max(conditions, key=conditions.count)
    here = [flown for flown in environments if flown.condition == most]
    if len(here) < 2:
        return ()
    out = []
    for table in _tables(run):
        said, _ = answer([run.contenders(flown.here, table.label) for flown in here])
        head = ", ".join(filter(None, (table.label, most)))
        out.append(f"{head[:1].upper()}{head[1:]}: {said}" if head else said)
    return tuple(filter(None, out))


def _to_show(here: Sequence[Finished]) -> list[Finished]:
    """Whose flights stand in the page: of each contender one seed, of points of the frontier none."""
    first: dict[str, Finished] = {}
    for one in here:
        if not one.unit.policy.trace:
            first.setdefault(one.unit.policy.contender, one)
    return list(first.values())


def frontier_files(report: Report) -> dict[str, str]:
    """Name of a file -> picture of the frontier, one per environment and table that has one."""
    out = {}
    for env in report.environments:
        for board in env.boards:
            if board.frontier.svg:
                out[f"frontier-{file_words(f'{env.title} {board.title}')}.svg"] = as_file(board.frontier.svg)
    return out


def file_words(title: str) -> str:
    """A title as words in the name of a file, or in an address."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


def _starts(here: Sequence[Finished]) -> list[int]:
    """Seeds of which some policy has saved its flight."""
    return sorted({seed for one in here for seed in one.flights()})


def _resolve(run: Run, choice: Choice) -> dict[str, Any]:
    """The chosen flight, with everything that was left open."""
    found = run.environments()
    names = [flown.env.title for flown in found]
    matching = [flown for flown in found if choice.env in ("", flown.env.title, flown.env.id)]
    if not matching:
        raise ResultsError(unknown_name("environment of this run", choice.env, names))
    flown = next((one for one in matching if _starts(one.here)), matching[0])
    env, here = flown.env, flown.here
    seeds = _starts(here)
    seed = choice.seed if choice.seed is not None else (seeds[0] if seeds else run.suite.seed)
    if seed not in seeds:
        known = ", ".join(map(str, seeds[:10])) + (", ..." if len(seeds) > 10 else "")
        raise ResultsError(
            f"no flight with seed {seed} is saved in {env.title!r}; saved are: {known or 'none'}. "
            "--save-episodes saves all"
        )
    policies = [one.unit.policy.title for one in here]
    if choice.policy and choice.policy not in policies:
        raise ResultsError(unknown_name(f"policy in {env.title!r}:", choice.policy, policies))
    return {"env": env.title, "seed": seed, "policy": choice.policy or None}


def _notes_of_run(run: Run) -> tuple[str, ...]:
    done, failed = len(run.finished), len(run.failures)
    if done + failed >= run.units:
        return run.failures
    incomplete = f"This run is not complete: {done} of {run.units} units (environment x policy) are finished."
    return (incomplete, *run.failures)


def _provenance(run: Run) -> dict[str, Any]:
    """What one needs to repeat the run."""
    config, suite = run.config, run.suite
    words = [str(word) for word in config.get("command", ())]
    if words and Path(words[0]).name in ("__main__.py", "quad-envs"):
        words[0] = "quad-envs"
    revision = config.get("git_revision")
    versions = config.get("versions")
    return {
        "command": shlex.join(words),
        "versions": dict(versions) if isinstance(versions, Mapping) else {},
        "revision": revision if isinstance(revision, str) else None,
        "platform": str(config.get("platform", "")),
        "first_seed": suite.seed,
        "last_seed": suite.seed + suite.episodes - 1,
        "episodes": suite.episodes,
        "protocol": protocol_facts(suite),
        "policies": {policy.title: {"name": policy.name, **policy.kwargs} for policy in suite.policies},
    }
