"""`export_policy`: a network of Stable-Baselines3 or torch as our checkpoint, which flies without both."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quad_envs.arguments.checks import require_path
from quad_envs.observations.features import Features, entry_names
from quad_envs.tasks import TeamTask
from quad_envs.wrappers.encoding import Encoder

from ..errors import CheckpointError
from .checkpoints import DESCRIPTION, save_checkpoint
from .disturbance_estimate import sees_estimate, with_estimate
from .environments import find_task, task_of
from .network import Network, Squash
from .normalisation import Normalisation, read_normalisation
from .sb3_files import Actor, ModelFile, saved_in_memory

_NO_CUT = 1e15  # a clip that cuts nothing
_KEPT_BY = ("Identity", "Flatten", "Dropout")  # torch modules that change nothing in flight


def export_policy(
    source: str | Path | Any,
    folder: str | Path,
    *,
    env: Any = None,
    vecnormalize: str | Path | None = None,
    mean: ArrayLike | None = None,
    scale: ArrayLike | None = None,
    fresh: bool = False,
) -> Path:
    """Make a checkpoint of a network that was trained elsewhere, for `make_policy` and the command line.

    The actor alone is kept, without its noise: of `MlpPolicy` of PPO, A2C, SAC, TD3 or DDPG with tanh or relu
    layers, or of a `torch.nn.Sequential` of Linear, Tanh and ReLU that gives the action. What
    `quad_envs.wrappers.FilterAndRescale` did in training is a part of the checkpoint. No code in the files is
    run.

    Args:
        source: Path of a zip that `model.save` of Stable-Baselines3 wrote, such a model, or a torch module.
        folder: Of the checkpoint; made if need be.
        env: Where it was trained, as for `make_policy`. What the network sees is then known by name, and it
            flies where observations have these parts; without, where they have as many numbers.
        vecnormalize: Path of the statistics that `VecNormalize.save` wrote, if it was trained with them.
        mean: What is subtracted from observations before the network sees them, (d,), if there is no such
            file.
        scale: By what they are divided then, (d,).
        fresh: Whether to replace a checkpoint that is in the folder.

    Returns:
        The folder.

    Raises:
        CheckpointError: If the source cannot be read or has other layers, is of another task than `env`, or
            the folder holds a checkpoint already.
    """
    require_path("folder", folder)
    path = Path(folder)
    if (path / DESCRIPTION).exists() and not fresh:
        raise CheckpointError(
            f"{str(path)!r} holds a checkpoint already; choose another folder, or fresh=True (--fresh)"
        )
    actor = _actor_of(source)
    task = None if env is None else _task_of(env, actor)
    features = _features(actor, task, _normalisation(actor, vecnormalize, mean, scale))
    try:
        network = _network_of(actor, features)
    except ValueError as error:
        raise CheckpointError(f"this network cannot become a checkpoint: {error}") from error
    about = {"algorithm": actor.algorithm, "kind": "model-free" if actor.algorithm else ""}
    if task is not None:
        _require_actions(actor, task)
        about |= {"env_id": task.env_id, "mission": task.mission}
    save_checkpoint(path, network, about)
    return path


def _network_of(actor: Actor, features: Features) -> Network:
    """The actor with what stands before and behind its layers."""
    encoder = actor.encoder
    return Network(
        features,
        actor.weights,
        actor.biases,
        squash=actor.squash,
        commands="action" if encoder is None else "hover",
        activation=actor.activation,
        command_range=1.0 if encoder is None else encoder.encoding.command_range,
    )


def _task_of(env: Any, actor: Actor) -> Any:
    """The task of an environment, which may be under the wrapper that the network was trained under."""
    if actor.encoder is not None and not isinstance(env, str):
        env = find_task(env) or env
    return task_of(env)


def _actor_of(source: Any) -> Actor:
    """Layers of whatever was given."""
    if isinstance(source, str | Path):
        return ModelFile(source).actor()
    if hasattr(source, "policy") and callable(getattr(source, "save", None)):
        return saved_in_memory(source).actor()
    return _module_actor(source)


def _module_actor(module: Any) -> Actor:
    """Layers of a torch module, one after the other."""
    layers = [layer for layer in _leaves(module) if type(layer).__name__ not in _KEPT_BY]
    kinds = [type(layer).__name__ for layer in layers]
    squash: Squash = "tanh" if kinds[-1:] == ["Tanh"] else "clip"
    hidden = kinds[1 : len(kinds) - (squash == "tanh") : 2]
    linear = kinds[0 : len(kinds) - (squash == "tanh") : 2]
    activations = set(hidden)
    if not linear or set(linear) != {"Linear"} or len(linear) != len(hidden) + 1 or len(activations) > 1:
        raise _no_layers(kinds, module)
    if not activations <= {"Tanh", "ReLU"}:
        raise _no_layers(kinds, module)
    arrays = [
        (
            np.ascontiguousarray(layer.weight.detach().cpu().numpy().T, dtype=np.float32),
            np.zeros(layer.out_features, np.float32)
            if layer.bias is None
            else layer.bias.detach().cpu().numpy().astype(np.float32),
        )
        for layer in layers[: len(kinds) - (squash == "tanh") : 2]
    ]
    weights, biases = zip(*arrays, strict=True)
    return Actor(weights, biases, "relu" if activations == {"ReLU"} else "tanh", squash)


def _leaves(module: Any) -> list[Any]:
    """Modules of nested `Sequential`s, in their order."""
    if type(module).__name__ != "Sequential":
        return [module]
    return [leaf for child in module.children() for leaf in _leaves(child)]


def _no_layers(kinds: list[str], module: Any) -> CheckpointError:
    found = ", ".join(kinds) if kinds else type(module).__name__
    return CheckpointError(
        "a torch module becomes a checkpoint if it is a torch.nn.Sequential of Linear, Tanh, Linear, ... (or "
        f"ReLU in place of Tanh), with or without a Tanh in the end; this is {found}"
    )


def _normalisation(
    actor: Actor, vecnormalize: str | Path | None, mean: ArrayLike | None, scale: ArrayLike | None
) -> Normalisation | None:
    """What is done to observations before the first layer."""
    n = actor.weights[0].shape[0]
    if vecnormalize is not None:
        if mean is not None or scale is not None:
            raise CheckpointError("give either vecnormalize, or mean and scale")
        found = read_normalisation(vecnormalize)
        if found is not None and found.mean.size != n:
            raise CheckpointError(
                f"{str(vecnormalize)!r} is of another task: it has statistics of {found.mean.size} numbers, "
                f"the network sees {n}"
            )
        return found
    if mean is None and scale is None:
        return None
    try:
        shift, size = (
            np.broadcast_to(np.asarray(default if given is None else given, np.float64), (n,))
            for given, default in ((mean, 0.0), (scale, 1.0))
        )
    except ValueError as error:
        raise CheckpointError(f"mean and scale must be ({n},), as the network sees: {error}") from error
    return Normalisation(shift, size, float("inf"))


def _features(actor: Actor, task: Any, seen: Normalisation | None) -> Features:
    """Names of what the network sees, and its scaling."""
    if actor.encoder is not None:
        return _encoded_features(actor.encoder, task, seen)
    n = actor.weights[0].shape[0]
    names = [f"observation[{k}]" for k in range(n)]
    if task is not None:
        names = entry_names(task.layout)
        if len(names) != n:
            raise CheckpointError(
                f"the network is of another task: it sees {n} numbers, an observation of {task.env_id} has "
                f"{len(names)}; give the arguments of the environment that it was trained in"
            )
    if seen is None:
        return Features(tuple(names), (0.0,) * n, (1.0,) * n)
    # Scaled apart from the first layer, as it was trained: where a number hardly varies, its mean and its
    # weight in that layer would be large numbers that cancel.
    return Features(
        tuple(names), tuple(seen.mean.tolist()), tuple(seen.scale.tolist()), min(seen.clip, _NO_CUT)
    )


def _encoded_features(encoder: Encoder, task: Any, seen: Normalisation | None) -> Features:
    """Those of a wrapper, and what was done to them after it."""
    features = encoder.encoding.features
    if task is not None:
        try:
            features.columns((with_estimate(task) if sees_estimate(features) else task).layout)
        except ValueError as error:
            raise CheckpointError(f"the network is of another task than {task.env_id}: {error}") from error
    if seen is None:
        return features
    mean, scale = np.asarray(features.mean), np.asarray(features.scale)
    return replace(
        features,
        mean=tuple((mean + scale * seen.mean).tolist()),
        scale=tuple((scale * seen.scale).tolist()),
        clip=min(seen.clip, _NO_CUT),
    )


def _require_actions(actor: Actor, task: Any) -> None:
    size = task.action_size if isinstance(task, TeamTask) else 4
    found = actor.weights[-1].shape[1]
    if found != size:
        raise CheckpointError(
            f"the network is of another task: it gives {found} numbers, an action of {task.env_id} has {size}"
        )
