"""Keyword arguments of the multi-agent environments, as validated values."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any, ClassVar, Literal, get_args

import numpy as np

from ...arguments.checks import Bound, array_bytes, require_number
from ...arguments.kinds import is_number
from ...arguments.names import shown
from ...formations import (
    FARTHEST,
    FORMATIONS,
    MOST_VEHICLES,
    START_GAP,
    STARTS,
    make_formation,
    nearest_pair,
    tried_starts,
)
from ...graphs import (
    GraphLike,
    GraphSchedule,
    GraphTable,
    has_spanning_tree,
    in_neighbours,
    make_graph_table,
    toward_leader,
)
from ...observations.team import N_COMM, N_SENSED, AgentLayout
from ...observations.tracking import N_REFERENCE
from ...parameters import Array, QuadrotorParams
from ...references import ReferenceLike
from ...sensors import DEFAULT_SENSOR, sensor_rows
from ...targets import TargetLike, make_target
from ...tasks import TeamTask
from ..shared.given import as_numbers
from ..shared.vehicle_options import MOST_PREVIEW, MOST_STEPS, Triple, VehicleOptions, spread

_MOST_SLOTS = MOST_VEHICLES - 1  # of an observation; more could hear or see nobody
_MOST_DELAY = 10_000  # control periods
_METRES = Bound(0.0, 1e6, "m", open=True)
_SHARE = Bound(0.0, 1.0)
_FACTOR = Bound(0.0, 1e9)
FEW_VEHICLES = 6  # up to which everybody has a slot for everybody
_SLOTS_OF_A_CROWD = 8
CHAPTER_7_SLOTS = (
    (-1.0, 0.0, -0.8),
    (-1.0, 1.2, 0.4),
    (-1.0, -1.2, 0.4),
    (-2.2, 0.7, -0.3),
    (-2.2, -0.7, -0.3),
    (-2.2, 0.0, 0.8),
)
CHAPTER_6_RAILS = ((0.0, 0.0, 0.0), (4.0, 0.0, -1.0), (0.0, 4.0, 1.0), (4.0, 4.0, -2.0))
_STAGGER = 0.4  # m, up and down in turn: a plane of vehicles cannot tell the target from its mirror image
_SEPARATION = 0.4  # m
_BESIDE = 0.07  # m, by which the separation exceeds the distance of a crash, as by default
_BEHIND = (-1.0, 0.0, 0.0)  # m, of a named formation relative to the target

Comm = Literal["state", "plan"]
Terminate = Literal["team", "agent"]
_Rows = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class TeamOptions(VehicleOptions):
    """What the multi-agent environments share. `FormationEnv` documents each field."""

    mission: ClassVar[str] = ""
    has_leader: ClassVar[bool] = False

    tilt_limit: float = 1.2
    time_limit: float = 20.0
    max_cycles: int | None = None  # in place of time_limit, as in PettingZoo
    vehicles: int = 6
    formation: str | _Rows = "lattice"  # a name, or slots (N, 3), m
    spacing: float = 1.0  # m, between the slots of a named formation
    graph: str | GraphLike | GraphSchedule = "weak"  # who hears whom: a name, edges, a matrix or a schedule
    leader_weight: float = 10.0
    drop_out: float = 0.0  # probability that a message is lost
    delay: int = 0  # control periods that a message is under way
    message_lifetime: float = 2.0  # s, after which a message is forgotten
    comm: Comm = "state"
    start: str | _Rows = "random"
    separation: float = _SEPARATION  # m, least distance between vehicles: a limit
    crash_distance: float = 0.33  # m, below which two crash
    sensing_radius: float = 2.0  # m, within which others are seen, heard or not
    neighbours: int | None = None
    sensed: int | None = None
    preview: int = 5  # control periods of the coming reference in the observation
    terminate: Terminate = "team"  # whom a crash ends: "team" or "agent"
    arena: float = 100.0
    formation_weight: float = 1.0
    # Made once from the rest, because a graph may come from a user's function.
    graphs: GraphTable = field(init=False, repr=False, compare=False)
    task: TeamTask = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        self.take_cycles()
        VehicleOptions.__post_init__(self)
        self.require_whole("vehicles", 2, MOST_VEHICLES)
        self.require_whole("delay", 0, _MOST_DELAY, lambda n: array_bytes((n, self.vehicles, N_COMM)))
        least = 1 if isinstance(self.comm, str) and self.comm == "plan" else 0
        self.require_whole("preview", least, MOST_PREVIEW, partial(self._row_bytes, "preview"))
        for name in ("separation", "crash_distance", "sensing_radius", "arena"):
            require_number(name, getattr(self, name), _METRES)
        for name, kind in (("comm", Comm), ("terminate", Terminate)):
            value = getattr(self, name)
            if not isinstance(value, str) or value not in get_args(kind):
                allowed = " or ".join(map(repr, get_args(kind)))
                raise ValueError(f"{name} must be {allowed}, got {shown(value)}")
        require_number("drop_out", self.drop_out, _SHARE)
        if not (is_number(self.message_lifetime) and self.message_lifetime >= self.delay * self.dt):
            raise ValueError(
                f"message_lifetime must be a finite number of seconds and at least the delay of {self.delay} "
                f"steps = {self.delay * self.dt:g} s, or messages expire on their way; "
                f"got {shown(self.message_lifetime)}"
            )
        for name in ("leader_weight", "formation_weight"):
            require_number(name, getattr(self, name), _FACTOR)
        if self.crash_distance >= self.separation:
            raise ValueError(
                f"crash_distance {self.crash_distance!r} m must be below the separation {self.separation!r} m"
            )
        self.make_slots()  # what is wrong with the formation is said before what follows from it
        object.__setattr__(self, "graphs", self._make_graphs())
        object.__setattr__(self, "task", self._make_task())
        self.check_start()

    def take_cycles(self) -> None:
        """The time limit of PettingZoo's `max_cycles`."""
        if self.max_cycles is not None:
            self.require_whole("max_cycles", 1, MOST_STEPS)
            self.require_times()
            object.__setattr__(self, "time_limit", self.max_cycles * self.dt)

    @classmethod
    def that_follow(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        """Of vehicles with another arm: a crash where tips meet, and a separation that exceeds it."""
        arm = values.get("arm", QuadrotorParams().arm)
        if not is_number(arm) or arm == QuadrotorParams().arm:
            return {}
        return {"crash_distance": 2.0 * arm, "separation": max(_SEPARATION, 2.0 * arm + _BESIDE)}

    def check_start(self) -> None:
        """Refuse a start that cannot be flown.

        Raises:
            ValueError: If it is unknown, of the wrong size, or two vehicles start in a crash.
        """
        if isinstance(self.start, str) and self.start in STARTS and self.crash_distance > START_GAP:
            raise ValueError(
                f"vehicles of the start {self.start!r} may be {START_GAP:g} m apart, which is a crash "
                f"(crash_distance = {self.crash_distance:g} m): lower it, or give an (N, 3) array"
            )
        for p in tried_starts(self.start, np.array(self.task.slots), self.separation):
            self.require_apart(p)

    def require_apart(self, p: Array) -> None:
        """Refuse first positions p (N, 3), m, that are a crash.

        Raises:
            ValueError: If they are.
        """
        i, j, least = nearest_pair(p)
        if least < self.crash_distance:
            raise ValueError(
                f"vehicles {i} and {j} start {least:.3g} m apart, which is a crash (crash_distance = "
                f"{self.crash_distance:g} m); move them apart"
            )

    def _row_bytes(self, name: str, count: int) -> float:
        """Bytes of a team's observations that so many stages, neighbours or sensed vehicles take."""
        each = {"preview": N_REFERENCE, "neighbours": N_COMM, "sensed": N_SENSED}[name]
        return array_bytes((self.vehicles, count, each))

    def make_slots(self) -> Array:
        """Wanted positions p_i*, (N, 3), m, relative to the leader's or to the target."""
        return make_formation(self.formation, self.vehicles, self.spacing, self.separation)

    def _make_graphs(self) -> GraphTable:
        """The graphs of an episode; a link toward the leader weighs `leader_weight` where weights are 1."""
        name = self.formation if isinstance(self.formation, str) and self.formation in FORMATIONS else None
        table = make_graph_table(self.graph, name, self.vehicles, self.episode_steps, self.dt)
        graphs = table.graphs
        if self.has_leader and np.isin(graphs, (0.0, 1.0)).all():
            graphs = np.where(graphs > 0.0, toward_leader(graphs.max(axis=0), self.leader_weight), 0.0)
        return GraphTable(graphs, table.which)

    def informed(self) -> list[int]:
        """Vehicles that know where to go without hearing anybody."""
        return [0]

    def _make_task(self) -> TeamTask:
        """The task that follows from the options.

        Raises:
            ValueError: If a vehicle hears more neighbours than there are slots.
        """
        slots, graphs = self.make_slots(), self.graphs
        if len(slots) != self.vehicles:
            raise ValueError(f"vehicles must be {len(slots)}, one per slot, got {shown(self.vehicles)}")
        in_degree = in_neighbours(graphs.graphs).shape[1]
        crowd = self.vehicles > FEW_VEHICLES
        for name in ("neighbours", "sensed"):
            if getattr(self, name) is not None:
                self.require_whole(name, 1, _MOST_SLOTS, partial(self._row_bytes, name))
        K = self.neighbours or (_SLOTS_OF_A_CROWD if crowd else FEW_VEHICLES - 1)
        if in_degree > K:
            raise ValueError(
                f"a vehicle hears {in_degree} others in an episode, and its observation has {K} comm slots: "
                f"pass neighbours={in_degree}, or a sparser graph"
            )
        spanned = self._spans(graphs)
        if not spanned:
            nobody = "" if self.informed() else "; nobody measures: let somebody (measuring=, detection=)"
            warnings.warn(
                f"the union of the graphs {shown(self.graph)} has no spanning tree from "
                f"{'the leader' if self.has_leader else 'the vehicles that measure'} to everybody: "
                f"who is not reached cannot follow{nobody}",
                stacklevel=2,
            )
        known = self.task_fields()
        layout = AgentLayout(
            preview=int(self.preview),
            neighbours=int(K),
            sensed=int(self.sensed or (_SLOTS_OF_A_CROWD if crowd else FEW_VEHICLES - 1)),
            plan=int(self.preview) if self.comm == "plan" else 0,
            position=known["limits"].has_position,
            disturbance=self.reveal_disturbance,
            target=not self.has_leader,
        )
        return TeamTask(
            layout=layout,
            mission=self.mission,
            vehicles=int(self.vehicles),
            slots=tuple((float(x), float(y), float(z)) for x, y, z in slots),
            separation=self.separation,
            crash_distance=self.crash_distance,
            sensing_radius=self.sensing_radius,
            formation_weight=self.formation_weight,
            spanning_tree=spanned,
            **self._target_fields(),
            **known,
        )

    def _target_fields(self) -> dict[str, Any]:
        return {}

    def _spans(self, graphs: GraphTable) -> bool:
        """Whether news from an informed vehicle can reach everybody, in the union of all graphs."""
        n = self.vehicles
        union = np.eye(n + 1)
        if self.drop_out < 1.0:
            union[1:, 1:] = graphs.graphs.max(axis=0)
        union[[1 + i for i in self.informed()], 0] = 1.0
        return has_spanning_tree(union)


@dataclass(frozen=True, slots=True, kw_only=True)
class FormationOptions(TeamOptions):
    """What can be chosen about a formation flight. `FormationEnv` documents each field."""

    kind: ClassVar[str] = "a formation"
    mission: ClassVar[str] = "formation"
    has_leader: ClassVar[bool] = True

    env_id: str = "quad/Formation-v0"
    reference: ReferenceLike = "line"  # afterwards what is flown

    def __post_init__(self) -> None:
        self.take_cycles()
        object.__setattr__(self, "reference", self.within_episode(self.take_time_limit(self.reference)))
        TeamOptions.__post_init__(self)

    def make_slots(self) -> Array:
        """Wanted positions relative to the leader's, (N, 3), m."""
        slots = TeamOptions.make_slots(self)
        return np.asarray(slots - slots[0])


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetTrackingOptions(TeamOptions):
    """What can be chosen about target tracking. `TargetTrackingEnv` documents each field."""

    kind: ClassVar[str] = "a target-tracking"
    mission: ClassVar[str] = "target-tracking"

    env_id: str = "quad/TargetTracking-v0"
    formation: str | _Rows = "chapter-7"
    graph: str | GraphLike | GraphSchedule = "ring"
    target: TargetLike = "cv"  # afterwards what moves
    target_spread: tuple[float, float] = (0.0, 0.0)
    sensor: str = DEFAULT_SENSOR
    sensor_sigma: Triple = (0.1, 0.02, 0.02)
    detection: float = 1.0
    measuring: str | tuple[int, ...] = "all"
    prior_velocity: Triple = (0.0, 0.0, 0.0)
    prior_sigma: tuple[float, float] = (3.0, 1.0)

    def __post_init__(self) -> None:
        require_number("detection", self.detection, _SHARE)
        if not isinstance(self.sensor_sigma, tuple):
            raise ValueError(
                "sensor_sigma must be three standard deviations, of range, m, azimuth, rad, and elevation, "
                f"rad; got {shown(self.sensor_sigma)}"
            )
        for name, length in (
            *(("sensor_sigma", 3), ("prior_velocity", 3), ("prior_sigma", 2), ("target_spread", 2)),
        ):
            values = spread(name, getattr(self, name), length)
            if name != "prior_velocity" and min(values) < (0.0 if name == "target_spread" else 1e-9):
                raise ValueError(
                    f"{name} must be positive standard deviations, got {shown(getattr(self, name))}"
                )
            if max(map(abs, values)) > FARTHEST:
                raise ValueError(
                    f"{name} must be at most {FARTHEST:g} (SI), got {shown(getattr(self, name))}"
                )
            object.__setattr__(self, name, values)
        self._warn_of_narrow_prior()
        sensor_rows(self.sensor)
        target = make_target(self.target)
        TeamOptions.__post_init__(self)
        object.__setattr__(self, "target", self.within_episode(target))

    def make_slots(self) -> Array:
        """Wanted positions relative to the target, (N, 3), m."""
        if isinstance(self.formation, str) and self.formation == "chapter-7":
            if self.vehicles != len(CHAPTER_7_SLOTS):
                raise ValueError(
                    f"the formation 'chapter-7' has {len(CHAPTER_7_SLOTS)} slots, got vehicles="
                    f"{self.vehicles!r}: choose 'lattice' or give (N, 3) offsets from the target"
                )
            return np.array(CHAPTER_7_SLOTS)
        slots = TeamOptions.make_slots(self)
        if isinstance(self.formation, str):
            slots = slots + np.array(_BEHIND)
            slots[:, 2] += _STAGGER * (-1.0) ** np.arange(self.vehicles)
        return slots

    def _warn_of_narrow_prior(self) -> None:
        """Say if targets start farther from where they are expected than filters are told."""
        for what, unit, true, told in zip(
            ("position", "velocity"), ("m", "m/s"), self.target_spread, self.prior_sigma, strict=True
        ):
            if true > told:
                warnings.warn(
                    f"the target's {what} spreads by {true:g} {unit} (target_spread), and the prior of every "
                    f"filter says {told:g} {unit} (prior_sigma): filters begin too sure of a wrong place; "
                    "raise prior_sigma to at least target_spread",
                    stacklevel=2,
                )

    def informed(self) -> list[int]:
        """Vehicles that measure the target."""
        if self.detection == 0.0:
            return []
        if isinstance(self.measuring, str):
            if self.measuring != "all":
                raise ValueError(f"measuring must be 'all' or vehicle numbers, got {shown(self.measuring)}")
            return list(range(self.vehicles))
        if not isinstance(self.measuring, tuple):
            raise ValueError(f"measuring must be 'all' or vehicle numbers, got {shown(self.measuring)}")
        for i in self.measuring:
            if isinstance(i, bool) or not isinstance(i, int | np.integer) or not 0 <= i < self.vehicles:
                raise ValueError(f"measuring names vehicle {shown(i)}; there are 0 .. {self.vehicles - 1}")
        return [int(i) for i in self.measuring]

    def _target_fields(self) -> dict[str, Any]:
        return {
            "sensor": self.sensor,
            "sensor_sigma": self.sensor_sigma,
            "prior_velocity": self.prior_velocity,
            "prior_sigma": self.prior_sigma,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimationOptions(TargetTrackingOptions):
    """What can be chosen about cooperative estimation. `CooperativeEstimationEnv` documents each field."""

    kind: ClassVar[str] = "a cooperative-estimation"
    mission: ClassVar[str] = "estimation"

    env_id: str = "quad/CooperativeEstimation-v0"
    time_limit: float = 10.0
    vehicles: int = 4
    graph: str | GraphLike | GraphSchedule = "chapter-6"
    rails: _Rows = CHAPTER_6_RAILS
    rail_velocity: Triple = (0.8, 0.3, -0.1)
    target: TargetLike = "chapter-6"
    target_spread: tuple[float, float] = (0.5, 0.5)
    prior_velocity: Triple = (0.8, 0.3, -0.1)
    prior_sigma: tuple[float, float] = (0.5, 0.5)

    def __post_init__(self) -> None:
        if self.comm == "plan":
            raise ValueError("comm='plan' needs vehicles that fly; on rails choose comm='state'")
        defaults = {entry.name: entry.default for entry in fields(TargetTrackingOptions)}
        for name in ("formation", "spacing", "start"):
            if getattr(self, name) != defaults[name]:
                raise ValueError(f"{name} has no effect on vehicles on rails: leave it out, or change rails")
        object.__setattr__(self, "rail_velocity", spread("rail_velocity", self.rail_velocity, 3))
        TargetTrackingOptions.__post_init__(self)

    def check_start(self) -> None:
        """Vehicles on rails start there."""
        self.rail_positions()

    def require_apart(self, p: Array) -> None:
        """On rails nobody crashes."""

    def rail_positions(self) -> Array:
        """Where the vehicles start, (N, 3), m."""
        rails = as_numbers(self.rails)
        if rails.shape != (self.vehicles, 3) or not (np.abs(rails) <= FARTHEST).all():
            raise ValueError(
                f"rails must be {self.vehicles} positions (x, y, z), one per vehicle, within {FARTHEST:g} m, "
                f"got {shown(self.rails)} of shape {rails.shape}"
            )
        if nearest_pair(rails)[2] == 0.0:
            raise ValueError(f"rails of two vehicles coincide: {self.rails!r}; move one")
        return rails

    def make_slots(self) -> Array:
        """First positions of the vehicles relative to where the target is expected, (N, 3), m."""
        rows = make_target(self.target).rows(np.array([0.0, self.dt]), np.random.default_rng(0))
        return np.asarray(self.rail_positions() - np.asarray(rows)[0, :3])
