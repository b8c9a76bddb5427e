"""Checks of the arrays that enter the estimators from Python."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_envs.arguments.names import shown
from quad_envs.parameters import Array

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


def as_floats(name: str, value: ArrayLike, shape: tuple[int | None, ...], finite: bool = True) -> Array:
    """The value as a contiguous, writeable float64 array of this shape; None stands for any length.

    Raises:
        ValueError: If the shape is another one or, with `finite`, a number is NaN or infinite.
    """
    array: Array = np.require(np.asarray(value, dtype=np.float64), requirements=["C", "W"])
    _require_shape(name, array, shape)
    if finite and not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{name} must be finite, got {array[index]} at {index}; start the filter anew")
    return array


def as_mask(name: str, value: ArrayLike | None, shape: tuple[int, ...]) -> BoolArray:
    """The value as a contiguous boolean array of this shape; None means everything.

    Raises:
        ValueError: If the shape is another one.
    """
    if value is None:
        return np.ones(shape, dtype=np.bool_)
    array: BoolArray = np.require(np.asarray(value, dtype=np.bool_), requirements=["C", "W"])
    _require_shape(name, array, shape)
    return array


def require_non_negative(name: str, value: float, unit: str) -> float:
    """The value.

    Raises:
        ValueError: If it is negative or not finite.
    """
    if not 0.0 <= value < np.inf:
        raise ValueError(f"{name} must be a finite number >= 0 {unit}, got {shown(value)}")
    return float(value)


def _require_shape(name: str, array: NDArray[Any], shape: tuple[int | None, ...]) -> None:
    """Raise if the shape differs."""
    matches = array.ndim == len(shape) and all(
        want in (None, have) for want, have in zip(shape, array.shape, strict=True)
    )
    if not matches:
        wanted = ", ".join("any" if want is None else str(want) for want in shape)
        raise ValueError(f"{name} must have shape ({wanted}), got {array.shape}")
