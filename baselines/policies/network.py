"""Networks as values: what they see of an observation, their layers, what their outputs command.

Inference is numpy alone, so that a shipped policy needs no torch. Training frameworks export to `Network`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_envs._numba import entry_of
from quad_envs.names import shown
from quad_envs.observations.team import AgentLayout
from quad_envs.observations.tracking import N_REFERENCE, TrackingLayout
from quad_envs.parameters import Array
from quad_envs.tasks import BaseTask, Task, TeamTask

from .network_kernels import forward_rows
from .protocol import Actions, PolicyState
from .rows import as_rows, as_starts, not_finite, state_of

Floats = NDArray[np.float32]
Squash = Literal["tanh", "clip"]
Activation = Literal["tanh", "relu"]
Commands = Literal["hover", "action"]

# Preview stages that a network sees: near ones densely, the horizon of the MPCs at the end.
TRACKING_STAGES = (0, 1, 2, 3, 5, 7, 10, 14, 19, 25)
PLACES = ("observation[0]",)  # how names of places begin, see `Features`
_FEW = 4  # rows up to which the compiled form is faster
_LARGEST_SEEN = 1e6  # SI, of an observation for which layers must not overflow
_forward = entry_of(forward_rows)
# Typical size of each part, so that a network sees numbers of order one.
_SCALES = {
    "V_B": 3.0,
    "phi_theta": 0.5,
    "sin_cos_psi": 1.0,
    "Omega": 3.0,
    "F": 2.0,
    "last_command": 2.0,
    "position": 2.0,
    "disturbance": 0.5,
    "role": 1.0,
    "slot": 2.0,
}
_ROW_SCALES = {
    "preview": (2.0, 2.0, 2.0, 3.0, 3.0, 3.0, 1.0, 1.0),
    "sensed": (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
    "measured": (1.0, 5.0, 1.0, 1.0, 1.0),
    "estimate": (1.0, 2.0, 2.0, 2.0, 1.0, 1.0, 1.0, *(1.0,) * 6),
    "comm": (10.0, 1.0, *(2.0,) * 3, *(1.0,) * 3, 0.5, 0.5, 1.0, 1.0, *(2.0,) * 3, *(2.0,) * 6),
}


@dataclass(frozen=True, slots=True)
class Features:
    """Which entries of an observation a network sees, and how they are scaled: (obs - mean) / scale.

    The entries are named, so that a network for 25 preview stages can fly where there are 30. Names
    "observation[0]", "observation[1]", ... are places: of these a network sees all, where there are as many.
    """

    names: tuple[str, ...]  # "V_B[0]", "preview[5][2]", ...: part, then index in the part
    mean: tuple[float, ...]
    scale: tuple[float, ...]
    clip: float | None = None  # largest size of what is scaled, as VecNormalize cuts it; None for none

    def columns(self, layout: TrackingLayout | AgentLayout) -> NDArray[np.int64]:
        """Indices in an observation of this layout.

        Raises:
            ValueError: If the layout lacks an entry; the message names it.
        """
        if self.names[:1] == PLACES[:1]:
            if len(self.names) != layout.size:
                raise ValueError(
                    f"the network sees observations of {len(self.names)} numbers, here they have "
                    f"{layout.size}: evaluate it in a task with the layout it was trained on"
                )
            return np.arange(layout.size)
        known = {name: k for k, name in enumerate(entry_names(layout))}
        missing = [name for name in self.names if name not in known]
        if missing:
            raise ValueError(
                f"the network sees {missing[0]} (and {len(missing) - 1} more), which observations here "
                "lack: evaluate it in a task with the layout it was trained on (preview, limits, slots)"
            )
        return np.array([known[name] for name in self.names], dtype=np.int64)


def part_shapes(layout: TrackingLayout | AgentLayout) -> dict[str, tuple[int, ...]]:
    """Name -> shape of the parts of an observation, in their order."""
    if isinstance(layout, AgentLayout):
        return layout.shapes
    sizes = {name: part.stop - part.start for name, part in layout.slices.items() if name != "own"}
    return {
        name: (size // N_REFERENCE, N_REFERENCE) if name == "preview" else (size,)
        for name, size in sizes.items()
    }


def entry_names(layout: TrackingLayout | AgentLayout) -> list[str]:
    """A name for each entry of an observation."""
    return [
        name + "".join(f"[{i}]" for i in index)
        for name, shape in part_shapes(layout).items()
        for index in np.ndindex(*shape)
    ]


def preview_stages(preview: int) -> tuple[int, ...]:
    """Stages of a preview that networks see."""
    return tuple(stage for stage in TRACKING_STAGES if stage <= preview)


def default_features(layout: TrackingLayout | AgentLayout, stages: tuple[int, ...] | None = None) -> Features:
    """Everything but some preview stages, scaled to order one.

    Args:
        layout: Of the task.
        stages: Preview stages to keep; None for `preview_stages`.
    """
    stages = preview_stages(layout.preview) if stages is None else stages
    names, scale = [], []
    for name, shape in part_shapes(layout).items():
        row = _ROW_SCALES.get(name, (_SCALES.get(name, 1.0),))
        for index in np.ndindex(*shape):
            if name == "preview" and index[0] not in stages:
                continue
            names.append(name + "".join(f"[{i}]" for i in index))
            scale.append(row[index[-1] % len(row)])
    mean = [1.96 if name.startswith(("F[", "last_command[")) else 0.0 for name in names]
    return Features(tuple(names), tuple(mean), tuple(scale))


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
    commands: Commands = "hover"  # "hover": outputs are u_T (1 + output); "action": they are the actions
    activation: Activation = "tanh"  # of all layers but the last

    def __post_init__(self) -> None:
        for name, kind in (("squash", Squash), ("commands", Commands), ("activation", Activation)):
            if getattr(self, name) not in get_args(kind):
                allowed = " or ".join(map(repr, get_args(kind)))
                raise ValueError(f"{name} of a network must be {allowed}, got {shown(getattr(self, name))}")
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
    def outputs(self) -> int:
        """Numbers that it gives."""
        return int(self.weights[-1].shape[1])


def _hover_gain(task: BaseTask, dtype: Any) -> NDArray[Any]:
    """Slope of `hover_actions` above hover, of each rotor, (4,)."""
    return np.asarray(task.hover_force / (task.force_max - task.hover_force), dtype=dtype)


def hover_actions(outputs: Floats, task: BaseTask) -> Floats:
    """Actions that command u_T (1 + output) within the rotor box, for the first four outputs.

    Outputs in [-1, 1] span 0 to m g / 2 per rotor: learning is faster than on the environments' own map,
    whose upper half reaches to kappa m g.
    """
    out = outputs.copy()
    rotors = out[..., :4]
    np.copyto(rotors, np.minimum(np.where(rotors < 0.0, rotors, _hover_gain(task, out.dtype) * rotors), 1.0))
    return out


def hover_slopes(outputs: Floats, task: BaseTask) -> Array:
    """Derivative of `hover_actions` by each of four outputs; 0 where the rotor box cuts."""
    gain = _hover_gain(task, np.float64)
    return np.where(outputs < 0.0, 1.0, np.where(gain * outputs < 1.0, gain, 0.0))


def hover_outputs(actions: Floats, task: BaseTask) -> Floats:
    """The outputs of which `hover_actions` makes these actions, within [-1, 1]."""
    out = actions.copy()
    rotors = out[..., :4]
    np.copyto(rotors, np.minimum(np.where(rotors < 0.0, rotors, rotors / _hover_gain(task, out.dtype)), 1.0))
    return out


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
            raise ValueError(
                f"the network gives {network.outputs} numbers, an action of this task has {size}"
            )
        if network.commands == "hover" and size == 6:
            raise ValueError("actions of this task are estimates: a network needs commands='action'")
        self.network, self.task, self.name, self.kind = network, task, name, kind
        self._size = task.layout.size
        self._columns = network.features.columns(task.layout)
        self._layers = network.layers()
        self._sizes = np.array([len(self._columns), *(len(b) for _, b in self._layers)], dtype=np.int64)
        self._flat = np.concatenate([part.reshape(-1) for layer in self._layers for part in layer])
        self._scaling = _scaling(network.features)
        self._kinds = np.array([network.activation == "relu", network.squash == "tanh"])
        hover = network.commands == "hover"
        self._gain = _hover_gain(task, np.float32) if hover else np.ones(4, dtype=np.float32)

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

        Up to four rows are summed in another order than more, and matrix products round by their size: the
        action of a row differs by up to 1e-6 with the number of rows beside it.

        Raises:
            ValueError: If a shape is wrong or an observation is not finite; it names the part.
        """
        obs, one = as_rows(observation, self._size)
        n = len(obs)
        if episode_start is not None:
            as_starts(episode_start, n)
        kept = _no_state(n) if state is None else state_of(state, n, 0)
        actions = self._few(obs) if n <= _FEW else self._many(obs)
        return actions[0] if one else actions, kept

    def _few(self, obs: Floats) -> Actions:
        """Without the cost of calling numpy."""
        out = np.empty((len(obs), self._sizes[-1]), dtype=np.float32)
        work = np.empty((2, self._sizes.max()), dtype=np.float32)
        layers = self._sizes, self._flat, self._kinds
        bad = _forward(obs, self._columns, self._scaling, *layers, self._gain, work, out)
        if bad >= 0:
            raise not_finite(obs, bad, self.task.layout.slices)
        return out

    def _many(self, obs: Floats) -> Actions:
        """The same in numpy."""
        finite = np.isfinite(obs)
        if not finite.all():
            raise not_finite(obs, int(np.argmin(finite)), self.task.layout.slices)
        x = obs[:, self._columns]
        if len(self._scaling):
            mean, scale, clip = self._scaling
            x = np.clip((x - mean) / scale, -clip, clip).astype(np.float32)
        for k, (W, b) in enumerate(self._layers):
            x = x @ W
            x += b
            if k + 1 < len(self._layers) and self.network.activation == "relu":
                np.maximum(x, 0.0, out=x)
            elif k + 1 < len(self._layers) or self.network.squash == "tanh":
                np.tanh(x, out=x)
        np.clip(x, -1.0, 1.0, out=x)
        return hover_actions(x, self.task) if self.network.commands == "hover" else x


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
