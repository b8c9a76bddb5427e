"""What a network must be for a training to go on from it: layers, squash, and what it sees."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from quad_envs.observations.features import Features, default_features
from quad_envs.tasks import Task, TeamTask

from ..policies.disturbance_estimate import sees_estimate, with_estimate
from ..policies.network import Network, Squash

# Part of an observation -> how a training comes to see as many rows of it as the network.
_REMEDIES = {
    "comm": "choose a graph in which a vehicle hears as many others (graph=)",
    "sensed": "pass sensed={0}",
    "preview": "give the same stages (--hyper stages=[{1}])",
    "measured": "choose the graph and the sensor that it was trained with",
    "estimate": "choose the graph and the sensor that it was trained with",
    "disturbance_estimate": "let the training see it, too (--hyper disturbance_estimate=true)",
}
_ELSE = "begin with a network of the same task and limits"


def with_estimate_inputs(network: Network, task: Task | TeamTask) -> Network:
    """The network with inputs for an estimate of the disturbance, to which it does not listen yet.

    Args:
        network: What it decides stays as it is; one that has such inputs is returned as it is.
        task: Where it is to be trained.
    """
    seen = network.features
    if sees_estimate(seen):
        return network
    more, before = default_features(with_estimate(task).layout), len(default_features(task.layout).names)
    features = replace(
        seen,
        names=seen.names + more.names[before:],
        mean=seen.mean + more.mean[before:],
        scale=seen.scale + more.scale[before:],
    )
    first, *rest = network.weights
    deaf = np.zeros((len(features.names) - len(seen.names), first.shape[1]), dtype=np.float32)
    return replace(network, features=features, weights=(np.concatenate([first, deaf]), *rest))


def require_continuable(
    network: Network, features: Features, net_arch: tuple[int, ...], outputs: int, squash: Squash
) -> None:
    """Check that a training can go on from a network.

    Args:
        network: To begin with.
        features: That the training sees.
        net_arch: Widths of its hidden layers.
        outputs: Numbers that it gives.
        squash: How they come into [-1, 1].

    Raises:
        ValueError: If not; the message names the first difference, and the remedy.
    """
    theirs, ours = _rows(network.features.names), _rows(features.names)
    for part in [*theirs, *(name for name in ours if name not in theirs)]:
        if theirs.get(part) != ours.get(part):
            raise ValueError(_unlike(part, theirs.get(part, ()), ours.get(part, ())))
    sizes = (len(features.names), *net_arch, outputs)
    shapes = list(pairwise(sizes))
    found = [tuple(W.shape) for W in network.weights]
    kinds = (network.squash, network.activation, str(network.command_range))
    own = (squash, "tanh", "1.0")
    if found != shapes or kinds != own:
        raise ValueError(
            f"cannot go on from layers {found} ({', '.join(kinds)}) with layers {shapes} "
            f"({', '.join(own)}): give the same net_arch and squash"
        )
    if network.features != features:
        raise ValueError(
            "cannot go on from a network that sees other features, or scales them otherwise: begin with one "
            "of the same task, preview and stages"
        )


def _rows(names: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """Part -> its rows that are seen, as "0", "2"; of a part that is one row, its entries."""
    found: dict[str, dict[str, None]] = {}
    for name in names:
        part, _, rest = name.partition("[")
        found.setdefault(part, {})[rest.partition("]")[0]] = None
    return {part: tuple(rows) for part, rows in found.items()}


def _unlike(part: str, theirs: tuple[str, ...], ours: tuple[str, ...]) -> str:
    """What to say of a part of which a network sees other rows than the training."""
    remedy = _REMEDIES.get(part, _ELSE).format(len(theirs), ", ".join(theirs))
    sees = f"rows {', '.join(theirs)} of {part!r}" if theirs else f"nothing of {part!r}"
    here = f"rows {', '.join(ours)}" if ours else "nothing of it"
    return f"cannot go on from a network that sees {sees}, where this training sees {here}: {remedy}"
