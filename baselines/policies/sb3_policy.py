"""`sb3`: a model of Stable-Baselines3 as it was saved, for who trusts its file."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import CheckpointError, MissingPackageError, PolicyError
from .normalisation import Normalisation, read_normalisation
from .protocol import Actions
from .sb3_files import ModelFile

_CLASSES = {"ppo": "PPO", "a2c": "A2C", "sac": "SAC", "td3": "TD3"}


class Sb3Policy:
    """A model with the normalisation of its observations.

    Args:
        model: Of Stable-Baselines3, or anything with its `predict`.
        normalisation: Of observations before the model sees them; None for none.
        name: For tables.
    """

    def __init__(self, model: Any, normalisation: Normalisation | None, name: str) -> None:
        self.model, self.normalisation, self.name = model, normalisation, name

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
        size, found = self.model.observation_space.shape[0], np.shape(observation)[-1]
        if found != size:
            raise PolicyError(
                f"policy {self.name!r} was trained in another task: it sees {size} numbers, an observation "
                f"here has {found}; fly it with the arguments of the environment that it was trained in"
            )
        seen = observation
        if self.normalisation is not None:
            mean, scale, clip = self.normalisation
            seen = np.clip((observation - mean) / scale, -clip, clip).astype(np.float32)
        actions, kept = self.model.predict(
            seen, state=state, episode_start=episode_start, deterministic=deterministic
        )
        return actions, kept


def sb3(
    model: str | Path,
    vecnormalize: str | Path | None = None,
    *,
    algorithm: Any = None,
    name: str = "",
) -> Sb3Policy:
    """A saved model of Stable-Baselines3 as a policy: calling this says "I trust this file".

    Loading one opens pickles, which can run anything that who wrote the file wanted. `export_policy` and
    `quad-envs export` read the usual ones without running anything, and what they make needs no torch.

    Args:
        model: Path of the zip that `model.save` wrote.
        vecnormalize: Path of the statistics that `VecNormalize.save` wrote, if it was trained with them.
        algorithm: Class that loads it, as `sb3_contrib.TQC`; None to find PPO, A2C, SAC, TD3 and DDPG.
        name: For tables; that of the file if not given.

    Raises:
        CheckpointError: If a file is none of these, of another kind of task, or of a newer version.
        MissingPackageError: If stable-baselines3 is not installed.
    """
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
    normalisation = None if vecnormalize is None else read_normalisation(vecnormalize)
    size = file.size("observation_space")
    if normalisation is not None and normalisation.mean.size != size:
        raise CheckpointError(
            f"{str(vecnormalize)!r} is of another task: it has statistics of {normalisation.mean.size} "
            f"numbers, the model sees {size}"
        )
    try:
        loaded = algorithm.load(model, device="cpu")
    except Exception as error:
        raise CheckpointError(f"{str(model)!r} cannot be loaded by {algorithm.__name__}: {error}") from error
    return Sb3Policy(loaded, normalisation, name or Path(model).stem)
