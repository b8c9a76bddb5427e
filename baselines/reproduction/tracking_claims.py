"""The claims of chapter 4 on tracking: accuracy, effort, transients, cost, survival of a disturbance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from joblib import Parallel, delayed

from quad_envs.disturbances import TorquePulse
from quad_envs.parameters import Array
from quad_envs.references import Reference

from .flights import CLIMBING, DESCENDING, ORIGIN, Flight, Outcome, fly_all, regulate
from .results import Claim, Numbers, Value, verdict
from .tables import HORIZONS, table_flights

_NONLINEAR = ("SDC 1/2", "SDC 1", "1 pass")
_DT = 0.05  # s
_STARTS = ((2.0, 2.0, 2.0), (2.0, 2.0, -2.0), (4.0, 4.0, 4.0), (4.0, 4.0, -4.0), (8.0, 0.0, 0.0))


def _all_cells(climbing: bool, jobs: int) -> dict[tuple[str, int, str], Outcome]:
    return table_flights(("LMPC", *_NONLINEAR), climbing, jobs)


def _wins(quantity: str, climbing: bool, jobs: int) -> dict[str, int]:
    """Controller -> number of the 15 cells in which it is better than LMPC."""
    flown = _all_cells(climbing, jobs)
    count = dict.fromkeys(_NONLINEAR, 0)
    for (task, horizon, name), outcome in flown.items():
        if name in count:
            ours = getattr(outcome.record, quantity)
            better = ours < getattr(flown[task, horizon, "LMPC"].record, quantity)
            count[name] += bool(better and not outcome.record.crashed)
    return count


def _cell_claim(key: str, text: str, quantity: str, jobs: int) -> Claim:
    """Judged by the text's controller on the text's trajectories: those descend."""
    down, up = _wins(quantity, False, jobs), _wins(quantity, True, jobs)
    numbers: Numbers = {
        "cells of the table (descending) in which NMPC is better": _of_15(down),
        "ours: the same trajectories, climbing": _of_15(up),
    }
    return Claim(key, text, verdict(down["SDC 1/2"] / 15.0), numbers)


def _of_15(wins: dict[str, int]) -> dict[str, str]:
    return {name: f"{n} of 15" for name, n in wins.items()}


def rms_claim(jobs: int = 1) -> Claim:
    """Section 4.6: NMPC tracks with the lower RMS."""
    text = "NMPC (SDC, alpha = 1/2) has a lower RMS than LMPC in every cell of table 4.1"
    return _cell_claim("4-rms", text, "position_rms", jobs)


def effort_claim(jobs: int = 1) -> Claim:
    """Section 4.6: NMPC needs less input effort."""
    text = "NMPC (SDC, alpha = 1/2) uses less effort than LMPC in every cell of table 4.2"
    return _cell_claim("4-effort", text, "effort", jobs)


_DIRECTIONS = {"descending": -1.0, "level": 0.0, "climbing": 1.0}  # sign of the start's z


def _offsets(direction: str, distance: float, rng: np.random.Generator, n: int) -> Array:
    """N offsets of one length: starting above the origin, level with it, or below it."""
    vectors = rng.normal(size=(n, 3))
    vectors[:, 2] = _DIRECTIONS[direction] * np.abs(vectors[:, 2])
    return np.asarray(distance * vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def regulation_claim(jobs: int = 1, samples: int = 60) -> Claim:
    """Ours: regulation from random offsets, better in RMS and in effort at once; the text tracks."""
    rng = np.random.default_rng(0)
    names, distances = ("LMPC", "SDC 1/2", "1 pass"), (1.0, 2.0, 4.0, 6.0, 8.0)
    keys = [(direction, distance) for direction in _DIRECTIONS for distance in distances]
    offsets = [_offsets(direction, distance, rng, samples) for direction, distance in keys]
    flown = Parallel(n_jobs=jobs)(delayed(regulate)(name, start) for start in offsets for name in names)
    share: dict[tuple[str, str, float], float] = {}
    for i, (direction, distance) in enumerate(keys):
        linear = flown[3 * i]
        for name, records in zip(names[1:], flown[3 * i + 1 : 3 * i + 3], strict=True):
            wins = [
                ours.position_rms < theirs.position_rms and ours.effort < theirs.effort and not ours.crashed
                for ours, theirs in zip(records, linear, strict=True)
            ]
            share[direction, name, distance] = float(np.mean(wins))
    numbers: Numbers = {
        f"{direction}, {name}: share of offsets": {
            f"{d:g} m": f"{share[direction, name, d]:.0%}" for d in distances
        }
        for direction in _DIRECTIONS
        for name in names[1:]
    }
    mean = float(np.mean([value for (_, name, _), value in share.items() if name == "SDC 1/2"]))
    text = "ours: NMPC regulates better than LMPC from random offsets, in RMS and in effort"
    return Claim("4-regulation", text, verdict(mean), numbers, own=True)


def below_from(error: Array, threshold: float) -> float:
    """Time from which the error stays below a threshold, s."""
    above = np.flatnonzero(error >= threshold)
    return _DT * float(above[-1] + 1) if above.size else 0.0


CLOSE = {"helix": 0.5, "spiral": 0.25}  # m, errors below which a transient is over
REVERSAL = 100  # samples, of the straight lines at 5 s


class Transient(NamedTuple):
    """What a task's transient is judged by: less is better."""

    what: str
    value: Callable[[Array], float]  # of the position error of a flight, (T,), m


def transient_of(task: str) -> Transient:
    """How long an error stays, or, after the reversal of the lines, how large it is."""
    if task == "lines":
        return Transient("mean error after the reversal, m", lambda error: float(error[REVERSAL:].mean()))
    limit = CLOSE[task]
    return Transient(f"time until the error stays below {limit:g} m, s", lambda e: below_from(e, limit))


def pair(values: Sequence[Value]) -> dict[str, Value]:
    """Of the two controllers."""
    return dict(zip(("LMPC", "NMPC"), values, strict=True))


def transient_claim(jobs: int = 1) -> Claim:
    """Section 4.7: the transient of NMPC is better on the helix and on the lines; the spiral is tracked."""
    names = ("LMPC", "SDC 1/2")
    flights = [Flight(name, reference) for reference in DESCENDING.values() for name in names]
    error = [outcome.error for outcome in fly_all(flights, jobs)]
    numbers: Numbers = {}
    better = {}
    for i, task in enumerate(DESCENDING):
        what, value = transient_of(task)
        linear, nonlinear = value(error[2 * i]), value(error[2 * i + 1])
        aside = " (the text claims nothing of its transient)" if task == "spiral" else ""
        numbers[f"{task}{aside}: {what}"] = pair((linear, nonlinear))
        better[task] = nonlinear < linear
    numbers["helix: mean error of the last 2 s, m"] = pair([float(e[-40:].mean()) for e in error[:2]])
    text = "the transient of NMPC is better than that of LMPC on the helix and on the straight lines"
    return Claim("4-transient", text, verdict(float(np.mean([better["helix"], better["lines"]]))), numbers)


def decision_cost_claim(jobs: int = 1) -> Claim:
    """Chapter 1: the power that NMPC needs is bounded by a constant factor of that of LMPC.

    That is a bound on work, which counts can break and times cannot: both solve one quadratic program of N
    stages a sample, so that the bound would fail with more steps of the solver.
    """
    keys = [(N, name) for N in HORIZONS for name in ("LMPC", "SDC 1/2")]
    # one after the other, whatever jobs says: these are times
    flown = fly_all([Flight(name, DESCENDING["helix"], horizon=N) for N, name in keys], 1)
    record = {key: outcome.record for key, outcome in zip(keys, flown, strict=True)}
    p50 = {key: record[key].decision_p50_ms for key in keys}
    steps = {key: record[key].iterations_max for key in keys}
    numbers: Numbers = {
        f"N = {N}": {
            "LMPC, ms": p50[N, "LMPC"],
            "NMPC, ms": p50[N, "SDC 1/2"],
            "factor": p50[N, "SDC 1/2"] / p50[N, "LMPC"],
            "most steps of a solve, LMPC": f"{steps[N, 'LMPC']}",
            "NMPC": f"{steps[N, 'SDC 1/2']}",
        }
        for N in HORIZONS
    }
    slope = [np.polyfit(HORIZONS, [p50[N, name] for N in HORIZONS], 1)[0] for name in ("LMPC", "SDC 1/2")]
    numbers["a further stage, microseconds"] = pair([1e3 * float(value) for value in slope])
    right = [steps[N, "SDC 1/2"] <= steps[N, "LMPC"] for N in HORIZONS]
    text = (
        "the work of NMPC is bounded by a constant factor of that of LMPC (no more steps of the solver; "
        "times are shown, not judged: the factor grows with N toward that of a further stage)"
    )
    return Claim("4-cost", text, verdict(float(np.mean(right))), numbers)


def _disturbed(name: str, reference: Reference, clock: str, revealed: bool) -> Flight:
    env = {"disturbance": TorquePulse(clock=clock), "reveal_disturbance": revealed}
    return Flight(name, reference, env=env)


_CLOCKS = ("absolute", "relative")  # t of the pulse counts from the start of the flight, or of the pulse
_TEXT = ("absolute", True)  # as printed, and "the controllers provide a feedforward cancellation"


def disturbance_claim(jobs: int = 1) -> Claim:
    """Section 4.7: both track well under the torque pulse, fed forward, and NMPC is better.

    The cases that the text does not have, without feed-forward and with the other clock, are shown only.
    """
    cases = [(clock, revealed) for clock in _CLOCKS for revealed in (True, False)]
    names = ("LMPC", "SDC 1/2", "SDC 1", "1 pass")
    keys = [(*case, name, task) for case in cases for name in names for task in DESCENDING]
    flown = fly_all([_disturbed(n, DESCENDING[task], c, revealed) for c, revealed, n, task in keys], jobs)
    outcome = dict(zip(keys, flown, strict=True))
    clean = _all_cells(False, jobs)
    numbers: Numbers = {}
    for case in cases:
        how = f"{case[0]} time, {'with feed-forward' if case[1] else 'without'}"
        how = how if case == _TEXT else f"ours: {how}"
        for name in names:
            numbers[f"{how}, {name}: RMS, m"] = {
                task: _rms_or_lost(outcome[(*case, name, task)]) for task in DESCENDING
            }
    right = []
    for task in DESCENDING:
        both = [outcome[(*_TEXT, name, task)] for name in names[:2]]
        rms = [each.record.position_rms for each in both]
        change = [r / clean[task, 25, n].record.position_rms for r, n in zip(rms, names, strict=False)]
        what, value = transient_of(task)
        transient = [value(each.error) for each in both]
        numbers[f"with feed-forward, {task}: RMS / clean RMS"] = pair(change)
        numbers[f"with feed-forward, {task}: {what}"] = pair(transient)
        right += [ratio < 1.1 for ratio in change]
        right += [rms[1] < rms[0], transient[1] < transient[0]]
    text = (
        "with the torque disturbance fed forward both track (RMS within 10 % of the clean one), and NMPC is "
        "better in RMS and in the transient, on all three trajectories"
    )
    return Claim("4-disturbance", text, verdict(float(np.mean(right))), numbers)


def _rms_or_lost(outcome: Outcome) -> str:
    return "lost" if outcome.record.crashed else f"{outcome.record.position_rms:.3f}"


def optimality_claim(jobs: int = 1) -> Claim:
    """Ours: the SDC solution against exact NMPC solved to convergence; the text does not compare with it."""
    names = ("LMPC", "SDC 1/2", "SDC 1", "1 pass", "1 pass, alpha 1", "RTI", "exact")
    cases: dict[str, tuple[Reference, tuple[float, ...]]] = {
        **{task: (reference, (0.0, 0.0, 0.0)) for task, reference in DESCENDING.items()},
        **{f"{task}, climbing": (reference, (0.0, 0.0, 0.0)) for task, reference in CLIMBING.items()},
        **{str(start): (ORIGIN, start) for start in _STARTS},
    }
    keys = [(case, name) for case in cases for name in names]
    flown = fly_all([Flight(name, cases[case][0], cases[case][1]) for case, name in keys], jobs)
    cost = {
        key: outcome.cost if not outcome.record.crashed else np.inf
        for key, outcome in zip(keys, flown, strict=True)
    }
    numbers: Numbers = {}
    for case in cases:
        best = cost[case, "exact"]
        excess: dict[str, Value] = {name: _excess(cost[case, name], best) for name in names[:-1]}
        numbers[case] = {"cost of exact NMPC": f"{best:.1f}", **excess}
    near = [cost[case, "SDC 1/2"] < 1.05 * cost[case, "exact"] for case in cases]
    text = "ours: the cost of SDC-NMPC (alpha = 1/2) exceeds that of exact NMPC by less than 5 %"
    return Claim("4-optimum", text, verdict(float(np.mean(near))), numbers, own=True)


def _excess(cost: float, best: float) -> str:
    return f"{cost / best - 1.0:+.1%}" if np.isfinite(cost) else "lost"


def norm_claim(jobs: int = 1) -> Claim:
    """Section 9.2: an input that makes the norm of the state smaller at each sample always exists."""
    numbers: Numbers = {}
    grew = []
    for name in ("LMPC", "SDC 1/2"):
        flown = fly_all([Flight(name, ORIGIN, start) for start in _STARTS], jobs)
        norms = [np.linalg.norm(outcome.states[:101, :12], axis=1) for outcome in flown]
        share = [float((np.diff(norm) > 0.0).mean()) for norm in norms]
        peak = [float(norm.max() / norm[0]) for norm in norms]
        numbers[name] = {
            "share of the first 5 s in which |x| grows": f"{min(share):.0%} to {max(share):.0%}",
            "largest |x| / |x_0|": f"{min(peak):.2f} to {max(peak):.2f}",
        }
        grew += [value > 0.0 for value in share]
    text = "the norm of x decreases at each sample (9.2)"
    return Claim("9-norm", text, verdict(1.0 - float(np.mean(grew))), numbers)


def taylor_claim(jobs: int = 1) -> Claim:
    """Section 4.2: the Taylor polynomials of (4.7) are within 4 % on (-pi/2, pi/2)."""
    a = np.linspace(1e-3, 3.0, 30000)
    error = np.maximum(
        np.abs((1 - a**2 / 6 + a**4 / 120) / (np.sin(a) / a) - 1),
        np.abs((-a / 2 + a**3 / 24 - a**5 / 720) / ((np.cos(a) - 1) / a) - 1),
    )
    inside = float(error[a <= np.pi / 2].max())
    numbers: Numbers = {
        "largest relative error on (-pi/2, pi/2)": f"{inside:.2%}",
        "4 % is exceeded beyond, rad": float(a[np.argmax(error > 0.04)]),
        "error at 3 rad": f"{error[-1]:.0%}",
    }
    text = "the Taylor form (4.7) is within 4 % on (-pi/2, pi/2)"
    return Claim("4-taylor", text, "HOLDS" if inside < 0.04 else "FALSE", numbers)


TRACKING_CLAIMS = (
    rms_claim,
    effort_claim,
    regulation_claim,
    transient_claim,
    decision_cost_claim,
    disturbance_claim,
    taylor_claim,
    optimality_claim,
    norm_claim,
)
