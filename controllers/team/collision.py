"""Collision avoidance: state rows that keep a vehicle away from those it senses, Eqs. (5.7), (5.8) corrected.

With d = p_i - p_j, `a = Rz(swirl) d / |d|` and the common centre c(t) = (p_i + p_j)/2 + t (v_i + v_j)/2:

    position rows, n = 1..N:   a'p_i(k+n)                       >= a'c(n dt) + d_s/2
    braking row, stage N:      a'p_i(k+N) + t_b a'v_i(k+N)      >= a'c(N dt + t_b) + d_s/2

Each vehicle yields half: a_ji = -a_ij, and the rows of i and j add up to a'(p_i - p_j) >= d_s. The moving
centre lets a convoy fly on, the braking row looks as far ahead as it takes to stop, and the swirl frees an
exactly symmetric meeting. Rows are soft: dense traffic makes hard ones contradict each other.

Violated rows pull at the rotors with their weight times the authority of a rotor (0.05 m/N on a braking row
of 0.25 s: 50 per N with a weight of 1e3), against a curvature of some 20 per N^2. So a plan has a tilt limit
of its own (`plan_tilt`, 0.5 rad; with alpha = 1/2 two vehicles that meet at 2 m/s each need 0.7 rad), and the
predicted velocity turns with the attitude (`turning_velocity`): otherwise rows push a climbing vehicle the
wrong way. Smallest distances, m, by the weight: 20 vehicles through one centre at 1 m/s each (16 flights;
how many of them are below 0.40), pairs that meet at 2 m/s each (20; alpha = 1/2, 0.7 rad), lattices of 100
vehicles (8, none crashes):

| weight | 30 | 100 | 300 | 1e3 | 3e3 | 1e4 |
|---|---|---|---|---|---|---|
| centre | 0.03 (16) | 0.36 (4) | 0.397 (1) | 0.425 (0) | 0.430 (0) | 0.429 (0) |
| pairs | 0.02 | 0.06 | 0.34 | 0.436 | 0.435 | 0.434 |
| lattices | | 0.404 | 0.410 | 0.405 | 0.369 | 0.342 |

Deviation:
    (5.7) as printed has the sign reversed, freezes the neighbour, and covers graph neighbours only, which the
    vehicles that collide mostly are not.
    The plan keeps 3 cm beyond d_s, and brakes for as long as 4 m/s^2 take to stop the governor's speed. With
    no such margin and 0.25 s, 20 vehicles come as close as 0.19 m, and a hexagon in gusts 0.384 m.
"""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from quad_envs.arguments.checks import require_choice
from quad_envs.arguments.kinds import require_kinds
from quad_envs.arguments.names import shown
from quad_envs.compilation.decorators import inline_kernel, kernel
from quad_envs.observations.team import COMM_AGE, COMM_WEIGHT, N_COMM, N_PLAN_STAGE
from quad_envs.parameters import N_STATE, Array
from quad_envs.rotations import sincos

from ..qp.ocp import StateRows, no_rows

AvoidanceRule = Literal["reciprocal", "frozen", "plan", "none"]
AvoidanceSet = Literal["sensed", "edges"]
COLLISION_SCRATCH = 9
BRAKING = 4.0  # m/s^2, at a tilt of 0.39 rad
USUAL_SPEED = 2.0  # m/s
# Former name of an option -> the one of today.
_FORMER = {
    "rule": "avoidance",
    "neighbours": "avoidance_set",
    "weight": "separation_weight",
    "margin": "separation_margin",
}
_COINCIDENT = 1e-9  # m, closer vehicles have no direction from one to the other
_SAME = 0.1  # m, a message and a sensed vehicle closer than that are one: vehicles keep 0.3 m


def time_to_stop(speed: float) -> float:
    """How long a vehicle of the governor's speed, m/s, brakes; of the usual one if it has no governor."""
    return (speed if speed < math.inf else USUAL_SPEED) / BRAKING


@dataclass(frozen=True)  # without slots, as the next one, so that options of several kinds can be combined
class SeparationOptions:
    """What every MPC lets choose that keeps vehicles apart.

    Raises:
        ValueError: If one is not allowed.
    """

    _: KW_ONLY
    braking_time: float | None = (
        None  # s, t_b; 0: no braking row. None: the time in which 4 m/s^2 stop a vehicle at the governor's
        # `speed`, or at 2 m/s where there is none
    )
    swirl: float = math.radians(5.0)  # rad, turn of every normal about the vertical
    separation_weight: float = 1e3  # exact penalty per metre of a separation row

    def __post_init__(self) -> None:
        require_kinds(self)
        if not 0.0 <= self.braking < math.inf:
            raise ValueError(f"braking_time must be finite and >= 0 s, got {shown(self.braking_time)}")
        if not abs(self.swirl) < math.pi / 2:
            raise ValueError(f"swirl must lie in (-pi/2, pi/2) rad, got {shown(self.swirl)}")
        if not self.separation_weight > 0.0:
            raise ValueError(f"separation_weight must be > 0 per m, got {shown(self.separation_weight)}")

    @property
    def fastest(self) -> float:
        """The governor's speed, m/s; inf for none."""
        return math.inf

    @property
    def braking(self) -> float:
        """t_b, s."""
        return time_to_stop(self.fastest) if self.braking_time is None else float(self.braking_time)


@dataclass(frozen=True)
class AvoidanceOptions(SeparationOptions):
    """How a vehicle keeps away from others.

    Raises:
        TypeError: If an option is called as it was before.
        ValueError: If one is not allowed.
    """

    avoidance: AvoidanceRule = (
        "reciprocal"  # rule: "frozen" is the dissertation's, its sign corrected; "plan"; "none"
    )
    avoidance_set: AvoidanceSet = "sensed"  # whom rows are for; "edges": those it hears within the radius
    moving_centre: bool = True  # whether the common centre of a pair moves with it; "reciprocal" alone
    _: KW_ONLY
    separation_margin: float = 0.03  # m, what the plan keeps beyond the separation; "reciprocal" alone

    def __new__(cls, *args: Any, **options: Any) -> AvoidanceOptions:
        """Refuse names of before; all else is checked later."""
        for name in _FORMER.keys() & options.keys() if cls is AvoidanceOptions else ():
            raise TypeError(f"AvoidanceOptions calls {name} now {_FORMER[name]}, as CooperativeMpc does")
        return object.__new__(cls)

    def __post_init__(self) -> None:
        SeparationOptions.__post_init__(self)
        require_choice("avoidance", self.avoidance, AvoidanceRule)
        require_choice("avoidance_set", self.avoidance_set, AvoidanceSet)
        if not 0.0 <= self.separation_margin < math.inf:
            raise ValueError(
                f"separation_margin must be finite and >= 0 m, got {shown(self.separation_margin)}"
            )

    def require_plans(self, stages: int) -> None:
        """Check that messages have plans of so many stages where the rule reads them.

        Raises:
            ValueError: If they have none.
        """
        if self.avoidance == "plan" and stages == 0:
            raise ValueError(
                "avoidance='plan' needs plans in the messages: make the environment with comm='plan'"
            )

    def avoidance_data(self, separation: float, radius: float, dt: float) -> AvoidanceData:
        """The same for compiled code."""
        reciprocal = self.avoidance == "reciprocal"
        turn = self.swirl if reciprocal else 0.0
        return AvoidanceData(
            self.avoidance == "none", self.avoidance == "plan", self.avoidance_set == "edges",
            0.5 if reciprocal else 1.0, self.moving_centre and reciprocal,
            self.braking if reciprocal else 0.0, math.sin(turn), math.cos(turn),
            float(separation) + (self.separation_margin if reciprocal else 0.0), float(radius), float(dt),
        )  # fmt: skip

    def separation_layout(self, slots: int, horizon: int) -> StateRows:
        """The rows of all slots with their numbers left open: normals zero, no bounds.

        A slot has one normal, a second one for its braking row, or with rule "plan" one for each stage.
        """
        if self.avoidance == "none" or slots == 0:
            return no_rows()
        braking = self.avoidance == "reciprocal" and self.braking > 0.0
        stages = np.arange(1, horizon + 1)
        normal = stages - 1 if self.avoidance == "plan" else np.zeros(horizon, dtype=np.int64)
        if braking:
            stages, normal = np.append(stages, horizon), np.append(normal, 1)
        first = (normal.max() + 1) * np.arange(slots)[:, None]
        rows = slots * len(stages)
        return StateRows(
            normals=np.zeros((slots * (int(normal.max()) + 1), N_STATE)),
            normal=(first + normal).reshape(-1).astype(np.int64),
            stage=np.tile(stages, slots).astype(np.int64),
            lower=np.full(rows, -math.inf),
            upper=np.full(rows, math.inf),
            weight=np.full(rows, float(self.separation_weight)),
        )


class AvoidanceData(NamedTuple):
    """`AvoidanceOptions` for compiled code."""

    off: bool
    plan: bool
    edges: bool
    share: float  # of the separation that this vehicle keeps: 1/2, or all of it
    moves: bool
    braking: float  # s
    sine: float  # of the swirl
    cosine: float
    separation: float  # m, d_s with the margin
    radius: float  # m, of the edge set
    dt: float


@inline_kernel
def _write_normal(
    x: float, y: float, z: float, braking: float, sincos_psi: tuple[float, float], plant: Array, out: Array
) -> None:
    """Normal of a'p + braking (R_BI a)'V_B, for an inertial a, in the heading frame of the problem."""
    ss, cs = sincos_psi
    sf, cf = sincos(plant[6])
    st, ct = sincos(plant[7])
    forward, side = cs * x + ss * y, cs * y - ss * x
    down = st * forward + ct * z
    for k in range(N_STATE):
        out[k] = 0.0
    out[0], out[1], out[2] = forward, side, z
    out[3] = braking * (ct * forward - st * z)
    out[4], out[5] = braking * (sf * down + cf * side), braking * (cf * down - sf * side)


@kernel
def _slot_of(j: int, comm: Array, sensed: Array, v: Array, data: AvoidanceData, other: Array) -> int:
    """Another vehicle's p_j - p_i and v_j into other, (6,); its comm slot or -1 - or -2: there is none.

    A message is moved on by its age. The message of a sensed vehicle is the one that puts it there.
    """
    if data.edges:
        if comm[j, COMM_WEIGHT] <= 0.0:
            return -2
        for a in range(3):
            other[3 + a] = comm[j, 5 + a] + v[a]
            other[a] = comm[j, 2 + a] + comm[j, COMM_AGE] * other[3 + a]
        far = other[0] * other[0] + other[1] * other[1] + other[2] * other[2] >= data.radius * data.radius
        return -2 if far else j
    if sensed[j, 0] <= 0.0:
        return -2
    for a in range(3):
        other[a], other[3 + a] = sensed[j, 1 + a], sensed[j, 4 + a] + v[a]
    if data.plan:
        for k in range(comm.shape[0]):
            distance = 0.0
            for a in range(3):
                gap = comm[k, 2 + a] + comm[k, COMM_AGE] * (comm[k, 5 + a] + v[a]) - other[a]
                distance += gap * gap
            if comm[k, COMM_WEIGHT] > 0.0 and distance < _SAME * _SAME:
                return k
    return -1


@kernel
def _centre_rows(
    plant: Array,
    v: Array,
    other: Array,
    gap: float,
    data: AvoidanceData,
    D: Array,
    normals: Array,
    lower: Array,
    N: int,
) -> None:
    """Rows of the rules "reciprocal" and "frozen": half-spaces that keep one normal over the horizon."""
    x = -(data.cosine * other[0] - data.sine * other[1]) / gap
    y = -(data.sine * other[0] + data.cosine * other[1]) / gap
    z = -other[2] / gap
    heading = sincos(plant[8])
    start = data.share * (x * other[0] + y * other[1] + z * other[2] + data.separation)
    speed = 0.0
    if data.moves:
        speed = 0.5 * (x * (other[3] + v[0]) + y * (other[4] + v[1]) + z * (other[5] + v[2]))
    _write_normal(x, y, z, 0.0, heading, plant, normals[0])
    for n in range(N):
        lower[n] = start + (n + 1) * data.dt * speed
    if data.braking > 0.0:
        _write_normal(x, y, z, data.braking, heading, plant, normals[1])
        lower[N] = start + (N * data.dt + data.braking) * speed
        for b in range(3):  # the velocity turns with the attitude, see `turning_velocity`
            row = normals[1]
            turn = data.braking * (row[0] * D[0, b] + row[1] * D[1, b] + row[2] * D[2, b])
            row[6 + b] = turn
            lower[N] += turn * (plant[6 + b] if b < 2 else 0.0)


@kernel
def _planned(plan: Array, stages: int, n: float, v: Array, dt: float, out: Array) -> None:
    """Position at stage n of a plan (flat, 6 numbers a stage, velocities less v), past its end moved on."""
    m = min(int(n), stages - 1)
    for a in range(3):
        out[a] = plan[N_PLAN_STAGE * m + a] + (n - m) * dt * (plan[N_PLAN_STAGE * m + 3 + a] + v[a])


@kernel
def _plan_rows(
    plant: Array,
    v: Array,
    own: Array,
    other: Array,
    message: Array,
    data: AvoidanceData,
    normals: Array,
    lower: Array,
    work: Array,
) -> None:
    """Rows of the rule "plan": at stage n along the difference of the two last plans.

    The own plan, if there is one, is moved so that it starts at the present position. A vehicle whose plan is
    not known keeps its velocity, as does this one at its first decision.
    """
    N = lower.shape[0]
    mine, theirs = work[:3], work[3:6]
    no_offset = work[6:9]
    size = 0.0
    for k in range(N_COMM, message.shape[0]):
        size += abs(message[k])
    heading = sincos(plant[8])
    for a in range(3):
        no_offset[a] = 0.0
    for n in range(1, N + 1):
        for a in range(3):
            mine[a] = n * data.dt * v[a]
            theirs[a] = other[a] + n * data.dt * other[3 + a]
        if own.shape[0] > 0:
            _planned(own, N, float(n), no_offset, data.dt, mine)
            for a in range(3):
                mine[a] -= own[a]
        if size > 0.0:
            ahead = n + math.floor(message[COMM_AGE] / data.dt + 0.5)
            _planned(message[N_COMM:], (message.shape[0] - N_COMM) // N_PLAN_STAGE, ahead, v, data.dt, theirs)
        x, y, z = mine[0] - theirs[0], mine[1] - theirs[1], mine[2] - theirs[2]
        gap = math.sqrt(x * x + y * y + z * z)
        if gap < _COINCIDENT:
            x, y, z = -other[0], -other[1], -other[2]
            gap = math.sqrt(x * x + y * y + z * z)
        x, y, z = x / gap, y / gap, z / gap
        _write_normal(x, y, z, 0.0, heading, plant, normals[n - 1])
        lower[n - 1] = x * theirs[0] + y * theirs[1] + z * theirs[2] + data.separation


@kernel
def separation_rows(
    plant: Array,
    v: Array,
    comm: Array,
    sensed: Array,
    own: Array,
    N: int,
    data: AvoidanceData,
    D: Array,
    normals: Array,
    lower: Array,
    other: Array,
    work: Array,
) -> int:
    """Normals and lower bounds of one vehicle's rows, in the heading frame of `mpc.kernels`, packed.

    Args:
        plant: Measured, (16,); its position is not read.
        v: Own inertial velocity, (3,).
        comm: Messages, (K, 15 + 6 N_p).
        sensed: (K_s, 7).
        own: This vehicle's previous plan as in `CooperativeDecision`, flat, (6 N,), or empty.
        N: Horizon.
        data: Options.
        D: How the predicted inertial velocity turns with the attitude, in the heading frame, (3, 3).
        normals: Result, (>= slots x normals of a slot, 12), as `AvoidanceOptions.layout` numbers them.
        lower: Result, (>= slots x rows of a slot,).
        other: Overwritten, (6,).
        work: Overwritten, (COLLISION_SCRATCH,).

    Returns:
        How many vehicles have rows. One at the same place has none: there is no direction away from it.
    """
    if data.off:
        return 0
    used = 0
    braking = 1 if data.braking > 0.0 else 0
    H, K = N if data.plan else 1 + braking, N + braking
    for j in range(comm.shape[0] if data.edges else sensed.shape[0]):
        slot = _slot_of(j, comm, sensed, v, data, other)
        if slot == -2:
            continue
        gap = math.sqrt(other[0] * other[0] + other[1] * other[1] + other[2] * other[2])
        if gap < _COINCIDENT:
            continue
        h, k = normals[H * used : H * (used + 1)], lower[K * used : K * (used + 1)]
        if data.plan:
            message = comm[slot] if slot >= 0 else other[:0]
            _plan_rows(plant, v, own, other, message, data, h, k, work)
        else:
            _centre_rows(plant, v, other, gap, data, D, h, k, N)
        used += 1
    return used
