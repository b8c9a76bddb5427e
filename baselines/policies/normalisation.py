"""The statistics of VecNormalize, read without running any code in their file.

They are a pickle: it is opened by a reader that makes numpy arrays and nothing else.
"""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import CheckpointError


class Normalisation(NamedTuple):
    """What VecNormalize does to observations: (obs - mean) / scale, within +-clip."""

    mean: NDArray[np.float64]  # (d,)
    scale: NDArray[np.float64]  # (d,)
    clip: float


def read_normalisation(path: str | Path) -> Normalisation | None:
    """The statistics that `VecNormalize.save` wrote; None if it leaves observations as they are.

    Raises:
        CheckpointError: If the file is none of these.
    """
    where = repr(str(path))
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise CheckpointError(f"cannot read {where}: {error.strerror or error}") from error
    try:
        found = _ArraysOnly(io.BytesIO(data)).load()
    except Exception as error:
        raise CheckpointError(f"{where} is no file of VecNormalize.save: {error}") from error
    if type(found).__name__ != "VecNormalize" or not isinstance(found, _Inert):
        raise CheckpointError(f"{where} is no file of VecNormalize.save: it holds {type(found).__name__}")
    if not found.said.get("norm_obs", True):
        return None
    try:
        rms = found.said["obs_rms"].said
        mean, var = (np.asarray(rms[name], dtype=np.float64) for name in ("mean", "var"))
        clip, epsilon = float(found.said["clip_obs"]), float(found.said["epsilon"])
    except (KeyError, AttributeError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{where}: its statistics are not those of one row of numbers ({error!r})"
        ) from error
    if mean.ndim != 1 or var.shape != mean.shape or not np.isfinite(mean).all() or not (var >= 0.0).all():
        raise CheckpointError(f"{where}: mean {mean.shape} and variance {var.shape} must be rows of numbers")
    return Normalisation(mean, np.sqrt(var + epsilon), clip)


class _Inert:
    """What stands for every class in a pickle: it keeps what it is told and does nothing."""

    def __new__(cls, *arguments: Any, **more: Any) -> _Inert:
        return super().__new__(cls)

    def __init__(self, *arguments: Any, **more: Any) -> None:
        self.said: dict[str, Any] = {}

    def __setstate__(self, state: Any) -> None:
        self.said = state if isinstance(state, dict) else {}

    def __setitem__(self, key: Any, value: Any) -> None:
        pass

    def append(self, value: Any) -> None:
        pass


def _from_buffer(data: Any, dtype: Any, shape: Any, order: Any) -> NDArray[Any]:
    """An array of its bytes, as numpy's own function of this name in pickles."""
    return np.frombuffer(data, dtype).reshape(shape, order=order)


# What pickles of arrays and of numbers call, by its name in numpy.
_NUMPY = {
    "ndarray": np.ndarray,
    "dtype": np.dtype,
    "_reconstruct": np.empty(0).__reduce__()[0],
    "scalar": np.float64(0.0).__reduce__()[0],
    "_frombuffer": _from_buffer,
}


class _ArraysOnly(pickle.Unpickler):
    """Makes numpy arrays; everything else becomes `_Inert`, and nothing is imported."""

    def find_class(self, module: str, name: str) -> Any:
        known = _NUMPY.get(name) if module.partition(".")[0] == "numpy" else None
        return type(name, (_Inert,), {}) if known is None else known
