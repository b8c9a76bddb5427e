"""What a step of the agents' target filters gives, whichever filters they are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quad_envs.parameters import Array

from .decoding import Decoded
from .estimation_kernels import P, X
from .protocol import Estimates


class Filtered(NamedTuple):
    """Rows after a step of their filters."""

    parts: Decoded
    first: Array  # (n, a), what else the memory holds
    filters: Array  # (n, FILTER_SIZE)
    reports: Array  # (n, N_REPORT)
    trilaterates: bool  # whether a position may enter instead of the ranges

    @property
    def estimates(self) -> Estimates:
        """What the filters believe."""
        n, x = len(self.filters), self.filters[:, X]
        covariance = self.filters[:, P].reshape(n, 6, 6).copy()
        counts = self.reports[:, 1:].astype(np.int64)
        nis = self.reports[:, 0].copy()
        fixed = counts[:, 2] > 0 if self.trilaterates else None
        return Estimates(x[:, :3].copy(), x[:, 3:].copy(), covariance, nis, counts[:, 0], counts[:, 1], fixed)
