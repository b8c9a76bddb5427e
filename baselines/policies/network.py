"""Networks as values: what they see of an observation, their layers, what their outputs command.

Inference is a compiled kernel, so that a shipped policy needs no torch. Training frameworks export to
`Network`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_envs.arguments.names import shown
from quad_envs.compilation.decorators import entry_of
from quad_envs.compilation.tiles import STRIP, packed
from quad_envs.observations.features import Features
from quad_envs.observations.heading import HeadingAxes
from quad_envs.parameters import Array
from quad_envs.tasks import BaseTask, Task, TeamTask
from quad_envs.wrappers.encoding import Encoding, hover_gains

from .network_kernels import BLOCK, forward_rows
from .protocol import Actions, PolicyState
from .rows import as_rows, as_starts, not_finite, require_finite, state_of, too_large

Floats = NDArray[np.float32]
Squash = Literal["tanh", "clip"]
Activation = Literal["tanh", "relu"]
Commands = Literal["hover", "action"]

_LARGEST_SEEN = 1e6  # SI, of an observation for which layers must not overflow
_forward = entry_of(forward_rows)


@dataclass(frozen=True, slots=True, eq=False)
class Network:
    """Layers over features, tanh or relu, a linear layer, and what its outputs command.

    Raises:
        ValueError: If the shapes do not fit together, a number is not finite, or a layer, the first with its
            scaling, could overflow float32.
    """

    features: Features
    weights: tuple[Floats, ...]  # each (inputs, outputs)
    biases: tuple[Floats, ...]  # each (outputs,)
    squash: Squash = "tanh"  # how outputs come into [-1, 1]
    commands: Commands = "hover"  # outputs are forces about hover, or "action": they are the actions
    activation: Activation = "tanh"  # of all layers but the last
    command_range: float = 1.0  # of outputs about hover, see `quad_envs.wrappers.encoding.Encoding`

    def __post_init__(self) -> None:
        for name, kind in (("squash", Squash), ("commands", Commands), ("activation", Activation)):
            if getattr(self, name) not in get_args(kind):
                allowed = " or ".join(map(repr, get_args(kind)))
                raise ValueError(f"{name} of a network must be {allowed}, got {shown(getattr(self, name))}")
        assert self.encoding  # it checks the range
        if not self.weights or len(self.weights) != len(self.biases):
            raise ValueError(
                f"a network needs as many weights as biases, got {len(self.weights)} and {len(self.biases)}"
            )
        n = len(self.features.names)
        if not len(self.features.mean) == len(self.features.scale) == n:
            raise ValueError("features of a network need a mean and a scale for each name")
        for k, (W, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            if W.ndim != 2 or W.shape[0] != n or b.shape != W.shape[1:]:
                raise ValueError(
                    f"layer {k} of a network must take {n} inputs, got weights {W.shape} and bias {b.shape}"
                )
            if W.dtype != np.float32 or b.dtype != np.float32:
                raise ValueError(f"layer {k} of a network must be float32, got {W.dtype} and {b.dtype}")
            if not (np.isfinite(W).all() and np.isfinite(b).all()):
                raise ValueError(f"layer {k} of a network is not finite")
            n = W.shape[1]
        for name, mean, scale in zip(
            self.features.names, self.features.mean, self.features.scale, strict=True
        ):
            if not (np.isfinite(mean) and np.isfinite(scale) and scale > 0.0):
                raise ValueError(
                    f"mean and scale of a network's feature {shown(name)} must be finite, the scale > 0, got "
                    f"{mean!r} and {scale!r}"
                )
        clip = self.features.clip
        if clip is not None and not (np.isfinite(clip) and clip > 0.0):
            raise ValueError(f"clip of a network's features must be finite and > 0, got {shown(clip)}")
        self._check_overflow()

    def _check_overflow(self) -> None:
        """Refuse layers whose sums could leave float32 for observations up to _LARGEST_SEEN."""
        most, seen = float(np.finfo(np.float32).max), self.features
        bound = _LARGEST_SEEN if seen.clip is None else seen.clip
        for k, (W, b) in enumerate(self.layers()):
            reach = bound * np.abs(W.astype(np.float64)).sum(axis=0) + np.abs(b.astype(np.float64))
            if np.all(reach < most):
                bound = 1.0 if self.activation == "tanh" else float(reach.max())
                continue
            worst = int(np.argmax((_LARGEST_SEEN + np.abs(seen.mean)) / np.asarray(seen.scale)))
            of = f"layer {k} of a network"
            if k == 0:
                name, mean, scale = (part[worst] for part in (seen.names, seen.mean, seen.scale))
                of += f" with (observation - mean) / scale: {shown(name)} has mean {mean!r}, scale {scale!r}"
            raise ValueError(f"float32 cannot hold the sums of {of}")

    def layers(self) -> list[tuple[Floats, Floats]]:
        """Weights and biases for observations as they are: scaling is a part of the first layer.

        With `features.clip` they are for scaled observations: a cut is not linear.
        """
        if self.features.clip is not None:
            return list(zip(self.weights, self.biases, strict=True))
        scale = np.asarray(self.features.scale, dtype=np.float64)
        mean = np.asarray(self.features.mean, dtype=np.float64)
        with np.errstate(over="ignore", invalid="ignore"):  # what comes of it is looked at
            W = self.weights[0] / scale[:, None]
            first = W.astype(np.float32), (self.biases[0] - mean @ W).astype(np.float32)
        return [first, *zip(self.weights[1:], self.biases[1:], strict=True)]

    @property
    def encoding(self) -> Encoding:
        """What it sees, and what its outputs span."""
        return Encoding(self.features, self.command_range)

    @property
    def outputs(self) -> int:
        """Numbers that it gives."""
        return int(self.weights[-1].shape[1])


class NetworkPolicy:
    """A network as a policy; it remembers nothing.

    Args:
        network: Its layers.
        task: Where it flies.
        name: For tables.
        kind: What it knows: "model-free", "imitation" or "model-based".

    Raises:
        ValueError: If the task's observations lack what the network sees, or its actions have another size.
    """

    decides_from = ("layout", "limits.kappa")  # of the task: what it sees, and the scale of its outputs

    def __init__(self, network: Network, task: BaseTask, name: str, kind: str = "") -> None:
        if not isinstance(task, Task | TeamTask):
            raise ValueError(f"a network needs a Task or a TeamTask, got {shown(task)}")
        size = task.action_size if isinstance(task, TeamTask) else 4
        if network.outputs != size:
            plans = isinstance(task, TeamTask) and task.layout.plan
            remedy = ": choose comm='state', networks send no plans" if plans else ""
            raise ValueError(
                f"the network gives {network.outputs} numbers, an action of this task has {size}{remedy}"
            )
        if network.commands == "hover" and size == 6:
            raise ValueError("actions of this task are estimates: a network needs commands='action'")
        self.network, self.task, self.name, self.kind = network, task, name, kind
        self._size = task.layout.size
        self._columns = network.features.columns(task.layout)
        self._axes = HeadingAxes(task.layout) if network.features.heading_axes else None
        layers = network.layers()
        self._sizes = np.array([len(self._columns), *(len(b) for _, b in layers)], dtype=np.int64)
        self._width = -(-int(self._sizes.max()) // STRIP) * STRIP
        self._weights = np.concatenate([packed(W, b) for W, b in layers])
        self._scaling = _scaling(network.features)
        self._kinds = np.array([network.activation == "relu", network.squash == "tanh"])
        hover = network.commands == "hover"
        ones = np.ones((2, 4), dtype=np.float32)
        self._gains = hover_gains(task, network.command_range, np.float32) if hover else ones

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, {self.task.env_id!r})"

    def predict(
        self,
        observation: NDArray[Any],
        state: PolicyState | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, PolicyState]:
        """Choose actions; see `Policy`.

        A row gets the same action, to the last bit, whatever rows are beside it.

        Raises:
            ValueError: If a shape is wrong, or an observation is not finite or so large that the answer is no
                number; it names the part.
        """
        obs, one = as_rows(observation, self._size)
        n = len(obs)
        if episode_start is not None:
            as_starts(episode_start, n)
        kept = _no_state(n) if state is None else state_of(state, n, 0)
        if self._axes is not None:
            require_finite(obs, self.task.layout.slices)
            obs = self._axes.turn(obs)
        actions = np.empty((n, self.network.outputs), dtype=np.float32)
        work = np.empty((2, min(n, BLOCK), self._width), dtype=np.float32)
        layers = self._sizes, self._weights, self._kinds
        bad = _forward(obs, self._columns, self._scaling, *layers, self._gains, work, actions)
        if bad >= 0:
            raise not_finite(obs, bad, self.task.layout.slices)
        if bad < -1:
            raise too_large(obs, -2 - bad, self.task.layout.slices)
        return actions[0] if one else actions, kept


def _scaling(features: Features) -> Array:
    """Rows mean, scale, clip, (3, entries), of what the first layer does not scale; (0, 0) for none."""
    if features.clip is None:
        return np.zeros((0, 0))
    return np.array([features.mean, features.scale, [features.clip] * len(features.names)])


@lru_cache(maxsize=64)
def _no_state(n: int) -> PolicyState:
    """The state of a policy that remembers nothing, shared by its calls and so read-only."""
    state = state_of(None, n, 0)
    for part in (state.memory, state.fallbacks, state.iterations, state.worst_iterations, state.left_model):
        assert part is not None
        part.setflags(write=False)
    return state
