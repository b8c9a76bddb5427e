"""A protocol: a suite under a version that others repeat, whose starts for each purpose are disjoint."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..errors import ResultsError
from ..training.held_out import CHOOSING, HELD_OUT
from .suite import Suite
from .suite_files import load_suite, suite_names


def starts(suite: Suite) -> dict[str, str]:
    """What each range of environment seeds is for, in words."""
    return {
        "training and tuning": f"below {HELD_OUT}",
        "judging": f"{suite.seed} to {suite.seed + suite.episodes - 1}",
        "choosing while training": f"from {CHOOSING}",
    }


def require_disjoint_starts(suite: Suite) -> None:
    """Check that no training, and no choice of a network, sees a start from which a protocol judges.

    Raises:
        ValueError: If one does.
    """
    last = suite.seed + suite.episodes - 1
    if suite.protocol and not (HELD_OUT <= suite.seed and last < CHOOSING):
        raise ValueError(
            f"protocol {suite.protocol!r} judges starts {suite.seed} to {last}; they must lie in "
            f"{HELD_OUT} to {CHOOSING - 1}, since those below are for training and those above for choosing: "
            "change seed or episodes"
        )


def refuse_taken_version(suite: Suite) -> None:
    """Check that a suite of one's own does not go by the version of a protocol that comes with the package.

    Raises:
        ValueError: If it does.
    """
    if suite.protocol not in suite_names():
        return
    shipped = load_suite(suite.protocol)
    if shipped.protocol == suite.protocol and shipped.definition != suite.definition:
        raise ValueError(
            f"suite {suite.name!r} says that it is protocol {suite.protocol!r}, and has the definition "
            f"{suite.definition}, where that one has {shipped.definition}: their numbers do not compare. "
            "Give it another version (protocol = ...); for a part of that one name it, with --only"
        )


def protocol_facts(suite: Suite) -> dict[str, Any]:
    """What results say of the protocol that they are of, or a part of; nothing for another suite."""
    if not suite.protocol:
        return {}
    return {
        "version": suite.protocol,
        "definition": suite.definition,
        "flown": suite.digest,
        "whole": suite.whole,
        "starts": starts(suite),
    }


def refuse_other_version(folder: Path, stored: Mapping[str, Any], suite: Suite) -> None:
    """Check that results in a folder are not those of another protocol, or another version of it.

    Args:
        folder: Of the results.
        stored: Its config.json.
        suite: That is to be flown.

    Raises:
        ResultsError: If they are.
    """
    found = stored.get("protocol") or {}
    before, now = (found.get("version"), found.get("definition")), (suite.protocol, suite.definition)
    if not before[0] or before == now:
        return
    version = dict(stored.get("versions") or {}).get("quad-envs", "?")
    raise ResultsError(
        f"{str(folder)!r} holds results of protocol {before[0]!r}, definition {before[1]}, and asked for is "
        f"{now[0] or suite.name!r}{f', definition {now[1]}' if now[1] else ''}: numbers of two protocols do "
        f"not mix. Finish it with quad-envs {version}, which began it, choose another folder, or discard it "
        "with fresh=True (--fresh)"
    )


def check_stored(folder: Path, config: Mapping[str, Any], suite: Suite) -> None:
    """Check that the suite in a folder is what its protocol's digest says.

    Raises:
        ResultsError: If it was changed.
    """
    said = config.get("protocol")
    if said and said.get("flown") != suite.digest:
        raise ResultsError(
            f"the suite in {str(folder / 'config.json')!r} is not the one that was flown, of digest "
            f"{said.get('flown')}, but of digest {suite.digest}: it was changed, or written by another "
            "version; read it with the version that wrote it"
        )
