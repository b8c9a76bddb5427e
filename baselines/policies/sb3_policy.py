"""`sb3`: a model of Stable-Baselines3 as it is, or as it was saved, for who trusts its file."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_envs.wrappers.encoding import Encoder

from ..errors import CheckpointError, MissingPackageError, PolicyError
from .disturbance_estimate import sees_estimate
from .network import NetworkPolicy
from .normalisation import Normalisation, read_normalisation
from .protocol import Actions
from .sb3_files import ModelFile, saved_in_memory

_CLASSES = {"ppo": "PPO", "a2c": "A2C", "sac": "SAC", "td3": "TD3"}


class Sb3Policy:
    """A model with the normalisation of its observations.

    Args:
        model: Of Stable-Baselines3, or anything with its `predict`.
        normalisation: Of what the model sees; None for none.
        name: For tables.
        encoder: What `FilterAndRescale` did in training, which is done here; None where it was not.
    """

    decides_from = NetworkPolicy.decides_from

    def __init__(
        self, model: Any, normalisation: Normalisation | None, name: str, encoder: Encoder | None = None
    ) -> None:
        self.model, self.normalisation, self.name, self.encoder = model, normalisation, name, encoder
        self.task = None if encoder is None else encoder.task

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r})"

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Actions, Any]:
        """Choose actions; see `Policy`.

        Raises:
            PolicyError: If observations have another length than the model was trained on.
        """
        encoder, found = self.encoder, np.shape(observation)[-1]
        size = encoder.task.layout.size if encoder else self.model.observation_space.shape[0]
        if found != size:
            raise PolicyError(
                f"policy {self.name!r} was trained in another task: it sees {size} numbers, an observation "
                f"here has {found}; fly it with the arguments of the environment that it was trained in"
            )
        seen = encoder.see(observation) if encoder else observation
        if self.normalisation is not None:
            mean, scale, clip = self.normalisation
            seen = np.clip((seen - mean) / scale, -clip, clip).astype(np.float32)
        actions, kept = self.model.predict(
            seen, state=state, episode_start=episode_start, deterministic=deterministic
        )
        return encoder.act(actions) if encoder else actions, kept


def sb3(
    model: str | Path | Any,
    vecnormalize: str | Path | None = None,
    *,
    algorithm: Any = None,
    name: str = "",
) -> Sb3Policy:
    """A model of Stable-Baselines3 as a policy: of a file, calling this says "I trust this file".

    One that was trained under `quad_envs.wrappers.FilterAndRescale` says so itself, and flies the environment
    as it is. Loading a file opens pickles, which can run anything that who wrote the file wanted.
    `export_policy` and `quad-envs export` read the usual ones without running anything, and what they make
    needs no torch.

    Args:
        model: Path of the zip that `model.save` wrote, or the model itself.
        vecnormalize: Path of the statistics that `VecNormalize.save` wrote, if it was trained with them.
        algorithm: Class that loads it, as `sb3_contrib.TQC`; None to find PPO, A2C, SAC, TD3 and DDPG.
        name: For tables; that of the file if not given.

    Raises:
        CheckpointError: If a file is none of these, of another kind of task, or of a newer version.
        MissingPackageError: If stable-baselines3 is not installed.
    """
    if not isinstance(model, str | Path):
        return _policy_of(model, saved_in_memory(model), vecnormalize, name or type(model).__name__.lower())
    file = ModelFile(model)
    if algorithm is None:
        if file.algorithm not in _CLASSES:
            raise CheckpointError(
                f"{str(model)!r} is of another algorithm than {', '.join(_CLASSES.values())}: say which, as "
                "algorithm=sb3_contrib.TQC"
            )
        try:
            algorithm = getattr(import_module("stable_baselines3"), _CLASSES[file.algorithm])
        except ImportError as error:
            raise MissingPackageError(
                f"{str(model)!r} needs stable-baselines3: pip install stable-baselines3"
            ) from error
    try:
        loaded = algorithm.load(model, device="cpu")
    except Exception as error:
        raise CheckpointError(f"{str(model)!r} cannot be loaded by {algorithm.__name__}: {error}") from error
    return _policy_of(loaded, file, vecnormalize, name or Path(model).stem)


def _policy_of(model: Any, file: ModelFile, vecnormalize: str | Path | None, name: str) -> Sb3Policy:
    """A model as a policy, with what its file says of it."""
    normalisation = None if vecnormalize is None else read_normalisation(vecnormalize)
    size = file.size("observation_space")
    if normalisation is not None and normalisation.mean.size != size:
        raise CheckpointError(
            f"{str(vecnormalize)!r} is of another task: it has statistics of {normalisation.mean.size} "
            f"numbers, the model sees {size}"
        )
    if file.encoder is not None and sees_estimate(file.encoder.encoding.features):
        raise CheckpointError(
            f"{name!r} sees an estimate of the disturbance, for which the vehicle has to be known: make a "
            "checkpoint of its zip, `quad-envs export model.zip FOLDER`, and fly that"
        )
    return Sb3Policy(model, normalisation, name, file.encoder)
