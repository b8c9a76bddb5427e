"""The claims of chapter 6: trilateration, topologies, fusion, the aircraft; and its equations as printed."""

from __future__ import annotations

from functools import cache

import numpy as np

from controllers.estimation import ekf
from controllers.estimation.fusion import covariance_intersection
from controllers.estimation.kalman import kalman_update
from controllers.estimation.trilateration import trilaterate
from quad_envs.envs.team.options import CHAPTER_6_RAILS
from quad_envs.rotations import wrap_angle
from quad_envs.sensors import jacobian, range_azimuth_elevation

from .estimation_scenes import RUNS, SETTLED, aircraft, fused_ranges, range_filter, range_scene, ring
from .results import Claim, Numbers, Value, verdict
from .scenes import INTERVALS, LOST, Track, fly_filter
from .text_filters import fixes_alone

ALL = slice(None)
_REASONABLE = 0.5  # m, a tenth of the target's distance
_PARTS = ("0 to 2.5 s", "2.5 to 5 s", "5 to 10 s")
_CONSISTENT = (0.75, 1.4)  # of ANEES/3: what 40 runs of a consistent filter scatter


def _number(value: float) -> str:
    return f"{value:.3f}" if value < 1e3 else f"{value:.1e}"


def by_interval(values: list[float]) -> dict[str, Value]:
    """Of the three intervals."""
    return {part: _number(value) for part, value in zip(_PARTS, values, strict=True)}


def usable(vehicle: int) -> Track:
    """The range-only EKF without the runs in which this vehicle's filter settled on the wrong side."""
    track = range_filter("EKF")
    return track.without(track.lost()[:, vehicle])


@cache
def _fixes() -> Track:
    return fixes_alone(range_scene(), 0, INTERVALS[0])


def trilateration_claim() -> Claim:
    """Section 6.4: reasonable estimates from four ranges, then smoother ones from (EKF,3)."""
    fix, filtered = _fixes(), usable(0)
    numbers: Numbers = {
        "trilateration, RMSE, m, 0 to 2.5 s": fix.rmse(0, ALL),
        "(EKF,3), RMSE, m, 2.5 to 5 s": filtered.rmse(0, INTERVALS[1]),
        "trilateration, change from sample to sample, m": fix.jitter(0, ALL),
        "(EKF,3), change from sample to sample, m": filtered.jitter(0, INTERVALS[1]),
    }
    rough, smooth = fix.jitter(0, ALL), filtered.jitter(0, INTERVALS[1])
    right = [fix.rmse(0, ALL) < _REASONABLE, smooth < rough]
    text = "trilateration with four ranges estimates reasonably well (below 0.5 m); (EKF,3) is smoother"
    return Claim("6-trilateration", text, verdict(float(np.mean(right))), numbers, "HOLDS")


def benefit_claim() -> Claim:
    """Ours: section 6.2 trilaterates wherever four ranges are there, and does not compare with the filter."""
    own = {f"{name}, vehicle 1, RMSE, m": fly_filter(name, RUNS, sensor="range").rmse(0, INTERVALS[0])
           for name in ("ekf", "trilateration")}  # fmt: skip
    fix, filtered = _fixes().rmse(0, ALL), usable(0).rmse(0, INTERVALS[0])
    late = fixes_alone(range_scene(), 1, INTERVALS[2]).rmse(0, ALL)
    filtered_late = usable(1).rmse(1, INTERVALS[2])
    numbers: Numbers = {
        "vehicle 1, 0 to 2.5 s, RMSE of fixes / of the EKF on the same ranges": fix / filtered,
        "vehicle 2, 5 to 10 s": late / filtered_late,
        **{f"flown in quad/CooperativeEstimation-v0: {name}": value for name, value in own.items()},
    }
    better = [filtered < fix, filtered_late < late]
    text = "ours: where four ranges are held, the filter is better on them than trilateration"
    return Claim("6-benefit", text, verdict(float(np.mean(better))), numbers, own=True)


def covariance_claim() -> Claim:
    """Section 6.4: losing vehicles raises the covariance; the reversed topology reverses it."""
    numbers: Numbers = {}
    right = []
    for vehicle, what in ((0, "loses others (4, 3, 2 ranges)"), (1, "gains others (2, 3, 4 ranges)")):
        track = usable(vehicle)
        sigma = [track.sigma(vehicle, part) for part in INTERVALS]
        numbers[f"vehicle {vehicle + 1} {what}: sqrt(tr P), m"] = by_interval(sigma)
        rmse = [track.rmse(vehicle, part) for part in INTERVALS]
        numbers[f"vehicle {vehicle + 1}: RMSE, m"] = by_interval(rmse)
        step = np.diff(sigma) if vehicle == 0 else -np.diff(sigma)
        right += [bool(change > 0.0) for change in step]
    lost = range_filter("EKF").lost().sum(axis=0)
    numbers[f"runs of {RUNS} that end more than {LOST:g} m off (left out above)"] = {
        f"vehicle {i + 1}": f"{n}" for i, n in enumerate(lost.tolist())
    }
    text = "losing another vehicle raises the covariance; the reversed topology reverses it"
    return Claim("6-covariance", text, verdict(float(np.mean(right))), numbers, "HOLDS")


def honesty_claim() -> Claim:
    """Our own: where the filter of this suite knows its error."""
    track = range_filter("EKF")
    cases = {
        "vehicle 1, 4 then 3 ranges": (0, slice(0, 100), True),
        "vehicle 3, 3 ranges": (2, INTERVALS[0], True),
        "vehicle 1, 2 ranges": (0, INTERVALS[2], False),
        "vehicle 2, 2 ranges": (1, INTERVALS[0], False),
    }
    numbers: Numbers = {
        f"{name}: ANEES/3": usable(vehicle).anees(vehicle, part) for name, (vehicle, part, _) in cases.items()
    }
    innovation = track.anis(0, slice(0, 100))
    numbers["vehicle 1, 4 then 3 ranges: NIS / rows"] = innovation
    right = [0.97 < innovation < 1.03]
    for vehicle, part, expected in cases.values():
        right.append((0.8 < usable(vehicle).anees(vehicle, part) < 1.2) == expected)
    text = "ours: with three ranges held from the start the EKF is consistent; with two it is too sure"
    return Claim("6-honesty", text, verdict(float(np.mean(right))), numbers, "HOLDS", own=True)


def fusion_claim() -> Claim:
    """Section 6: covariance intersection de-emphasises estimates of large covariance."""
    P = np.stack([np.eye(6), 100.0 * np.eye(6)])[None]
    fused = covariance_intersection(np.stack([np.zeros(6), np.ones(6)])[None], P, None, "trace").x[0, 0]
    alone, together, own = ring("own"), ring("trace"), fused_ranges()
    ways = {"alone": alone, "intersected by 1/tr": together, "counted twice (all weights 1)": ring("naive")}
    numbers: Numbers = {
        "weight of an estimate of a hundred times the trace": fused * 100.0 / (1.0 + fused * 99.0),
        **{f"ring with angles, {name}": _quality(track.rmse(ALL, SETTLED), track.anees(ALL, SETTLED))
           for name, track in ways.items()},
        **{f"range-only, no feedback, {name}": _quality(*found) for name, found in own.items()},
    }  # fmt: skip
    right = [fused < 0.05, together.rmse(ALL, SETTLED) < alone.rmse(ALL, SETTLED)]
    right.append(own["trace"][0] < max(rmse for name, (rmse, _) in own.items() if "alone" in name))
    right.append(together.anees(ALL, SETTLED) < 1.2)
    text = "covariance intersection de-emphasises estimates of large covariance"
    return Claim("6-fusion", text, verdict(float(np.mean(right))), numbers, "HOLDS")


def _quality(rmse: float, consistency: float) -> dict[str, Value]:
    return {"RMSE, m": rmse, "ANEES/3": consistency}


def aircraft_claim(model: str = "constant") -> Claim:
    """Section 6.4: the aircraft is tracked as well, with range and angles."""
    names = {"constant": "V' = 0", "decaying": "V' = -V as printed", "Cartesian": "Cartesian filter, q = 0.4"}
    numbers: Numbers = {}
    right = []
    for name in ("decaying",) if model == "decaying" else ("constant", "Cartesian"):
        track = aircraft(name)
        for vehicle in (0, 3):
            rmse = [track.rmse(vehicle, part) for part in INTERVALS]
            ratio = [track.anees(vehicle, part) for part in INTERVALS]
            numbers[f"{names[name]}, vehicle {vehicle + 1}: RMSE, m"] = by_interval(rmse)
            numbers[f"{names[name]}, vehicle {vehicle + 1}: ANEES/3"] = by_interval(ratio)
            right += [value < 0.2 for value in rmse] if model != "decaying" else []
            right += [_CONSISTENT[0] < value < _CONSISTENT[1] for value in ratio]
    if model == "decaying":
        text = "the filter (6.12) as printed, V' = -V, knows its error on the aircraft"
        return Claim("6-aircraft-printed", text, verdict(float(np.mean(right))), numbers, "FALSE")
    text = "the aircraft is tracked as well with range and angles (corrected: V' = 0)"
    return Claim("6-aircraft", text, verdict(float(np.mean(right))), numbers, "HOLDS")


def printed_claim() -> Claim:
    """Eqs. (6.3), (6.4) as printed: R neither for what it measures nor in the gain."""
    good = [usable(0).rmse(0, part) for part in INTERVALS]
    numbers: Numbers = {"R in the gain, range: RMSE, m": by_interval(good)}
    right = []
    for name in ("gain without R", "squared range, constant R", "squared range"):
        track = range_filter(name)
        track = track.without(track.lost()[:, 0]) if name == "squared range" else track
        rmse = [track.rmse(0, part) for part in INTERVALS]
        ratio = [track.anees(0, part) for part in INTERVALS]
        corrected = name == "squared range"
        numbers[f"{name}{' of 4 rho^2 sigma^2 + 2 sigma^4' * corrected}: RMSE, m"] = by_interval(rmse)
        numbers[f"{name}: ANEES/3"] = by_interval(ratio)
        if not corrected:
            right += [value < 2.0 for value in ratio]
    text = "the filter works as printed: a gain without R (6.4), a squared range with constant R (6.3)"
    return Claim("6-printed", text, verdict(float(np.mean(right))), numbers, "FALSE")


def fix_covariance_claim(runs: int = 4000) -> Claim:
    """Section 6.2.1.1: P = (H'H)^-1, H of the squared ranges."""
    rng = np.random.default_rng(0)
    places = np.array(CHAPTER_6_RAILS)
    above = np.array([0.3, 0.0, -1.0]) / np.linalg.norm([0.3, 0.0, 1.0])
    numbers: Numbers = {}
    right = []
    for sigma in (0.05, 0.5):
        printed_ones: dict[str, Value] = {}
        ours_ones: dict[str, Value] = {}
        for distance in (3.0, 6.0, 20.0):
            target = places.mean(axis=0) + distance * above
            z = np.linalg.norm(target - places, axis=1) + sigma * rng.normal(size=(runs, 4))
            fix = trilaterate(np.tile(places, (runs, 1, 1)), z, sigma, start=np.tile(target, (runs, 1)))
            error, H = fix.r - target, 2.0 * (target - places)
            printed = np.einsum("ni,ij,nj->n", error, H.T @ H, error).mean() / 3.0
            ours = np.einsum("ni,nij,nj->n", error, np.linalg.inv(fix.P), error).mean() / 3.0
            printed_ones[f"at {distance:g} m"] = _number(float(printed))
            ours_ones[f"at {distance:g} m"] = _number(float(ours))
            right.append(0.5 < printed < 2.0)
        numbers[f"sigma {sigma:g} m: NEES/3 of (H'H)^-1"] = printed_ones
        numbers[f"sigma {sigma:g} m: NEES/3 of sigma^2 (J'J)^-1"] = ours_ones
    text = "(H'H)^-1 is the covariance of a trilaterated position"
    return Claim("6-fix-covariance", text, verdict(float(np.mean(right))), numbers, "FALSE")


def azimuth_claim(runs: int = 10) -> Claim:
    """Ours, on Eq. (6.11): an azimuth is an angle; the target crosses the south, where it jumps by 2 pi."""
    rms = {wrap: _southern_pass(wrap, runs) for wrap in (True, False)}
    ratio = rms[False] / rms[True]
    numbers: Numbers = {"wrapped, RMSE, m": rms[True], "not wrapped": rms[False], "ratio": ratio}
    text = "ours: an innovation of the azimuth has to be wrapped (more than twice the error if it is not)"
    return Claim("6-azimuth", text, "HOLDS" if ratio > 2.0 else "FALSE", numbers, own=True)


def _southern_pass(wrap: bool, runs: int) -> float:
    """RMSE of a filter that sees a target swing across the azimuth +-pi."""
    rng, dt, sigma = np.random.default_rng(7), 0.05, np.array([0.1, 0.02, 0.02])
    t = dt * np.arange(200)
    path = np.stack([np.full(200, -5.0), np.sin(1.2 * t), np.full(200, -2.0)], axis=1)
    x = np.concatenate([path[0], np.gradient(path, dt, axis=0)[0]]) + 0.1 * rng.normal(size=(runs, 6))
    state, R = ekf.TargetFilter(x, np.tile(0.01 * np.eye(6), (runs, 1, 1))), np.diag(sigma**2)
    squares = []
    for r in path:
        z = range_azimuth_elevation(r) + sigma * rng.normal(size=(runs, 3))
        z[:, 1] = wrap_angle(z[:, 1])
        state = ekf.predict(state, dt, 0.2)
        nu = z - range_azimuth_elevation(state.x[:, :3])
        nu[:, 1] = wrap_angle(nu[:, 1]) if wrap else nu[:, 1]
        H = np.concatenate([jacobian(state.x[:, :3]), np.zeros((runs, 3, 3))], axis=2)
        new = kalman_update(state.x, state.P, nu, H, np.tile(R, (runs, 1, 1)))
        state = ekf.TargetFilter(new.x, new.P)
        squares.append(((state.x[:, :3] - r) ** 2).sum(axis=1).mean())
    return float(np.sqrt(np.mean(squares)))


def claims() -> list[Claim]:
    """All of them."""
    return [
        trilateration_claim(),
        covariance_claim(),
        fusion_claim(),
        aircraft_claim(),
        benefit_claim(),
        honesty_claim(),
        printed_claim(),
        fix_covariance_claim(),
        aircraft_claim("decaying"),
        azimuth_claim(),
    ]
