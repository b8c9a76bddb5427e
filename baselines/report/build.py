"""From a results folder to the report: leaderboards, and as many flights as a page of 3 MB can hold."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from baselines.errors import ResultsError
from baselines.evaluation.evaluate import NO_SPANNING_TREE
from quad_envs.names import unknown_name

from ..sweeps.folder import Finished, Run, read_contenders
from .leaderboard import contender_board, leaderboard
from .model import PAGE_FORMAT, Environment, Report
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
        environments = [entry for entry in environments if entry[0].title == wanted["env"]]
    contenders = read_contenders(run.folder)
    boards = []
    for env, results, here in environments:
        columns, rows = leaderboard(results.summary(), results.base_of(env.title))
        trees = [one.evaluation.spanning_tree for one in here]
        note = NO_SPANNING_TREE if False in trees else ""
        base, compared = results.base_of(env.title), contender_board(contenders.get(env.title, ()))
        boards.append(
            Environment(env.title, env.id, env.kwargs, here[0].task, base, note, columns, rows, (), compared)
        )
    notes, provenance = _notes_of_run(run), _provenance(run)
    bare = Report(PAGE_FORMAT, run.suite.name, provenance, notes, tuple(boards), (), wanted)
    room = PAGE_BYTES - len(render_page(bare).encode())
    shelf = fill_shelf(
        [here for _, _, here in environments], room, None if wanted is None else wanted["seed"]
    )
    shown = (env._replace(flights=found) for env, found in zip(boards, shelf.flights, strict=True))
    return bare._replace(notes=(*notes, *shelf.notes), environments=tuple(shown), blobs=shelf.blobs.texts())


def _starts(here: Sequence[Finished]) -> list[int]:
    """Seeds of which some policy has saved its flight."""
    return sorted({seed for one in here for seed in one.flights()})


def _resolve(run: Run, choice: Choice) -> dict[str, Any]:
    """The chosen flight, with everything that was left open."""
    found = run.environments()
    names = [env.title for env, _, _ in found]
    matching = [entry for entry in found if choice.env in ("", entry[0].title, entry[0].id)]
    if not matching:
        raise ResultsError(unknown_name("environment of this run", choice.env, names))
    env, _, here = next((entry for entry in matching if _starts(entry[2])), matching[0])
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
        "policies": {policy.title: {"name": policy.name, **policy.kwargs} for policy in suite.policies},
    }
