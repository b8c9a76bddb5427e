"""Chapter 7: a team that estimates a target and keeps its formation beside it, claims and numbers."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from controllers.estimation.trilateration import trilaterate
from quad_envs.envs.team.options import CHAPTER_7_SLOTS
from quad_envs.graphs import Timed, make_graph
from quad_envs.parameters import Array

from ..policies.estimate_wrapper import Fusion
from .formation_claims import metres
from .results import Claim, Measured, Numbers, Value, verdict
from .team_flights import TRACKING, TeamFlight, TeamOutcome, fly_teams

SEEDS = (0, 1)
P_F = 0.1  # m^2, of 7.2
CLOSE = 1.0  # m: spacing of the formation
_FROZEN: dict[str, Any] = {"neighbour": "frozen", "feed_forward": False, "target": "frozen"}
_START = [[0.0, y - 2.5, 0.0] for y in range(6)]
# What filters expect of the target, which turns off, or moves on: who hears nothing of it is soon wrong.
_VELOCITY = {"cv": (0.0, 0.0, 0.0), "turn": (0.8, 0.0, -0.1)}


class Case(NamedTuple):
    """A row of the prototype's table: tracking error, m, of vehicles 1 and 6, estimate error of 6, m."""

    case: int  # 1: all measure; 2: only 1 and 2 do, and 5 and 6 hear nobody who does
    target: str
    variant: str
    prototype: tuple[float, float, float]


CASES = (
    Case(1, "cv", "frozen", (0.16, 0.16, 0.031)),
    Case(1, "cv", "corrected", (0.014, 0.021, 0.033)),
    Case(1, "turn", "frozen", (0.27, 0.29, 0.035)),
    Case(1, "turn", "corrected", (0.21, 0.23, 0.034)),
    Case(1, "cv", "range only", (0.06, 0.12, 0.12)),
    Case(2, "cv", "frozen", (0.16, 0.40, 16.8)),
    Case(2, "cv", "corrected", (0.016, 0.018, 6.7)),
    Case(2, "turn", "frozen", (0.28, 0.67, 25.0)),
    Case(2, "turn", "corrected", (0.21, 0.47, 25.0)),
    Case(2, "turn", "shared estimates", (0.22, 0.23, 0.027)),
    Case(2, "turn", "6 cut off", (0.21, 13.5, 25.0)),
    Case(2, "turn", "4, 5, 6 cut off", (0.21, 11.7, 25.0)),
    Case(2, "turn", "P_f = 0.001", (0.25, 0.52, 25.0)),
    Case(2, "turn", "P_f = 10", (0.21, 0.96, 25.0)),
)
_POLICY: dict[str, dict[str, Any]] = {
    "frozen": _FROZEN,
    "P_f = 0.001": {"formation_weight": 0.001},
    "P_f = 10": {"formation_weight": 10.0},
}


def cut_off(vehicles: tuple[int, ...], seconds: float = 8.0) -> Timed:
    """Case 2 until then; after it these vehicles hear only each other, or nobody when there is but one."""
    before = make_graph("case-2", None, 6)
    after = before.copy()
    others = [j for j in range(6) if j not in vehicles]
    for i in vehicles:
        after[i, others] = 0.0
    return Timed([before.tolist(), after.tolist()], (0.0, seconds))


def flights(case: int, target: str, variant: str) -> list[TeamFlight]:
    """The flights of a row, 25 s each."""
    graph: Any = f"case-{case}"
    if variant.endswith("cut off"):
        graph = cut_off((5,) if variant.startswith("6") else (3, 4, 5))
    env: dict[str, Any] = {
        "graph": graph,
        "target": target,
        "measuring": "all" if case == 1 else (0, 1),
        "start": _START,
        "time_limit": 25.0,
        "prior_velocity": _VELOCITY[target],
        "prior_sigma": (1.5, 0.7),
        "sensor": "range" if variant == "range only" else "range-azimuth-elevation",
    }
    fusion: Fusion | None = "trace" if variant == "shared estimates" else None
    policy = _POLICY.get(variant, {})
    return [TeamFlight(env, policy, TRACKING, "cooperative-mpc", seed, fusion) for seed in SEEDS]


def tracking_error(flown: list[TeamOutcome]) -> Array:
    """Of each vehicle, RMS over the last 5 s and the seeds, (N,), m."""
    return np.asarray(np.sqrt(np.mean([outcome.rms() ** 2 for outcome in flown], axis=0)))


def estimate_error(flown: list[TeamOutcome], seconds: float = 5.0) -> Array:
    """Of each vehicle's estimate, likewise."""
    last = round(seconds / flown[0].dt)
    squares = [(outcome.estimate_error[-last:] ** 2).sum(axis=-1).mean(axis=0) for outcome in flown]
    return np.asarray(np.sqrt(np.mean(squares, axis=0)))


def fly_case(case: int, target: str, variant: str, jobs: int = 1) -> list[TeamOutcome]:
    """The outcomes of a row."""
    return fly_teams(flights(case, target, variant), jobs)


def table(jobs: int = 1) -> list[Measured]:
    """The table of chapter 7."""
    fly_teams([flight for row in CASES for flight in flights(*row[:3])], jobs)
    cells = []
    for row in CASES:
        flown = fly_case(*row[:3], jobs)
        where = f"case {row.case}, {row.target}, {row.variant}"
        error = tracking_error(flown)
        found = (error[0], error[5], estimate_error(flown)[5])
        names = ("tracking of 1, m", "tracking of 6, m", "estimate of 6, m")
        for name, before, ours in zip(names, row.prototype, found, strict=True):
            cells.append(Measured(where, name, before, float(ours)))
    return cells


def trust_claim(jobs: int = 1) -> Claim:
    """Section 7.2: a good estimate keeps the vehicle with the target, a bad one with the formation."""
    flown = fly_case(2, "turn", "corrected", jobs)
    trace = np.mean([outcome.estimate_trace[-100:].mean(axis=0) for outcome in flown], axis=0)
    return trust_verdict(trace, tracking_error(flown))


def of_vehicles(first: int = 1, last: int = 6) -> list[str]:
    """Columns of vehicles, counted from 1."""
    return [f"vehicle {i}" for i in range(first, last + 1)]


def by_vehicle(values: list[float], first: int = 1) -> dict[str, Value]:
    """Of consecutive vehicles, the last of them 6."""
    return dict(zip(of_vehicles(first), [metres([value]) for value in values], strict=True))


def trust_verdict(trace: Array, error: Array) -> Claim:
    """From tr P_t, m^2, and tracking errors, m, of vehicles of case 2."""
    share = P_F / (P_F + trace / 3.0)  # of the target in the reference
    numbers: Numbers = {
        "tr P_t, m^2": dict(zip(of_vehicles(), [f"{value:.2g}" for value in trace], strict=True)),
        "share of the target in the reference": by_vehicle(share.tolist()),
        "tracking error, m": by_vehicle(error.tolist()),
    }
    right = [(share[:4] > 0.9).all(), (share[4:] < 0.1).all(), (error < CLOSE).all()]
    text = "who knows the target stays with it, who does not stays with the formation, without any switch"
    return Claim("7-trust", text, verdict(float(np.mean(right))), numbers, "HOLDS")


def contact_claim(jobs: int = 1) -> Claim:
    """Sections 6, 7 and 8: without contact to the target, close through a neighbour that has it."""
    cases = [(target, variant) for target in ("cv", "turn") for variant in ("frozen", "corrected")]
    flown = {case: fly_case(2, *case, jobs) for case in cases}
    connected = {case: (tracking_error(f)[4:], estimate_error(f)[4:]) for case, f in flown.items()}
    alone = {
        "6": tracking_error(fly_case(2, "turn", "6 cut off", jobs))[5:],
        "4, 5, 6": tracking_error(fly_case(2, "turn", "4, 5, 6 cut off", jobs))[3:],
    }
    return contact_verdict(connected, alone)


def contact_verdict(connected: dict[tuple[str, str], tuple[Array, Array]], alone: dict[str, Array]) -> Claim:
    """From tracking and estimate errors of vehicles 5 and 6, m, and tracking errors of those cut off, m."""
    numbers: Numbers = {}
    right = []
    for (target, variant), (error, estimate) in connected.items():
        numbers[f"{target}, {variant}: tracking error, m"] = by_vehicle(error.tolist(), 5)
        numbers[f"{target}, {variant}: error of their estimates, m"] = by_vehicle(estimate.tolist(), 5)
        right.append(bool((error < CLOSE).all() and (estimate > 5.0 * error).all()))
    for who, error in alone.items():
        cut = f"turn, {who} cut off at 8 s: tracking error, m"
        numbers[cut] = by_vehicle(error.tolist(), 7 - len(error))
        right.append(bool((error > 5.0 * CLOSE).all()))
    text = "vehicles without contact to the target stay close if connected to one that has it"
    return Claim("7-contact", text, verdict(float(np.mean(right))), numbers, "HOLDS")


def sharing_claim(jobs: int = 1) -> Claim:
    """Our own: sharing estimates gives what sharing measurements with neighbours alone does not."""
    own, shared = (fly_case(2, "turn", variant, jobs) for variant in ("corrected", "shared estimates"))
    numbers: Numbers = {
        f"{how}: {what} error, m": by_vehicle(error(flown)[4:].tolist(), 5)
        for what, error in (("estimate", estimate_error), ("tracking", tracking_error))
        for how, flown in (("measurements of neighbours", own), ("with intersected estimates", shared))
    }
    right = [estimate_error(shared).max() < 0.1, tracking_error(shared).max() < 0.3]
    text = "ours: intersected estimates (6.2, fused in both branches) tell everybody where the target is"
    return Claim("7-sharing", text, verdict(float(np.mean(right))), numbers, "HOLDS", own=True)


def height_estimate_claim(jobs: int = 1, runs: int = 4000) -> Claim:
    """Section 7.3: a formation that is not flat helps to estimate z."""
    rng, sigma = np.random.default_rng(0), 0.1
    target = np.array([1.0, 1.0, -3.0])
    numbers: Numbers = {}
    mirrored: dict[float, float] = {}
    for h in (0.0, 0.1, 0.3, 1.0):
        square = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [2.0, 2.0, -h]])
        z = np.linalg.norm(target - square, axis=1) + sigma * rng.normal(size=(runs, 4))
        # Flat, the linear start has no height: begin on either side.
        start = None if h else target * [1.0, 1.0, 0.0] + rng.normal(size=(runs, 3))
        fix = trilaterate(np.tile(square, (runs, 1, 1)), z, sigma, start=start, max_ratio=np.inf)
        mirrored[h] = float((fix.r[:, 2] > 0.0).mean())
        rms = float(np.sqrt(((fix.r[:, 2] - target[2]) ** 2).mean()))
        numbers[f"fourth of a square raised by {h:g} m"] = {
            "z error, m": f"{rms:.3f}",
            "share of mirror twins": f"{mirrored[h]:.1%}",
        }
    slots = np.array(CHAPTER_7_SLOTS)
    spread = np.linalg.svd(slots - slots.mean(axis=0), compute_uv=False)
    numbers["formation of chapter 7: spread ratio (above 8 is nearly flat)"] = float(spread[0] / spread[2])
    right = [mirrored[0.0] > 0.3, mirrored[0.1] > 10.0 * mirrored[1.0], mirrored[1.0] < 0.01]
    text = "a formation that is not flat helps to estimate z"
    return Claim("7-height", text, verdict(float(np.mean(right))), numbers, "HOLDS")


def claims(jobs: int = 1) -> list[Claim]:
    """All of them."""
    return [trust_claim(jobs), contact_claim(jobs), height_estimate_claim(jobs), sharing_claim(jobs)]
