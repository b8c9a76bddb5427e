"""What a target filter of one's own has to offer, and what it is given."""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

from quad_envs.parameters import Array

from .arguments import BoolArray


class Prior(NamedTuple):
    """What is known of the target before anything is measured, one row per vehicle."""

    position: Array  # (n, 3), r_t - p_i, m
    velocity: Array  # (3,), m/s
    sigma: Array  # (2,), standard deviations per axis of position, m, and velocity, m/s


class Measurements(NamedTuple):
    """What the vehicles hold in one step; rows of `z` that are not valid are zero."""

    z: Array  # (n, m, 3), range, azimuth, elevation, m, rad, rad; those of `rows` count
    position: Array  # (n, m, 3), where each was made, relative to the vehicle's present position, m
    age: Array  # (n, m), how long ago, s; `ekf.update` takes None for now, too
    valid: BoolArray  # (n, m); `ekf.update` takes None for all, too
    sigma: Array  # (3,), standard deviations of z
    rows: int  # which entries of z, `quad_envs.sensors.sensor_rows`: 1 is the range, 3 are all


@runtime_checkable
class Estimator(Protocol):
    """A target filter, batched over vehicles: pure functions of a memory (n, size) of numbers.

    Positions are relative to the own vehicle, axes inertial (NED), SI units; x = [r_t - p_i, v_t]. Rows are
    independent, and nothing is remembered in attributes: an episode lives in the memory alone, which travels
    in a policy's `state`. Wherever an estimator is asked for, an object with these members is taken; no
    subclass is needed. One that also has `replaced(memory, x, P) -> memory`, which takes over a fused
    estimate (n, 6) and its covariance (n, 6, 6), can share estimates in an `EstimateWrapper`.
    """

    size: int  # numbers in the memory of one vehicle

    def begin(self, prior: Prior) -> Array:
        """The memory at the start of an episode, (n, size)."""
        ...

    def predict(self, memory: Array, dt: float, displacement: Array) -> Array:
        """The memory one step of dt, s, later, seen from vehicles that moved by `displacement`, (n, 3), m."""
        ...

    def update(self, memory: Array, measurements: Measurements) -> Array:
        """The memory with the measurements taken in; a row without any keeps its prediction."""
        ...

    def mean(self, memory: Array) -> Array:
        """What is believed of the target, (n, 6)."""
        ...

    def covariance(self, memory: Array) -> Array:
        """Its covariance, (n, 6, 6), symmetric and positive definite."""
        ...
