"""What batches of vehicles and of teams share: vehicles in blocks, and arrays that kernels take packed."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...compilation.packed import IntArray, pack
from ...lanes import COEFFICIENTS, DECAY, FORCE_MAX, Blocks
from ...parameters import ROTOR_RATE
from ...plant import Array
from ...tasks import BaseTask
from .vehicle_options import VehicleOptions


class PackedBatch:
    """Vehicles in blocks, and a NamedTuple of arrays, `_arrays`, that is packed anew after a copy."""

    options: VehicleOptions
    task: BaseTask
    vehicles: Blocks
    _arrays: Any
    _words: IntArray  # `_arrays`, packed
    _told_shape: tuple[int, int]

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "_words"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._words = pack(self._arrays)

    def fresh_scores(self) -> Array:
        """Where `begin` and `step` write their scores, see N_TOLD of the kernel."""
        return np.empty(self._told_shape)

    def _place_nominal(self) -> None:
        """Let all be the nominal vehicle."""
        coefficients, half = self.task.params.coefficients(), 0.5 * self.task.dt / self.options.substeps
        self.vehicles.write(COEFFICIENTS, coefficients)
        self.vehicles.write(FORCE_MAX, self.task.force_max)
        self.vehicles.write(DECAY, np.exp(-half * coefficients[ROTOR_RATE : ROTOR_RATE + 1]))
