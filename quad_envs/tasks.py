"""Task: the frozen value from which a policy is built, what an engineer would know before the flight."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .constraints import constraint_names
from .limits import Limits
from .observations.team import AgentLayout
from .observations.tracking import TrackingLayout
from .parameters import Array, QuadrotorParams, Weights
from .reward import LOSS_PARTS as LOSS_PARTS

_Triple = tuple[float, float, float]
CRASH_CAUSES = ("", "distance", "tilt", "arena", "not finite", "lost")


@dataclass(frozen=True, slots=True)
class BaseTask:
    """What every task has: the vehicle, its limits, the weights of the reward, time."""

    env_id: str = "quad/HelixTracking-v0"
    params: QuadrotorParams = field(default_factory=QuadrotorParams)  # nominal vehicle
    limits: Limits = field(default_factory=Limits)
    weights: Weights = field(default_factory=Weights)  # of the stage cost in the reward
    dt: float = 0.05  # s, control period
    episode_steps: int = 200  # control periods until truncation
    sensor_noise: tuple[float, float, float, float] = (
        0.0,
        0.0,
        0.0,
        0.0,
    )  # 1 sigma of position, velocity, attitude, rates
    reward: str = "bounded"  # or "quadratic"

    @property
    def mission(self) -> str:
        """What there is to do: "tracking", "formation", "target-tracking" or "estimation"."""
        return "tracking"

    @property
    def constraint_names(self) -> tuple[str, ...]:
        """Names of the entries of `info["constraint_values"]`."""
        return constraint_names(self.limits)

    @property
    def crash_causes(self) -> tuple[str, ...]:
        """Names of the values of `info["crash_cause"]`, a number because TorchRL makes tensors of infos."""
        return CRASH_CAUSES

    @property
    def hover_force(self) -> float:
        """Rotor force of action 0, N."""
        return self.params.hover_force

    @property
    def force_max(self) -> Array:
        """Force of action +1 of each rotor, kappa m g, (4,), N."""
        return np.array(self.limits.kappas) * self.params.weight


@dataclass(frozen=True, slots=True)
class Task(BaseTask):
    """One vehicle follows a reference; all else reaches a policy through observations only."""

    layout: TrackingLayout = field(default_factory=TrackingLayout)


@dataclass(frozen=True, slots=True)
class TeamTask(BaseTask):
    """Several vehicles, of which each decides from its own observation."""

    layout: AgentLayout = field(default_factory=AgentLayout)
    mission: str = "formation"  # or "target-tracking", "estimation"
    vehicles: int = 6
    slots: tuple[_Triple, ...] = ()  # m, wanted positions relative to the leader's, or to the target
    separation: float = 0.4  # m, d_s, smallest distance between two vehicles
    crash_distance: float = 0.33  # m, d_crash, tip to tip
    sensing_radius: float = 2.0  # m, R_s
    formation_weight: float = 1.0  # of the formation error in the stage cost
    spanning_tree: bool = True  # whether news from the leader, or from who measures, can reach everybody
    sensor: str = ""  # of the target, a name of `sensors.SENSORS`; empty where there is none
    sensor_sigma: _Triple = (0.1, 0.02, 0.02)  # m, rad, rad: range, azimuth, elevation
    prior_velocity: _Triple = (0.0, 0.0, 0.0)  # m/s, of the target at the start; its position is p - slot
    prior_sigma: tuple[float, float] = (3.0, 1.0)  # m, m/s, standard deviation of that guess, each axis

    @property
    def constraint_names(self) -> tuple[str, ...]:
        """The vehicle's limits, then the distance between vehicles; none where vehicles run on rails."""
        return () if self.mission == "estimation" else (*constraint_names(self.limits), "separation")

    @property
    def reward_term_names(self) -> tuple[str, ...]:
        """Names of the entries of `info["reward_terms"]`."""
        return (*LOSS_PARTS, *self.constraint_names)

    @property
    def action_size(self) -> int:
        """Numbers in an action: rotor commands, then the plan where it is shared; or an estimate."""
        return 6 if self.mission == "estimation" else 4 + 6 * self.layout.plan

    @property
    def state_slices(self) -> dict[str, slice]:
        """Name -> slice of the environment's `state()`: plants, target, graph, preview, time."""
        n, stages = self.vehicles, self.layout.preview + 1
        out, start = {}, 0
        for name, size in (
            *(("plants", 16 * n), ("target", 6), ("graph", n * n), ("preview", 8 * stages), ("time", 1)),
        ):
            out[name] = slice(start, start + size)
            start += size
        return out
