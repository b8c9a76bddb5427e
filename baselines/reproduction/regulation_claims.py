"""The claims of section 4.8 on feedback linearization: from (d, d, d) below and (d, d, -d) above."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .flights import ORIGIN, Flight, Outcome, fly_all
from .results import Claim, Numbers, Value, verdict

# The gains are not printed. These sets reproduce the claims, found among random ones.
GAINS_FROM_ABOVE = {"kp": 1.76, "kd": 1.91, "ka": 36.58, "kad": 6.87}
GAINS_FROM_BELOW = {"kp": 3.1, "kd": 2.94, "ka": 21.73, "kad": 6.36}
WEAK_ROTORS = 0.3125  # kappa of 2.45 N
_SIDES = {"below": 1.0, "above": -1.0}
LATE = 0.25  # s, by which feedback linearization may settle later than LMPC and still be comparable


def regulation_flight(
    name: str, d: float, side: str, kappa: float, gains: dict[str, float] | None = None
) -> Flight:
    """From (d, d, d) below the origin, or its mirror image above it; kappa is that of the rotors."""
    options: dict[str, Any] = {"policy": gains} if gains else {}
    return Flight(name, ORIGIN, (d, d, _SIDES[side] * d), env={"kappa": kappa}, **options)


def settled(outcome: Outcome) -> bool:
    """Whether it is within 5 % of the initial error at the end."""
    return not outcome.record.crashed and bool(outcome.error[-1] < 0.05 * outcome.error[0])


def overshoot(outcome: Outcome) -> float:
    """How far the vehicle goes beyond the origin, along the line from its start, relative to the distance."""
    start = outcome.states[0, :3]
    along = outcome.states[:, :3] @ start / (start @ start)
    return float(max(0.0, -along.min()))


def _pair(ours: str, linear: str) -> dict[str, Value]:
    return {"feedback linearization": ours, "LMPC": linear}


def _describe(outcome: Outcome) -> str:
    if not settled(outcome):
        return "not settled"
    return f"{outcome.record.settling_time:.2f} s, overshoot {overshoot(outcome):.0%}"


def comparable_claim(jobs: int = 1) -> Claim:
    """Section 4.8: gains tuned so that from (1,1,1) and (2,2,2) it is comparable to LMPC, slightly faster."""
    cases = [(side, d) for side in _SIDES for d in (1.0, 2.0)]
    gains = {"above": GAINS_FROM_ABOVE, "below": GAINS_FROM_BELOW}
    flights = [regulation_flight("FBL", d, side, 1.0, gains[side]) for side, d in cases]
    flights += [regulation_flight("LMPC", d, side, 1.0) for side, d in cases]
    flown = fly_all(flights, jobs)
    ours, linear = flown[: len(cases)], flown[len(cases) :]
    numbers: Numbers = {}
    agrees = []
    for (side, d), fbl, lmpc in zip(cases, ours, linear, strict=True):
        numbers[f"from {side}, d = {d:g}"] = _pair(_describe(fbl), _describe(lmpc))
        agrees.append(settled(fbl) and fbl.record.settling_time <= lmpc.record.settling_time + LATE)
    text = (
        "feedback linearization, its gains tuned for it, is comparable to LMPC from (1,1,1) and (2,2,2): it "
        f"settles within 5 % of the start, no more than {LATE:g} s later than LMPC (the text's gains are not "
        "printed; ours were found by search)"
    )
    return Claim("4-fbl-comparable", text, verdict(float(np.mean(agrees))), numbers)


def saturation_claim(jobs: int = 1) -> Claim:
    """Section 4.8: with 2.45 N rotors feedback linearization saturates far more than LMPC."""
    cases: list[tuple[str, str, dict[str, float] | None]] = [
        ("above", "gains from above", GAINS_FROM_ABOVE),
        ("below", "gains from below", GAINS_FROM_BELOW),
        ("below", "default gains", None),
    ]
    flights = [regulation_flight("FBL", 2.0, side, WEAK_ROTORS, gains) for side, _, gains in cases]
    flights += [regulation_flight("LMPC", 2.0, side, WEAK_ROTORS) for side, _, _ in cases]
    share = [outcome.record.saturation_share for outcome in fly_all(flights, jobs)]
    n = len(cases)
    numbers: Numbers = {
        f"from {side}, {name}, d = 2: share of commands at a limit": _pair(
            f"{share[i]:.1%}", f"{share[n + i]:.1%}"
        )
        for i, (side, name, _) in enumerate(cases)
    }
    more = [share[i] > 2.0 * share[n + i] + 0.01 for i in range(n)]
    text = "with 2.45 N rotors feedback linearization saturates far more than LMPC"
    return Claim("4-fbl-saturates", text, verdict(float(np.mean(more))), numbers)


def random_gains(rng: np.random.Generator, n: int) -> list[dict[str, float]]:
    """Gain sets with kp in 0.8..7, ka in 9..120 1/s^2 and damping ratios in 0.45..1.1."""
    kp, ka = np.exp(rng.uniform(np.log([0.8, 9.0]), np.log([7.0, 120.0]), (n, 2))).T
    zeta = rng.uniform(0.45, 1.1, (n, 2))
    columns = {
        "kp": kp,
        "kd": 2.0 * zeta[:, 0] * np.sqrt(kp),
        "ka": ka,
        "kad": 2.0 * zeta[:, 1] * np.sqrt(ka),
    }
    return [{name: float(column[i]) for name, column in columns.items()} for i in range(n)]


def _stable_counts(gains: Sequence[dict[str, float]], side: str, jobs: int) -> tuple[int, int, int]:
    """Sets that are stable from d = 1 and 2; those of them that fail from 3; all that are stable from 3."""
    distances = (1.0, 2.0, 3.0)
    flights = [regulation_flight("FBL", d, side, WEAK_ROTORS, g) for g in gains for d in distances]
    stable = np.array([settled(outcome) for outcome in fly_all(flights, jobs)]).reshape(-1, 3)
    near = stable[:, 0] & stable[:, 1]
    return int(near.sum()), int((near & ~stable[:, 2]).sum()), int(stable[:, 2].sum())


def instability_claim(jobs: int = 1, samples: int = 475) -> Claim:
    """Section 4.8: unstable from (3,3,3) with 2.45 N rotors, where LMPC tracks."""
    gains = random_gains(np.random.default_rng(0), samples)
    numbers: Numbers = {}
    shares = []
    for side in _SIDES:
        near, whole, far = _stable_counts(gains, side, jobs)
        numbers[f"from {side}: share of {samples} random gain sets"] = {
            "stable from 1 and 2 m": f"{near / samples:.0%}",
            "the whole claim": f"{whole / samples:.0%}",
            "stable from 3 m": f"{far / samples:.0%}",
        }
        shares.append(whole / samples)
    linear = fly_all([regulation_flight("LMPC", d, s, WEAK_ROTORS) for s in _SIDES for d in (3.0, 5.0)], jobs)
    default = fly_all([regulation_flight("FBL", 3.0, s, WEAK_ROTORS) for s in _SIDES], jobs)
    found = fly_all([regulation_flight("FBL", 3.0, "above", WEAK_ROTORS, GAINS_FROM_ABOVE)], jobs)[0]
    numbers["LMPC from 3 and 5 m"] = "stable" if all(map(settled, linear)) else "not always stable"
    numbers["default gains from 3 m"] = "stable" if all(map(settled, default)) else "not always stable"
    numbers["gains from above, from (3,3,-3)"] = (
        "stable"
        if settled(found)
        else f"lost after {found.record.steps * 0.05:.1f} s"
        if found.record.crashed
        else "not settled"
    )
    text = "feedback linearization is unstable from (3,3,3) with 2.45 N rotors while LMPC tracks"
    return Claim("4-fbl-unstable", text, verdict(float(np.mean(shares))), numbers)


REGULATION_CLAIMS = (comparable_claim, saturation_claim, instability_claim)
