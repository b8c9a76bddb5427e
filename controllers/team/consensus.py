"""References of one vehicle from what it hears of its neighbours and knows of a target, Eqs. (5.4), (7.2).

Relative to the own present position (p_i = 0), axes inertial. From (r_0, w_0) = (0, v_i)
on, with p_j, v_j the neighbour as extrapolated to stage n and t its age plus n dt:

    r~ = r_{n-1} + w_{n-1} dt + b_{n-1} dt^2/2,  w~ = w_{n-1} + b_{n-1} dt      (own term, moved on)
    r_n = (r~ + sum_j G_ij (p_j + delta_ij)) / (1 + sum_j G_ij),  w_n and b_n likewise

Deviation:
    (5.4) as printed sums over those who hear i, which drives every reference to the origin, freezes the
    neighbours over the horizon and leaves its own term where it was: a lag of N dt times the speed per hop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from quad_envs.arguments.checks import require_choice
from quad_envs.arguments.kinds import require_kinds
from quad_envs.compilation.decorators import kernel
from quad_envs.observations.team import N_COMM, N_PLAN_STAGE
from quad_envs.observations.tracking import N_REFERENCE
from quad_envs.parameters import Array
from quad_envs.tasks import TeamTask

from ..controller import PLANT_SIZE, as_array
from .consensus_kernels import CONSENSUS_SCRATCH, ConsensusData, consensus_row
from .situation import TargetEstimate

Neighbour = Literal["cv", "frozen", "ca", "plan"]
TargetModel = Literal["cv", "frozen"]


@dataclass(frozen=True)  # without slots, as the next one, so that options of several kinds can be combined
class NeighbourOptions:
    """How references are made of messages.

    Raises:
        ValueError: If one is not allowed; `attitude` needs `neighbour="ca"`.
    """

    neighbour: Neighbour = (
        "cv"  # how neighbours move on over the horizon: "cv", constant velocity; "frozen", the
        # dissertation's; "ca", constant acceleration, from their attitude; "plan", as they sent
    )
    feed_forward: bool = True  # whether the own term moves on with its velocity; the dissertation's does not
    attitude: bool = False  # tilt references from the neighbours' accelerations; diverges on cyclic graphs
    reach: float = 1.0  # m, governor: largest distance of a reference; inf for none, as in the dissertation
    speed: float = 2.0  # m/s, governor: largest velocity reference, above the leader's; inf for none

    def __post_init__(self) -> None:
        require_kinds(self)
        require_choice("neighbour", self.neighbour, Neighbour)
        if self.attitude and self.neighbour != "ca":
            raise ValueError(
                f"attitude needs the neighbours' accelerations: set neighbour='ca', got {self.neighbour!r}"
            )
        _require_positive(reach=self.reach, speed=self.speed)


@dataclass(frozen=True)
class ConsensusOptions(NeighbourOptions):
    """How references are made of messages and of a target estimate.

    Raises:
        ValueError: If one is not allowed; `attitude` needs `neighbour="ca"`.
    """

    formation_weight: float = (
        0.1  # m^2, P_f of (7.2): the estimate's variance at which both sides weigh alike
    )
    target: TargetModel = "cv"  # the target moves on over the horizon, or "frozen": stays (the dissertation)

    def __post_init__(self) -> None:
        NeighbourOptions.__post_init__(self)
        require_choice("target", self.target, TargetModel)
        _require_positive(formation_weight=self.formation_weight)
        if math.isinf(self.formation_weight):
            raise ValueError("formation_weight must be finite, m^2; large means: follow the estimate")

    def consensus_data(self, dt: float, gravity: float) -> ConsensusData:
        """The same for compiled code."""
        return ConsensusData(
            get_args(Neighbour).index(self.neighbour), bool(self.feed_forward), bool(self.attitude),
            float(self.reach), float(self.speed), float(self.formation_weight), self.target == "cv",
            float(dt), float(gravity),
        )  # fmt: skip


def _require_positive(**options: float) -> None:
    for name, value in options.items():
        if not value > 0.0:
            raise ValueError(f"{name} must be > 0, got {value!r}; math.inf is no limit")


class ConsensusReference(NamedTuple):
    """References of a batch of vehicles for the stages 0..N; stage 0 is the present."""

    window: Array  # (n, N+1, 8): r - p_i, w (inertial), sin and cos of psi_ref
    attitude: Array  # (n, N+1, 2): roll and pitch, rad; zero without `attitude`


@kernel
def _reference_rows(
    plants: Array,
    leads: Array,
    previews: Array,
    comms: Array,
    r: Array,
    v: Array,
    P: Array,
    slots: Array,
    data: ConsensusData,
    windows: Array,
    attitudes: Array,
    work: Array,
) -> None:
    for j in range(plants.shape[0]):
        consensus_row(
            plants[j], leads[j] > 0.0, previews[j], comms[j], r[j], v[j], P[j], slots[j], data, windows[j],
            attitudes[j], work,
        )  # fmt: skip


def consensus_reference(
    plant: ArrayLike,
    comm: ArrayLike,
    *,
    horizon: int = 5,
    options: ConsensusOptions | None = None,
    leader: ArrayLike | None = None,
    preview: ArrayLike | None = None,
    target: TargetEstimate | None = None,
    task: TeamTask | None = None,
    **former: float,
) -> ConsensusReference:
    """References of vehicles from their messages, (5.4) corrected; with a target estimate fused, (7.2).

    Args:
        plant: Measured [p, V_B, Theta, Omega, F], (n, 16); positions are not read.
        comm: Messages, (n, K, 15 + 6 N_p), laid out as in `quad_envs.observations.team`.
        horizon: N.
        options: ConsensusOptions; None for the defaults.
        leader: Which vehicles follow their preview, (n,) bool; None for none.
        preview: The leader's reference relative to its own position, (n, >= N+1, 8); rows of others are not
            read.
        target: Estimates to fuse with; a huge covariance leaves the pure formation reference.
        task: What is known of the flight, for its control period and gravity; None: the usual one.
        former: Nothing: `dt` and `gravity` were arguments of their own before.

    Returns:
        Windows relative to each vehicle's own position, and roll and pitch references.

    Raises:
        TypeError: If there is no such argument.
        ValueError: If a shape is wrong, or plans are wanted that the messages lack.
    """
    for name in former:
        raise TypeError(
            f"consensus_reference has no {name}: pass task=..., whose dt and params.gravity it takes"
        )
    options, task = options or ConsensusOptions(), task or TeamTask()
    plants, comms = as_array(plant), as_array(comm)
    n, stages = len(plants), horizon + 1
    leads = np.zeros(n) if leader is None else as_array(leader)
    previews = np.zeros((n, stages, N_REFERENCE)) if preview is None else as_array(preview)
    if plants.shape != (n, PLANT_SIZE) or comms.ndim != 3 or len(comms) != n or leads.shape != (n,):
        raise ValueError(
            f"plant must be (n, {PLANT_SIZE}), comm (n, K, >= {N_COMM}), leader (n,); "
            f"got {plants.shape}, {comms.shape}, {leads.shape}"
        )
    if previews.ndim != 3 or len(previews) != n or previews.shape[1] < stages or previews.shape[2] != 8:
        raise ValueError(f"preview must be (n, >= {stages}, {N_REFERENCE}), got {previews.shape}")
    require_messages(comms.shape[2], options)
    empty = TargetEstimate(*(np.zeros((n, 0)) for _ in range(4))) if target is None else target
    r, v, P, slot = (as_array(part).reshape(n, -1) for part in empty)
    if target is not None and (r.shape[1], v.shape[1], P.shape[1], slot.shape[1]) != (3, 3, 9, 3):
        raise ValueError("target needs r (n, 3), v (n, 3), P (n, 3, 3) and slot (n, 3)")
    out = ConsensusReference(np.empty((n, stages, N_REFERENCE)), np.empty((n, stages, 2)))
    data, work = options.consensus_data(task.dt, task.params.gravity), np.empty(CONSENSUS_SCRATCH)
    _reference_rows(plants, leads, previews, comms, r, v, P, slot, data, *out, work)
    return out


def require_messages(size: int, options: ConsensusOptions) -> None:
    """Check the length of a comm slot.

    Raises:
        ValueError: If it is none, or lacks the plans that the options want.
    """
    if size < N_COMM or (size - N_COMM) % N_PLAN_STAGE:
        raise ValueError(
            f"a comm slot has {N_COMM} numbers plus {N_PLAN_STAGE} per planned stage, got {size}"
        )
    if options.neighbour == "plan" and size == N_COMM:
        raise ValueError(
            "neighbour='plan' needs plans in the messages: make the environment with comm='plan'"
        )
