"""Task: the frozen value from which a policy is built, what an engineer would know before the flight."""

from __future__ import annotations

from dataclasses import dataclass, field

from .constraints import constraint_names
from .observations import TrackingLayout
from .parameters import Limits, QuadrotorParams, Weights


@dataclass(frozen=True, slots=True)
class Task:
    """What is known before the flight; all else reaches a policy through observations only."""

    env_id: str = "quad/HelixTracking-v0"
    params: QuadrotorParams = field(default_factory=QuadrotorParams)  # nominal vehicle
    limits: Limits = field(default_factory=Limits)
    weights: Weights = field(default_factory=Weights)  # of the stage cost in the reward
    dt: float = 0.05  # s, control period
    episode_steps: int = 200  # control periods until truncation
    layout: TrackingLayout = field(default_factory=TrackingLayout)
    sensor_noise: tuple[float, float, float, float] = (
        0.0,
        0.0,
        0.0,
        0.0,
    )  # 1 sigma of position, velocity, attitude, rates
    reward: str = "bounded"  # or "quadratic"

    @property
    def constraint_names(self) -> tuple[str, ...]:
        """Names of the entries of `info["constraint_values"]`."""
        return constraint_names(self.limits)

    @property
    def hover_force(self) -> float:
        """Rotor force of action 0, N."""
        return self.params.hover_force

    @property
    def force_max(self) -> float:
        """Rotor force of action +1, kappa m g, N."""
        return self.limits.kappa * self.params.weight
