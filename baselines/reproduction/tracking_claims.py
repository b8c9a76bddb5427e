"""The claims of chapter 4 on tracking: accuracy, effort, transients, cost, survival of a disturbance."""

from __future__ import annotations

import numpy as np
from joblib import Parallel, delayed

from quad_envs.disturbances import TorquePulse
from quad_envs.parameters import Array
from quad_envs.references import Reference

from .flights import CLIMBING, DESCENDING, ORIGIN, Flight, Outcome, fly_all, regulate
from .results import Claim, verdict
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
    down, up = _wins(quantity, False, jobs), _wins(quantity, True, jobs)
    numbers: dict[str, float | str] = {f"descending, {name}": f"{n} of 15" for name, n in down.items()}
    numbers |= {f"climbing, {name}": f"{n} of 15" for name, n in up.items()}
    share = (down["SDC 1/2"] + up["SDC 1/2"]) / 30.0
    return Claim(key, text, verdict(share), numbers)


def rms_claim(jobs: int = 1) -> Claim:
    """Section 4.4: NMPC tracks with the lower RMS."""
    text = "NMPC has a lower RMS than LMPC in every cell of table 4.1"
    return _cell_claim("4-rms", text, "position_rms", jobs)


def effort_claim(jobs: int = 1) -> Claim:
    """Section 4.4: NMPC needs less input effort."""
    return _cell_claim(
        "4-effort", "NMPC uses less effort than LMPC in every cell of table 4.2", "effort", jobs
    )


_DIRECTIONS = {"descending": -1.0, "level": 0.0, "climbing": 1.0}  # sign of the start's z


def _offsets(direction: str, distance: float, rng: np.random.Generator, n: int) -> Array:
    """N offsets of one length: starting above the origin, level with it, or below it."""
    vectors = rng.normal(size=(n, 3))
    vectors[:, 2] = _DIRECTIONS[direction] * np.abs(vectors[:, 2])
    return np.asarray(distance * vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def regulation_claim(jobs: int = 1, samples: int = 60) -> Claim:
    """Section 4.4, generalised: regulation from random offsets, better in RMS and in effort at once."""
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
    numbers: dict[str, float | str] = {
        f"{direction}, {name}, 1 2 4 6 8 m": " ".join(f"{share[direction, name, d]:.0%}" for d in distances)
        for direction in _DIRECTIONS
        for name in names[1:]
    }
    mean = float(np.mean([value for (_, name, _), value in share.items() if name == "SDC 1/2"]))
    text = "NMPC regulates better than LMPC, in RMS and in effort"
    return Claim("4-regulation", text, verdict(mean), numbers)


def below_from(error: Array, threshold: float) -> float:
    """Time from which the error stays below a threshold, s."""
    above = np.flatnonzero(error >= threshold)
    return _DT * float(above[-1] + 1) if above.size else 0.0


def transient_claim(jobs: int = 1) -> Claim:
    """Section 4.4: NMPC has the better transient."""
    names = ("LMPC", "SDC 1/2")
    flights = [Flight(name, reference) for reference in DESCENDING.values() for name in names]
    error = [outcome.error for outcome in fly_all(flights, jobs)]
    helix, spiral, lines = error[0:2], error[2:4], error[4:6]
    first = [[below_from(e, limit) for e in pair] for pair, limit in ((helix, 0.5), (spiral, 0.25))]
    after = [float(e[100:].mean()) for e in lines]
    numbers: dict[str, float | str] = {
        "helix, s until error < 0.5 m (LMPC, NMPC)": f"{first[0][0]:.2f}, {first[0][1]:.2f}",
        "helix, m in the last 2 s": f"{helix[0][-40:].mean():.3f}, {helix[1][-40:].mean():.3f}",
        "spiral, s until error < 0.25 m": f"{first[1][0]:.2f}, {first[1][1]:.2f}",
        "lines, m after the reversal": f"{after[0]:.3f}, {after[1]:.3f}",
    }
    better = [first[0][1] < first[0][0], first[1][1] < first[1][0], after[1] < after[0]]
    return Claim("4-transient", "NMPC has the better transient", verdict(float(np.mean(better))), numbers)


def decision_cost_claim(jobs: int = 1) -> Claim:
    """Section 4.4: NMPC costs a constant factor over LMPC, whatever the horizon."""
    keys = [(N, name) for N in HORIZONS for name in ("LMPC", "SDC 1/2")]
    # one after the other, whatever jobs says: these are times
    flown = fly_all([Flight(name, DESCENDING["helix"], horizon=N) for N, name in keys], 1)
    p50 = {key: outcome.record.decision_p50_ms for key, outcome in zip(keys, flown, strict=True)}
    factor = [p50[N, "SDC 1/2"] / p50[N, "LMPC"] for N in HORIZONS]
    numbers: dict[str, float | str] = {
        f"N = {N}, ms (LMPC, NMPC, factor)": f"{p50[N, 'LMPC']:.3f}, {p50[N, 'SDC 1/2']:.3f}, {f:.1f}"
        for N, f in zip(HORIZONS, factor, strict=True)
    }
    spread = max(factor) / min(factor)
    numbers["largest / smallest factor"] = spread
    text = "the cost of NMPC is a constant factor over LMPC for all horizons"
    return Claim("4-cost", text, "HOLDS" if spread < 2.0 else "FALSE", numbers)


def _disturbed(name: str, reference: Reference, clock: str, revealed: bool) -> Flight:
    env = {"disturbance": TorquePulse(clock=clock), "reveal_disturbance": revealed}
    return Flight(name, reference, env=env)


def disturbance_claim(jobs: int = 1) -> Claim:
    """Section 4.7: both survive the torque pulse with their inputs within bounds, NMPC clearly better."""
    cases = [(clock, revealed) for clock in ("absolute", "relative") for revealed in (True, False)]
    names = ("LMPC", "SDC 1/2", "SDC 1", "1 pass")
    keys = [(*case, name, task) for case in cases for name in names for task in DESCENDING]
    flown = fly_all([_disturbed(n, DESCENDING[task], c, revealed) for c, revealed, n, task in keys], jobs)
    outcome = dict(zip(keys, flown, strict=True))
    clean = _all_cells(False, jobs)
    numbers: dict[str, float | str] = {}
    for clock, revealed in cases:
        how = "with feed-forward" if revealed else "without"
        for name in names:
            rms = [_rms_or_lost(outcome[clock, revealed, name, task]) for task in DESCENDING]
            numbers[f"{clock} time, {how}, {name}"] = " ".join(rms)
    change = [
        outcome["absolute", True, name, task].record.position_rms / clean[task, 25, name].record.position_rms
        for name in ("LMPC", "SDC 1/2")
        for task in DESCENDING
    ]
    numbers["with feed-forward, absolute time: largest RMS / clean RMS"] = max(change)
    held = [
        outcome[clock, revealed, name, task].record.position_rms
        < 1.1 * clean[task, 25, name].record.position_rms
        for clock, revealed in cases
        for name in ("LMPC", "SDC 1/2")
        for task in DESCENDING
    ]
    text = "both survive the torque disturbance, NMPC is clearly better (RMS in m: helix, spiral, lines)"
    return Claim("4-disturbance", text, verdict(float(np.mean(held))), numbers)


def _rms_or_lost(outcome: Outcome) -> str:
    return "lost" if outcome.record.crashed else f"{outcome.record.position_rms:.3f}"


def optimality_claim(jobs: int = 1) -> Claim:
    """Chapter 4: the SDC solution is near the optimum; here against exact NMPC solved to convergence."""
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
    numbers: dict[str, float | str] = {}
    for case in cases:
        best = cost[case, "exact"]
        parts = [f"{name} {_excess(cost[case, name], best)}" for name in names[:-1]]
        numbers[f"{case}: exact {best:.1f}"] = ", ".join(parts)
    near = [cost[case, "SDC 1/2"] < 1.05 * cost[case, "exact"] for case in cases]
    text = "SDC-NMPC is near the optimum (excess of its cost over exact NMPC; near: below 5 %)"
    return Claim("4-optimum", text, verdict(float(np.mean(near))), numbers)


def _excess(cost: float, best: float) -> str:
    return f"{cost / best - 1.0:+.1%}" if np.isfinite(cost) else "lost"


def norm_claim(jobs: int = 1) -> Claim:
    """Section 9.2: an input that makes the norm of the state smaller at each sample always exists."""
    numbers: dict[str, float | str] = {}
    grew = []
    for name in ("LMPC", "SDC 1/2"):
        flown = fly_all([Flight(name, ORIGIN, start) for start in _STARTS], jobs)
        norms = [np.linalg.norm(outcome.states[:101, :12], axis=1) for outcome in flown]
        share = [float((np.diff(norm) > 0.0).mean()) for norm in norms]
        peak = [float(norm.max() / norm[0]) for norm in norms]
        numbers[f"{name}: share of the first 5 s in which |x| grows"] = (
            f"{min(share):.0%} to {max(share):.0%}"
        )
        numbers[f"{name}: largest |x| / |x_0|"] = f"{min(peak):.2f} to {max(peak):.2f}"
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
    numbers: dict[str, float | str] = {
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
