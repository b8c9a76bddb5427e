"""What a network in training sees of many rows of observations, with what its estimators remember."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from quad_envs.tasks import Task, TeamTask
from quad_envs.wrappers.encoding import Encoder, Encoding

from ..policies.disturbance_estimate import Bools, Floats
from ..policies.estimators import Estimators, asks_for_estimates


class Observer:
    """Observations to features, row by row; with estimates of disturbance and target, where they are seen.

    Args:
        encoding: What the network sees and commands.
        task: Where observations come from.
        n: Number of rows.

    Raises:
        ValueError: If observations lack what the network sees.
    """

    def __init__(self, encoding: Encoding, task: Task | TeamTask, n: int) -> None:
        asked = asks_for_estimates(encoding.features, task)
        self._estimators = Estimators(encoding.features, task) if asked else None
        self.encoder = Encoder(encoding, task if self._estimators is None else self._estimators.task)
        self._memory = np.zeros((n, 0 if self._estimators is None else self._estimators.memory_size))

    def see(
        self, observations: Floats, begins: Bools | None = None, rows: NDArray[np.int64] | None = None
    ) -> Floats:
        """Features of the next observations, (m, features); called once for each of them.

        Args:
            observations: (m, d).
            begins: (m,), which begin an episode; None for none.
            rows: Which rows these are, (m,); None for all.
        """
        if self._estimators is None:
            return self.encoder.see(observations)
        where = slice(None) if rows is None else rows
        start = np.zeros(len(observations), dtype=np.bool_) if begins is None else begins
        seen, self._memory[where], _ = self._estimators.extend(observations, self._memory[where], start)
        return self.encoder.see(seen)
