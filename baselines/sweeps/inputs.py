"""What the numbers of a unit depend on: its arguments, and the content of every file that it reads.

A result is found again by the digest of these, so that it never stands for a file that has changed since.
The files also travel with a unit to machines that do not have them.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from quad_envs.registration import TEAMS, TRACKING

from ..errors import CheckpointError
from ..policies.registry import SAFE, behind_filter, from_outside, is_trained
from ..policies.trained import SHIPPED, checkpoint_folder
from .units import Unit

Files = dict[str, dict[str, bytes]]  # a path as it is named -> relative name -> content; "" of a file itself
_READ = ("*.json", "*.safetensors")  # what policies read of their folders


def repeatable(unit: Unit) -> bool:
    """Whether a unit's inputs say all of it: not where code from outside flies, which may have changed."""
    ours = unit.env.id.removeprefix("quad_envs:") in {**TRACKING, **TEAMS}
    return ours and unit.named and (unit.policy.made is not None or not from_outside(unit.source))


def read_files(unit: Unit) -> Files:
    """The files that a unit reads: tables that its arguments name, and the folder of its policy."""
    found: Files = {}
    for text in (*_texts(unit.env.kwargs), *_texts(unit.policy.kwargs)):
        with suppress(OSError, ValueError, RuntimeError):  # no path, but some other text
            path = Path(text).expanduser()
            if path.is_file():
                found[text] = {"": path.read_bytes()}
    name = behind_filter(unit.policy_name)
    if unit.named and is_trained(name):
        with suppress(CheckpointError, OSError):  # which is said when it flies
            folder = checkpoint_folder(name)
            if folder.parent != SHIPPED:
                files = sorted({path for pattern in _READ for path in folder.glob(pattern)})
                found[name] = {path.name: path.read_bytes() for path in files}
    return found


def digest_of(unit: Unit, files: Files) -> str:
    """Digest of all inputs but the starts. Of files their content counts, and not where they are."""
    contents = sorted(
        (relative, hashlib.sha256(content).hexdigest())
        for named in files.values()
        for relative, content in named.items()
    )
    said = [unit.env.id, unit.env.kwargs, unit.policy.name, unit.policy.kwargs, contents]
    return hashlib.sha256(json.dumps(said, sort_keys=True, default=repr).encode()).hexdigest()[:12]


@contextmanager
def at_hand(unit: Unit) -> Iterator[tuple[Unit, dict[str, str]]]:
    """The unit with the files that it brought in a folder of their own; what each of them is called there."""
    if not unit.files:
        yield unit, {}
        return
    with TemporaryDirectory() as home:
        places = {}
        for number, (text, contents) in enumerate(unit.files.items()):
            place = Path(home, str(number), Path(text).name)
            for relative, content in contents.items():
                path = place / relative if relative else place
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content)
            places[text] = str(place)
        env = replace(unit.env, kwargs=_renamed(unit.env.kwargs, places), label=unit.env.title)
        kwargs = _renamed(unit.policy.kwargs, places)
        policy = replace(unit.policy, kwargs=kwargs, label=unit.policy.contender)
        name = behind_filter(unit.policy_name)
        filtered = SAFE if name != unit.policy_name else ""
        name = filtered + places.get(name, name)
        yield unit._replace(env=env, policy=policy, policy_name=name, files=None), places


def _texts(value: Any) -> Iterator[str]:
    """All texts in nested arguments."""
    if isinstance(value, str | os.PathLike):
        yield os.fspath(value)
    elif isinstance(value, Mapping):
        for entry in value.values():
            yield from _texts(entry)
    elif isinstance(value, list | tuple):
        for entry in value:
            yield from _texts(entry)


def _renamed(value: Any, places: Mapping[str, str]) -> Any:
    """Nested arguments with other paths."""
    if isinstance(value, str | os.PathLike):
        return places.get(os.fspath(value), value)
    if isinstance(value, Mapping):
        return {key: _renamed(entry, places) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_renamed(entry, places) for entry in value)
    return value
