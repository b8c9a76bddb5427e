"""What a model's zip of Stable-Baselines3 holds, read without running any code in it.

It has settings as JSON, in which pickles stay closed, and weights as tensors.
"""

from __future__ import annotations

import ast
import io
import json
import re
import zipfile
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_envs.arguments.names import shown
from quad_envs.wrappers.encoded_space import EncodedBox, encoder_of
from quad_envs.wrappers.encoding import Encoder

from ..errors import CheckpointError, MissingPackageError
from .network import Activation, Squash

Floats = NDArray[np.float32]
_LARGEST = 500_000_000  # bytes of a member or of statistics
_ACTIVATIONS: dict[str, Activation] = {"Tanh": "tanh", "ReLU": "relu"}


class Actor(NamedTuple):
    """The deterministic policy of a model: layers from the observation to the mean of the action."""

    weights: tuple[Floats, ...]  # each (inputs, outputs)
    biases: tuple[Floats, ...]  # each (outputs,)
    activation: Activation
    squash: Squash  # of the outputs
    algorithm: str = ""
    encoder: Encoder | None = None  # what the wrapper that it was trained under did


class ModelFile:
    """A zip that `model.save` wrote.

    Args:
        source: Its path, or a buffer with its bytes.

    Raises:
        CheckpointError: If it is none, is damaged, was written by a newer version of Stable-Baselines3 than
            is installed, or acts in another kind of task; the message says which.
    """

    def __init__(self, source: str | Path | io.BytesIO) -> None:
        if isinstance(source, str | Path) and not Path(source).exists() and Path(f"{source}.zip").is_file():
            source = f"{source}.zip"  # as Stable-Baselines3 itself names files
        self.where = "the model" if isinstance(source, io.BytesIO) else repr(str(source))
        try:
            with zipfile.ZipFile(source) as file:
                self._members = {
                    name: self._read(file, name)
                    for name in ("data", "policy.pth", "_stable_baselines3_version")
                    if name in file.namelist()
                }
        except FileNotFoundError as error:
            raise CheckpointError(f"there is no file {self.where}") from error
        except (OSError, zipfile.BadZipFile, EOFError, RuntimeError, NotImplementedError) as error:
            raise CheckpointError(
                f"{self.where} is no model of Stable-Baselines3, a zip that model.save wrote: {error}"
            ) from error
        self.data = self._settings()
        self._require_version()
        self._require_spaces()

    def _read(self, file: zipfile.ZipFile, name: str) -> bytes:
        size = file.getinfo(name).file_size
        if size > _LARGEST:
            raise CheckpointError(
                f"{self.where}: {name} has {size} bytes, more than the {_LARGEST} read here"
            )
        return file.read(name)

    def _settings(self) -> dict[str, Any]:
        """The JSON of the model; what of it is a pickle stays text."""
        missing = [name for name in ("data", "policy.pth") if name not in self._members]
        if missing:
            raise CheckpointError(
                f"{self.where} is a zip, but no model of Stable-Baselines3: it has no "
                f"{' and no '.join(missing)}"
            )
        try:
            found = json.loads(self._members["data"])
        except (ValueError, RecursionError) as error:
            raise CheckpointError(f"{self.where}: its data is not valid JSON: {error}") from error
        if not isinstance(found, dict) or "observation_space" not in found or "action_space" not in found:
            raise CheckpointError(f"{self.where} is no model of Stable-Baselines3: its data name no spaces")
        return found

    def _require_version(self) -> None:
        """Refuse what a newer minor version wrote: what it means by its words is not known."""
        written = self._members.get("_stable_baselines3_version", b"").decode("utf-8", "replace").strip()
        try:
            installed = metadata.version("stable-baselines3")
        except metadata.PackageNotFoundError:
            return
        if _release(written) > _release(installed):
            raise CheckpointError(
                f"{self.where} was written by Stable-Baselines3 {shown(written)}, {installed} is installed: "
                f"pip install --upgrade stable-baselines3, or save it with {installed}"
            )

    def _require_spaces(self) -> None:
        """Refuse models whose observations or actions are not those of this suite."""
        for name in ("observation_space", "action_space"):
            space = self.data[name]
            kind = str(space.get(":type:", "")) if isinstance(space, Mapping) else str(space)
            if not kind.endswith((".Box'>", f".{EncodedBox.__name__}'>")):
                raise CheckpointError(
                    f"{self.where} is of another task: its {name} is {shown(kind)}, and not a Box of one row"
                )
        low, high = (_numbers(self.data["action_space"].get(name)) for name in ("low", "high"))
        if not (np.all(low == -1.0) and np.all(high == 1.0)):
            raise CheckpointError(
                f"{self.where} is of another task: its actions are between {shown(low.tolist())} and "
                f"{shown(high.tolist())}, and here they are between -1 and 1"
            )

    def size(self, space: str) -> int:
        """Numbers in an observation or an action.

        Args:
            space: "observation_space" or "action_space".
        """
        try:
            shape = ast.literal_eval(str(self.data[space]["_shape"]))
        except (KeyError, ValueError, SyntaxError) as error:
            raise CheckpointError(f"{self.where}: the shape of its {space} cannot be read") from error
        if len(shape) != 1:
            raise CheckpointError(f"{self.where} is of another task: its {space} has shape {shown(shape)}")
        return int(shape[0])

    @property
    def encoder(self) -> Encoder | None:
        """What the wrapper that it was trained under did; None where there was none.

        Raises:
            CheckpointError: If its observation space does not say it as that wrapper does.
        """
        said = self.data["observation_space"].get("encoding")
        if said is None:
            return None
        try:
            found = encoder_of(said)
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointError(
                f"{self.where}: the encoding in its observation_space is not that of "
                f"quad_envs.wrappers.FilterAndRescale: {error!r}"
            ) from error
        if found.size != self.size("observation_space"):
            raise CheckpointError(
                f"{self.where}: its encoding has {found.size} features, its observation_space "
                f"{self.size('observation_space')}: no other wrapper may stand above FilterAndRescale"
            )
        return found

    @property
    def algorithm(self) -> str:
        """Name of the algorithm in lower case: "ppo", "a2c", "sac", "td3"; "" for others."""
        module = self._policy_module
        if module == "stable_baselines3.common.policies":
            return "ppo" if "clip_range" in self.data else "a2c"
        found = re.fullmatch(r"stable_baselines3\.(\w+)\.policies", module)
        return found[1] if found else ""

    @property
    def _policy_module(self) -> str:
        policy = self.data.get("policy_class")
        return str(policy.get("__module__", "")) if isinstance(policy, Mapping) else ""

    def actor(self) -> Actor:
        """The policy without its noise.

        Raises:
            CheckpointError: If it is no MlpPolicy with tanh or relu.
        """
        if not self.algorithm:
            raise self._other(f"its policy is one of {self._policy_module or 'an unknown module'}")
        tensors, kwargs = self._tensors(), self.data.get("policy_kwargs")
        kwargs = kwargs if isinstance(kwargs, Mapping) else {}
        extractor = str(kwargs.get("features_extractor_class", "FlattenExtractor"))
        if "FlattenExtractor" not in extractor or any("features_extractor." in name for name in tensors):
            raise self._other(f"it has a features extractor, {shown(extractor)}")
        if any("shared_net" in name for name in tensors):
            raise self._other("its actor and critic share layers")
        on_policy = self.algorithm in ("ppo", "a2c")
        if self.data.get("use_sde") and not on_policy:
            raise self._other("it explores with gSDE, which cuts the mean")
        if str(kwargs.get("squash_output", False)) == "True":
            raise self._other("it squashes its outputs")
        weights, biases = self._layers(tensors)
        default: Activation = "tanh" if on_policy else "relu"
        said = re.search(r"\.(\w+)'>$", str(kwargs.get("activation_fn", "")))
        activation = default if "activation_fn" not in kwargs else _ACTIVATIONS.get(said[1] if said else "")
        if activation is None:
            raise self._other(f"its activation_fn is {shown(kwargs['activation_fn'])}")
        return Actor(
            weights, biases, activation, "clip" if on_policy else "tanh", self.algorithm, self.encoder
        )

    def _layers(self, tensors: Mapping[str, NDArray[Any]]) -> tuple[tuple[Floats, ...], tuple[Floats, ...]]:
        """Weights and biases of the actor, from the observation on."""
        hidden = {
            "ppo": "mlp_extractor.policy_net",
            "a2c": "mlp_extractor.policy_net",
            "sac": "actor.latent_pi",
        }
        last = {"ppo": ["action_net"], "a2c": ["action_net"], "sac": ["actor.mu"]}.get(self.algorithm, [])
        prefix = hidden.get(self.algorithm, "actor.mu")
        found = re.compile(rf"{re.escape(prefix)}\.(\d+)\.weight")
        places = sorted(int(match[1]) for name in tensors if (match := found.fullmatch(name)))
        names = [*(f"{prefix}.{place}" for place in places), *last]
        try:
            pairs = [(tensors[f"{name}.weight"], tensors[f"{name}.bias"]) for name in names]
        except KeyError as error:
            raise self._other(f"it has no {error.args[0]}") from error
        n = self.size("observation_space")
        for name, (W, b) in zip(names, pairs, strict=True):
            if W.ndim != 2 or W.shape[1] != n or b.shape != W.shape[:1]:
                raise self._other(f"{name} has weights {W.shape}, where {n} inputs were expected")
            n = W.shape[0]
        if n != self.size("action_space"):
            raise self._other(f"its actor gives {n} numbers, an action has {self.size('action_space')}")
        weights = tuple(np.ascontiguousarray(W.T, dtype=np.float32) for W, _ in pairs)
        return weights, tuple(np.ascontiguousarray(b, dtype=np.float32) for _, b in pairs)

    def _tensors(self) -> dict[str, NDArray[Any]]:
        """The weights of the policy; `weights_only` makes tensors, and runs nothing."""
        try:
            import torch
        except ImportError as error:
            raise MissingPackageError(f"reading {self.where} needs torch: pip install torch") from error
        try:
            found = torch.load(io.BytesIO(self._members["policy.pth"]), map_location="cpu", weights_only=True)
            return {str(name): value.numpy() for name, value in found.items() if torch.is_tensor(value)}
        except Exception as error:
            said = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise CheckpointError(
                f"{self.where}: policy.pth is damaged, or holds more than weights: {said}"
            ) from error

    def _other(self, why: str) -> CheckpointError:
        return CheckpointError(
            f"{self.where} cannot become a checkpoint of layers: {why}; MlpPolicy of PPO, A2C, SAC, TD3 and "
            "DDPG with Tanh or ReLU can. baselines.sb3 flies others, if you trust the file"
        )


def saved_in_memory(model: Any) -> ModelFile:
    """What `model.save` would write of a model.

    Raises:
        CheckpointError: If it is no model of Stable-Baselines3, or as `ModelFile` says.
    """
    if not (hasattr(model, "policy") and callable(getattr(model, "save", None))):
        raise CheckpointError(
            f"expected a model of Stable-Baselines3, or the path of one, got {shown(model)}"
        )
    buffer = io.BytesIO()
    model.save(buffer)
    return ModelFile(buffer)


def _release(version: str) -> tuple[int, ...]:
    """Major and minor number; (0,) if there is none."""
    found = re.match(r"(\d+)\.(\d+)", version)
    return (int(found[1]), int(found[2])) if found else (0,)


def _numbers(text: Any) -> NDArray[np.float64]:
    """The numbers in a printed array; nan where it holds none."""
    words = re.findall(r"[^\s\[\],]+", str(text))
    try:
        return np.array([float(word) for word in words] or [np.nan])
    except ValueError:
        return np.array([np.nan])
