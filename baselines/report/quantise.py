"""Series of numbers as 16 bit text and back, small enough to stand in a page."""

from __future__ import annotations

import base64
import zlib

import numpy as np
from numpy.typing import NDArray

from quad_envs.parameters import Array

from .model import Channel

_MOST = 32767  # largest whole number of the map; -32768 is nan
_NAN = -_MOST - 1
_LEAST_POSITIVE = 1e-6  # below it a logarithm would only show noise


class Blobs:
    """Encoded series, each text once: policies that fly from one start share their reference."""

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}
        self.size = 0  # bytes of all texts

    def add(self, text: str) -> int:
        """Number of a text."""
        if text not in self._numbers:
            self._numbers[text] = len(self._numbers)
            self.size += len(text)
        return self._numbers[text]

    def __len__(self) -> int:
        return len(self._numbers)

    def texts(self) -> tuple[str, ...]:
        """All texts, by their numbers."""
        return tuple(self._numbers)

    def forget_after(self, count: int) -> None:
        """Keep the first texts only."""
        for text in list(self._numbers)[count:]:
            del self._numbers[text]
            self.size -= len(text)


def encode(name: str, values: Array, blobs: Blobs, *, log: bool = False) -> Channel:
    """Quantise a table.

    The error is at most half of (high - low) / 65534: 0.1 mm over 13 m.

    Args:
        name: Of the channel.
        values: (vehicles, rows, components); nan and infinity are kept as nan.
        blobs: Where the text goes.
        log: Whether to quantise the logarithm, for what spans decades.
    """
    vehicles, rows, components = values.shape
    x = np.where(np.isfinite(values), values, np.nan)
    x = np.log10(np.maximum(x, _LEAST_POSITIVE)) if log else x
    known = np.isfinite(x)
    low, high = (float(x[known].min()), float(x[known].max())) if known.any() else (0.0, 0.0)
    scale = 2.0 * _MOST / (high - low) if high > low else 0.0
    whole = np.where(known, np.round(np.where(known, x - low, 0.0) * scale) - _MOST, _NAN).astype(np.int16)
    series = whole.transpose(0, 2, 1).reshape(vehicles * components, rows)
    differences = np.diff(series.view(np.uint16), axis=1, prepend=np.uint16(0))
    packed = zlib.compress(differences.astype("<u2").tobytes(), 9)
    text = base64.b64encode(packed).decode("ascii")
    return Channel(name, vehicles, rows, components, low, high, log, blobs.add(text))


def decode(channel: Channel, text: str) -> Array:
    """The table of a channel, (vehicles, rows, components)."""
    packed = zlib.decompress(base64.b64decode(text))
    shape = (channel.vehicles * channel.components, channel.rows)
    differences: NDArray[np.uint16] = np.frombuffer(packed, dtype="<u2").reshape(shape)
    whole = np.cumsum(differences, axis=1, dtype=np.uint16).view(np.int16).astype(np.float64)
    share = np.where(whole == _NAN, np.nan, (whole + _MOST) / (2.0 * _MOST))
    x = channel.low + share * (channel.high - channel.low)
    x = x.reshape(channel.vehicles, channel.components, channel.rows).transpose(0, 2, 1)
    return np.asarray(10.0**x if channel.log else x)
