"""Layout of one agent's observation in the multi-agent tasks: named slices and decoding.

| slice | size | content |
|---|---|---|
| own | 18 | exactly the own block of the tracking layout |
| position | 3 | p, only where the task limits the position |
| disturbance | 6 | torque and force in the middle of the period, where revealed |
| role | 1 | 1 for the leader |
| preview | 8 (preview + 1) | the leader's reference as in the tracking layout; 0 for the others |
| comm | K x (15 + 6 plan) | what was heard of each in-neighbour, see the COMM entries |
| sensed | K_s x 7 | 1, p_j - p_i 3, v_j - v_i 3 of whoever is near, most urgent first |
| measured | (1 + K) x 5 | valid, range, sin, cos of azimuth, elevation: own, then per comm slot |
| slot | 3 | wanted position relative to the target |
| estimate | (1 + K) x 13 | from the estimate wrapper: valid, r - p_i 3, v 3, position covariance 6 |
| disturbance_estimate | 6 | torque and force as they were estimated, where somebody appends them |

Positions are relative to the observing vehicle i, axes inertial (NED), SI units, unscaled. A neighbour keeps
its comm slot for the whole episode; while nothing valid was heard of it, the slot is zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..parameters import Array
from .tracking import N_OWN, N_REFERENCE, as_observations, vehicle_parts

# Entries of a comm slot.
COMM_WEIGHT = 0  # G_ij; 0: nothing heard
COMM_AGE = 1  # s since it was sent
COMM_POSITION = slice(2, 5)  # p_j(sent) - p_i(now)
COMM_VELOCITY = slice(5, 8)  # v_j(sent) - v_i(now), inertial
COMM_ATTITUDE = slice(8, 12)  # phi_j, theta_j, sin psi_j, cos psi_j
COMM_OFFSET = slice(12, 15)  # delta_ij = p_i* - p_j*, the receiver's own knowledge
N_COMM = 15
N_PLAN_STAGE = 6  # p_j(k + q) - p_i(now), v_j(k + q) - v_i(now)
N_SENSED = 7
N_MEASURED = 5
N_ESTIMATE = 13


class AgentView(NamedTuple):
    """The parts of agents' observations, batch axes first, float64."""

    V_B: Array  # (..., 3), m/s
    Theta: Array  # (..., 3), rad, yaw in (-pi, pi]
    Omega: Array  # (..., 3), rad/s
    F: Array  # (..., 4), N
    last_command: Array  # (..., 4), N
    position: Array  # (..., 3), m; zero where the task does not observe it
    torque: Array  # (..., 3), N m; zero where not revealed
    force: Array  # (..., 3), N; zero where not revealed
    leader: NDArray[np.bool_]  # (...)
    preview: Array  # (..., preview + 1, 8)
    comm: Array  # (..., K, 15 + 6 plan)
    sensed: Array  # (..., K_s, 7)
    measured: Array  # (..., 1 + K, 5); no rows where there is no target
    slot: Array  # (..., 3); zero where there is no target
    estimate: Array  # (..., 1 + K, 13); no rows without the estimate wrapper


@dataclass(frozen=True, slots=True)
class AgentLayout:
    """Which parts an agent's observation has and where they stand.

    Raises:
        ValueError: If a count is negative.
    """

    preview: int = 5  # N_p, stages of the leader's reference after the present one
    neighbours: int = 5  # K, comm slots
    sensed: int = 5  # K_s, sensed slots
    plan: int = 0  # stages of each neighbour's plan, 0 where plans are not shared
    position: bool = False
    disturbance: bool = False
    target: bool = False  # whether there are `measured` and `slot`
    estimate: bool = False  # whether the estimate wrapper added its block
    disturbance_estimate: bool = False  # behind the rest, where somebody estimates

    def __post_init__(self) -> None:
        for name in ("preview", "neighbours", "sensed", "plan"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} of an agent layout must be >= 0, got {getattr(self, name)}")

    @property
    def comm_size(self) -> int:
        """Numbers in a comm slot."""
        return N_COMM + N_PLAN_STAGE * self.plan

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Name -> shape of the parts that this observation has, in their order."""
        K = self.neighbours
        parts: list[tuple[str, tuple[int, ...], bool]] = [
            ("V_B", (3,), True),
            ("phi_theta", (2,), True),
            ("sin_cos_psi", (2,), True),
            ("Omega", (3,), True),
            ("F", (4,), True),
            ("last_command", (4,), True),
            ("position", (3,), self.position),
            ("disturbance", (6,), self.disturbance),
            ("role", (1,), True),
            ("preview", (self.preview + 1, N_REFERENCE), True),
            ("comm", (K, self.comm_size), True),
            ("sensed", (self.sensed, N_SENSED), True),
            ("measured", (1 + K, N_MEASURED), self.target),
            ("slot", (3,), self.target),
            ("estimate", (1 + K, N_ESTIMATE), self.estimate),
            ("disturbance_estimate", (6,), self.disturbance_estimate),
        ]
        return {name: shape for name, shape, present in parts if present}

    @property
    def slices(self) -> dict[str, slice]:
        """Name -> slice of the flat observation; the parts of `own` are named, too."""
        out, start = {"own": slice(0, N_OWN)}, 0
        for name, shape in self.shapes.items():
            size = int(np.prod(shape))
            out[name] = slice(start, start + size)
            start += size
        return out

    @property
    def size(self) -> int:
        """Length of the observation."""
        return sum(int(np.prod(shape)) for shape in self.shapes.values())

    def decode(self, observation: NDArray[np.floating]) -> AgentView:
        """Split observations into named parts.

        Args:
            observation: (..., size).

        Returns:
            The parts with yaw as an angle.

        Raises:
            ValueError: If the last axis has another length.
        """
        obs = as_observations(observation, self.size)
        batch, slices = obs.shape[:-1], self.slices
        part = {name: obs[..., slices[name]].reshape(*batch, *shape) for name, shape in self.shapes.items()}
        return AgentView(
            **vehicle_parts(part, batch),
            leader=part["role"][..., 0] > 0.5,
            preview=part["preview"],
            comm=part["comm"],
            sensed=part["sensed"],
            measured=part.get("measured", np.zeros((*batch, 0, N_MEASURED))),
            slot=part.get("slot", np.zeros((*batch, 3))),
            estimate=part.get("estimate", np.zeros((*batch, 0, N_ESTIMATE))),
        )
