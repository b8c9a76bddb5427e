"""Files and names that somebody made to break things: refused by name, or harmless; no code of them runs."""

from __future__ import annotations

import json
import os
import pickle
import random
import re
import shutil
import struct
import tempfile
import warnings
from collections.abc import Iterator
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from baselines import CheckpointError, ResultsError, load_suite, make_policy, run_benchmark
from baselines.policies.trained import SHIPPED
from baselines.report import render_report
from baselines.sweeps.folder import read_run

from .found import Found, tried

HELIX = "quad/HelixTracking-v0"
_RAN = "ran"  # a file that code of a malformed one would make
_HOSTILE = (
    *("<script>ran()</script>", "</script><script>ran()</script>", "<img src=x onerror=ran()>", "'\"><b>"),
    *("--><svg onload=ran()>", "javascript:ran()", "\u2028</script>", "{{7*7}}", "${ran()}", "]]>"),
)
_TEXTS = (b"", b"null", b"[]", b"{", b"[" * 100_000, b'{"format": 1e400}', b"\xff\xfe\x00", b"\x00" * 4096)


class _Runs:
    """Makes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return (os.mkdir, (str(self._path),))


def malformed(seed: int) -> Iterator[Found]:
    """Malformed things without end: checkpoints, suites, tables of a results folder, names on a page."""
    with tempfile.TemporaryDirectory() as place, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        home = Path(place)
        env = gymnasium.make(HELIX)
        run_benchmark(
            {"envs": [{"id": HELIX, "kwargs": {"time_limit": 0.5}}], "policies": ["hover"], "episodes": 2},
            home / "run",
        )
        for k in count():
            rng, here = random.Random(f"{seed} {k}"), home / "here"
            shutil.rmtree(here, ignore_errors=True)
            kinds = (
                ("checkpoint", partial(_checkpoint, rng, here, env)),
                ("suite", partial(_suite, rng, here)),
                ("table", partial(_table, rng, home / "run", here)),
                ("name", partial(_name, rng, here)),
            )
            what, run = kinds[k % len(kinds)]
            found = tried(what, run)
            if (home / _RAN).exists() or Path(_RAN).exists():
                found = Found(1, (*found.wrong, f"{what}: its code was run"))
            yield found


def _spoil(rng: random.Random, path: Path) -> str:
    """Change a file in one of many ways; says how."""
    data = bytearray(path.read_bytes())
    how = rng.randrange(7)
    if how == 0:
        data = data[: rng.randrange(len(data))]
        said = f"cut to {len(data)} bytes"
    elif how == 1:
        at = rng.randrange(len(data))
        data[at] ^= 1 << rng.randrange(8)
        said = f"a bit of byte {at}"
    elif how == 2:
        data = bytearray(rng.choice(_TEXTS))
        said = f"replaced by {bytes(data[:20])!r}"
    elif how == 3:
        data[:8] = struct.pack("<Q", rng.choice([0, 2**63, 2**40, len(data) * 2]))
        said = "a length that is none"
    elif how == 4:
        data = bytearray(pickle.dumps(_Runs(path.parents[1] / _RAN)))
        said = "a pickle"
    elif how == 5:
        at = rng.randrange(len(data))
        data[at : at + rng.randrange(1, 40)] = bytes(rng.randrange(256) for _ in range(rng.randrange(40)))
        said = f"bytes at {at}"
    else:
        return _replaced(rng, path)
    path.write_bytes(bytes(data))
    return said


def _replaced(rng: random.Random, path: Path) -> str:
    """In place of a file a folder, a pipe, a link to nowhere or to itself; or a number that is none."""
    how = rng.randrange(5)
    text = path.read_bytes()
    path.unlink()
    if how == 0:
        path.mkdir()
    elif how == 1:
        os.mkfifo(path)
    elif how == 2:
        path.symlink_to(path.parent / "nowhere")
    elif how == 3:
        path.symlink_to(path)
    else:
        numbers = list(re.finditer(rb"-?\d+\.\d+", text))
        if numbers:
            one = rng.choice(numbers)
            wrong = rng.choice([b"NaN", b"1e400", b'"x"', b"-1e308", b"null", b"[]"])
            text = text[: one.start()] + wrong + text[one.end() :]
        path.write_bytes(text)
    return f"kind {how} of what is no such file"


def _checkpoint(rng: random.Random, here: Path, env: Any) -> str:
    shutil.copytree(SHIPPED / "apg-helix", here)
    how = _spoil(rng, here / rng.choice(["network.safetensors", "policy.json"]))
    try:
        policy = make_policy(here, env)
    except CheckpointError as error:
        return "" if 0 < len(str(error)) < 2000 else f"{how}: a message of {len(str(error))} characters"
    observation, _ = env.reset(seed=0)
    action, _ = policy.predict(observation[None])
    return "" if np.isfinite(action).all() and (np.abs(action) <= 1.0).all() else f"{how}: {action}"


def _suite(rng: random.Random, here: Path) -> str:
    here.mkdir()
    path = here / "suite.toml"
    path.write_text(f'envs = ["{HELIX}"]\npolicies = ["hover", "lqr"]\nepisodes = 2\nseed = 3.0\n')
    how = _spoil(rng, path)
    try:
        load_suite(path)
    except ValueError as error:
        return "" if 0 < len(str(error)) < 2000 else f"{how}: a message of {len(str(error))} characters"
    except OSError as error:
        return "" if error.filename else f"{how}: {error}"
    return ""


def _table(rng: random.Random, run: Path, here: Path) -> str:
    shutil.copytree(run, here)
    files = sorted(path for path in here.rglob("*") if path.suffix in (".json", ".npz", ".csv"))
    path = rng.choice(files)
    how = f"{path.name}: {_spoil(rng, path)}"
    try:
        page = render_report(read_run(here))
    except ResultsError as error:
        return "" if 0 < len(str(error)) < 2000 else f"{how}: a message of {len(str(error))} characters"
    return "" if page.endswith("</html>\n") else f"{how}: half a page"


def _name(rng: random.Random, here: Path) -> str:
    """A hostile label of an environment, a policy or a suite stands on the page as text."""
    label = rng.choice(_HOSTILE) + rng.choice(["", " ", rng.choice(_HOSTILE)])
    suite: dict[str, Any] = {
        "name": rng.choice(["s", label]),
        "envs": [{"id": HELIX, "kwargs": {"time_limit": 0.1}, "label": rng.choice(["e", label])}],
        "policies": [{"name": "hover", "label": label}],
        "episodes": 1,
    }
    try:
        run_benchmark(suite, here)
    except ValueError as error:
        return "" if str(error) else "an error without words"
    page = (here / "report.html").read_text()
    for tag in re.findall(r"<\s*(script|img|svg|b)\b[^>]*(?:onerror|onload|src)=?[^>]*>", page):
        return f"{label!r}: <{tag}> of a label on the page"
    scripts = re.findall(r"<script[^>]*>(.*?)</script>", page, flags=re.S)
    data = [text for text in scripts if text.lstrip().startswith("{")]
    if not data or not any(label in text for text in _texts(json.loads(data[0]))):
        return f"{label!r}: is not on the page"
    outside = re.sub(r"<script[^>]*>.*?</script>", "", page, flags=re.S)
    return f"{label!r}: stands in the page as it is" if label in outside and "<" in label else ""


def _texts(value: Any) -> Iterator[str]:
    """All texts in nested data, keys too."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        yield from value
        for entry in value.values():
            yield from _texts(entry)
    elif isinstance(value, list):
        for entry in value:
            yield from _texts(entry)
