"""Checkpoints: a folder with `network.safetensors` and `policy.json`. Loading one runs no code.

Weights travel as safetensors, never as pickles, because a pickle can run anything when it is opened.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import stat
from collections.abc import Mapping
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from quad_envs.arguments.names import shown
from quad_envs.observations.features import Features

from ..errors import CheckpointError, ResultsError
from ..files import write_atomic
from .disturbance_estimate import sees_estimate
from .network import Network

FORMAT = 4  # rises when an older suite could not read a checkpoint
_OLDEST = 1  # that this version reads
WEIGHTS, DESCRIPTION = "network.safetensors", "policy.json"
_BROUGHT = "policy"  # metadata of the weights that are the description
_LARGEST = 50_000_000  # bytes; the networks here are a thousandth of it
_PACKAGES = ("quad-envs", "numpy", "gymnasium", "torch", "stable-baselines3")


def versions() -> dict[str, str]:
    """Of Python and the packages that made a checkpoint."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def save_checkpoint(folder: str | Path, network: Network, about: Mapping[str, Any]) -> None:
    """Write a checkpoint; one that is there stays whole until the new one is complete.

    Args:
        folder: Made if need be.
        network: The network.
        about: What else to say: env_id, algorithm, kind, seed, command, score, ...

    Raises:
        CheckpointError: If the folder cannot be written.
    """
    from safetensors.numpy import save

    path = Path(folder)
    tensors = {}
    for k, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        tensors[f"{k}.weight"], tensors[f"{k}.bias"] = np.ascontiguousarray(W), np.ascontiguousarray(b)
    number = _format_of(network)
    described = {
        "format": number,
        "layers": [list(W.shape) for W in network.weights],
        "squash": network.squash,
        "commands": network.commands,
        "features": {
            "names": list(network.features.names),
            "mean": list(network.features.mean),
            "scale": list(network.features.scale),
            **({"clip": network.features.clip} if number >= 2 else {}),
            **({"heading_axes": True} if network.features.heading_axes else {}),
        },
        **({"activation": network.activation} if number >= 2 else {}),
        **({"command_range": network.command_range} if number >= 3 else {}),
        "versions": versions(),
        **about,
    }
    # The weights bring their description along, and the file beside them has their digest: where a writer
    # died between the two, what the weights bring is right.
    text = json.dumps(described)
    data = save(tensors, metadata={"format": str(described["format"]), _BROUGHT: text})
    described["digest"] = _digest(data)
    try:
        path.mkdir(parents=True, exist_ok=True)
        write_atomic(path / f"{WEIGHTS}.new", data)
        write_atomic(path / f"{DESCRIPTION}.new", (json.dumps(described, indent=1) + "\n").encode())
        os.replace(path / f"{WEIGHTS}.new", path / WEIGHTS)
        os.replace(path / f"{DESCRIPTION}.new", path / DESCRIPTION)
    except (OSError, ResultsError) as error:
        for name in (WEIGHTS, DESCRIPTION):
            with suppress(OSError):
                (path / f"{name}.new").unlink(missing_ok=True)
        raise CheckpointError(
            f"cannot write the checkpoint {str(path)!r} ({error}); the one before it, if any, is as it was"
        ) from error


def load_checkpoint(folder: str | Path) -> tuple[Network, dict[str, Any]]:
    """Read a checkpoint.

    Args:
        folder: That holds network.safetensors and policy.json.

    Returns:
        The network, and the whole of policy.json.

    Raises:
        CheckpointError: If it is not a checkpoint, of another format, truncated, or inconsistent.
    """
    path = Path(folder)
    where = f"checkpoint {str(path)!r}"
    described, tensors = _read_pair(path, where)
    try:
        features = described["features"]
        network = Network(
            features=Features(
                tuple(map(str, features["names"])),
                tuple(map(float, features["mean"])),
                tuple(map(float, features["scale"])),
                None if features.get("clip") is None else float(features["clip"]),
                bool(features.get("heading_axes", False)),
            ),
            weights=tuple(tensors[f"{k}.weight"] for k in range(len(tensors) // 2)),
            biases=tuple(tensors[f"{k}.bias"] for k in range(len(tensors) // 2)),
            squash=described["squash"],
            commands=described["commands"],
            activation=described.get("activation", "tanh"),
            command_range=float(described.get("command_range", 1.0)),
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise CheckpointError(f"{where} is not a valid network: {error}") from error
    return network, described


def _read_pair(path: Path, where: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """The description, and the weights by name."""
    if not os.path.lexists(path / DESCRIPTION) and (path / WEIGHTS).exists():
        data = _read(path / WEIGHTS, where)
        described = _brought(data, where)
    else:
        described = _checked(_read(path / DESCRIPTION, where), where, DESCRIPTION)
        data = _read(path / WEIGHTS, where)
    tensors = _read_tensors(data, where)
    if described is None:
        raise CheckpointError(f"{where}: there is no {DESCRIPTION} beside {WEIGHTS}; train again")
    if described.get("digest") != _digest(data):
        described = _brought(data, where)
    if described is None:
        raise CheckpointError(
            f"{where}: {DESCRIPTION} describes other weights than {WEIGHTS} holds; train again"
        )
    return described, tensors


def _brought(data: bytes, where: str) -> dict[str, Any] | None:
    """The description that weights bring along; None if they are of an earlier version, which has none."""
    try:
        size = int.from_bytes(data[:8], "little")
        text = json.loads(data[8 : 8 + size])["__metadata__"][_BROUGHT]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return _checked(text, where, WEIGHTS) | {"digest": _digest(data)}


def _format_of(network: Network) -> int:
    """The lowest that says all of a network.

    2 has relu layers and cut features, 3 a range of commands, 4 an estimate among
    features, or other axes.
    """
    if sees_estimate(network.features) or network.features.heading_axes:
        return 4
    if network.command_range != 1.0:
        return 3
    return 1 if network.activation == "tanh" and network.features.clip is None else 2


def _open_at_once(path: str, flags: int) -> int:
    """A pipe is opened, too, without waiting for its writer."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def _read(file: Path, where: str) -> bytes:
    """The bytes of a regular file; pipes and devices, which may have no end, are not read."""
    try:
        with open(file, "rb", opener=_open_at_once) as stream:
            if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
                raise CheckpointError(f"{where}: {file.name} is no regular file")
            data = stream.read(_LARGEST + 1)
    except OSError as error:
        remedy = f"a checkpoint is a folder with {WEIGHTS} and {DESCRIPTION}"
        if (file.parent / "config.json").exists() and not file.exists():
            remedy = "a training there has not saved a policy yet, if there is one: wait, or run it again"
        raise CheckpointError(
            f"{where}: cannot read {file.name}: {error.strerror or error}; {remedy}"
        ) from error
    if len(data) > _LARGEST:
        raise CheckpointError(
            f"{where}: {file.name} has more than {_LARGEST} bytes; no checkpoint of ours has"
        )
    return data


def _checked(text: str | bytes, where: str, name: str) -> dict[str, Any]:
    """A description of a format that this version reads."""
    try:
        described = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{where}: {name} is not valid JSON: {error}") from error
    if not isinstance(described, dict) or described.get("format") not in range(_OLDEST, FORMAT + 1):
        found = described.get("format") if isinstance(described, dict) else described
        raise CheckpointError(
            f"{where} has format {shown(found)}, this version reads {_OLDEST} to {FORMAT}: train again, or "
            "use the version of quad-envs that wrote it"
        )
    return described


def _read_tensors(data: bytes, where: str) -> dict[str, Any]:
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        return dict(load(data))
    except (SafetensorError, ValueError, KeyError) as error:
        raise CheckpointError(
            f"{where}: {WEIGHTS} is not a safetensors file, or truncated ({error}); pickles are never opened"
        ) from error


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
