"""The scenes of chapter 6 and the filters that the claims and the tables look at, each run once a process.

Range only: four vehicles, who loses or gains others at 2.5 and 5 s. Targets start where they are expected,
and filters start off by their own covariance, so that the geometry is the same in all runs.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from controllers.estimation.consistency import covariance_bound, information
from controllers.estimation.ekf import constant_velocity_model
from controllers.estimation.fusion import covariance_intersection
from quad_envs.parameters import Array
from quad_envs.targets import Aircraft, make_target

from .scenes import (
    INTERVALS,
    Filter,
    Scene,
    Track,
    constant_velocity,
    drawn,
    ekf_update,
    record,
    run_filter,
)
from .text_filters import polar_model, random_walk, range_update, squared_range, without_noise

RUNS = 60
FUSION_RUNS = 40
Q = 0.02  # m^2/s^3, of the target and of the filters
SETTLED = slice(40, 200)  # 2 to 10 s
_START = make_target("chapter-6").rows(np.array([0.0, 0.05]), np.random.default_rng(0))[0]
_SIGMA = np.full(6, 0.5)  # m, m/s
_KNOWN = {"target_spread": (0.0, 0.0)}
_RING = np.array([[0, 1, 3], [1, 0, 2], [2, 1, 3], [3, 2, 0]])
_AIRCRAFT = Aircraft()
_POLAR = np.array([*_AIRCRAFT.position, _AIRCRAFT.speed, _AIRCRAFT.climb, _AIRCRAFT.course])


@cache
def range_scene() -> Scene:
    """Ranges only, communication as in figures 6.2 to 6.5."""
    return record(RUNS, sensor="range", **_KNOWN)


@cache
def range_filter(name: str) -> Track:
    """A filter of the table of section 6 on the ranges."""
    scene = range_scene()
    start = drawn(scene, _START, _SIGMA)
    cv = constant_velocity(Q)
    if name == "EKF":
        return run_filter(scene, start, cv, 1)
    if name == "position only":
        first = start[0][:, :3], start[1][:, :3, :3]
        return run_filter(scene, first, random_walk(0.81), 1, range_update)
    update = {
        "squared range": squared_range(constant=False),
        "squared range, constant R": squared_range(constant=True),
        "gain without R": without_noise,
    }[name]
    return run_filter(scene, start, cv, 1, update)


@cache
def bounds(vehicle: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Bounds of a vehicle's RMSE per interval: mean over the runs' own recursions; posterior Cramer-Rao."""
    scene, n = range_scene(), range_scene().task.vehicles
    d = scene.target[:, vehicle::n, None, :3] - scene.places[:, vehicle::n]
    gained = information(d, scene.task.sensor_sigma, 1, scene.held[:, vehicle::n])
    F, noise = constant_velocity_model(scene.task.dt, Q)
    P_0 = np.diag(_SIGMA**2)
    own = covariance_bound(F, noise, P_0, gained).mean(axis=1)
    common = covariance_bound(F, noise, P_0, gained.mean(axis=1))
    traces = [np.trace(P[:, :3, :3], axis1=1, axis2=2) for P in (own, common)]
    first, second = (np.sqrt([trace[part].mean() for part in INTERVALS]) for trace in traces)
    return first, second


@cache
def aircraft_scene() -> Scene:
    """Range and angles on the aircraft."""
    return record(FUSION_RUNS, target=_AIRCRAFT, **_KNOWN)


@cache
def aircraft(model: str) -> Track:
    """Filters on the aircraft: "decaying" (as printed), "constant" or "Cartesian"."""
    scene = aircraft_scene()
    if model == "Cartesian":
        mean = scene.target[0, 0]
        start = drawn(scene, mean, np.repeat([0.5, 0.3], 3))
        return run_filter(scene, start, constant_velocity(0.4), 3)
    start = drawn(scene, _POLAR, np.array([0.5, 0.5, 0.5, 0.3, 0.1, 0.1]))
    return run_filter(scene, start, polar_model("decaying" if model == "decaying" else "constant"), 3)


def intersect(state: Filter, hears: NDArray[np.int64], weights: str) -> Filter:
    """Every vehicle fuses the estimates of those it hears, all of them from before the fusion."""
    x, P = state
    n = len(hears)
    many_x = x.reshape(-1, n, 6)[:, hears].reshape(-1, hears.shape[1], 6)
    many_P = P.reshape(-1, n, 6, 6)[:, hears].reshape(-1, hears.shape[1], 6, 6)
    fused = covariance_intersection(many_x, many_P, None, weights)
    return fused.x, fused.P


@cache
def ring_scene() -> Scene:
    """Range and angles; everybody could hear everybody, so that each study takes what it wants."""
    return record(FUSION_RUNS, graph="complete", **_KNOWN)


@cache
def ring(how: str) -> Track:
    """A ring of four with range and angles.

    Args:
        how: "own", "shared" (measurements of both neighbours), "central" (of all), or the weights with which
            estimates are intersected in each step.
    """
    scene = ring_scene()
    senders = np.array([[i, *(j for j in range(4) if j != i)] for i in range(4)])  # own, then per comm slot
    shared = np.array([[j in _RING[i] for j in row] for i, row in enumerate(senders)])
    mask = {"shared": shared, "central": np.ones((4, 4), bool)}.get(how, senders == np.arange(4)[:, None])
    slots = scene.held.shape[2]
    allowed = np.tile(np.pad(mask, ((0, 0), (0, slots - 4))), (FUSION_RUNS, 1))
    scene = scene._replace(held=scene.held & allowed)
    fuse = None if how in ("own", "shared", "central") else lambda state: intersect(state, _RING, how)
    return run_filter(scene, drawn(scene, _START, _SIGMA), constant_velocity(Q), 3, ekf_update, fuse)


@cache
def fused_ranges() -> dict[str, tuple[float, float]]:
    """Range-only filters of the four vehicles fused by one that hears all, without feedback.

    Returns:
        RMSE, m, and ANEES/3 of each vehicle alone and of the fused estimates from 2 s on, in the runs in
        which no vehicle was lost.
    """
    track = range_filter("EKF")
    track = track.without(np.asarray(track.lost().any(axis=1)))
    found = {f"vehicle {i + 1} alone": _quality(track.error[:, :, i], track.P[:, :, i]) for i in range(4)}
    for weights in ("trace", "naive"):
        shape = track.error.shape
        x, P = track.error.reshape(-1, 4, 3), track.P.reshape(-1, 4, 3, 3)
        fused = covariance_intersection(x, P, None, weights)
        found[weights] = _quality(fused.x.reshape(*shape[:2], 3), fused.P.reshape(*shape[:2], 3, 3))
    return found


def _quality(error: Array, P: Array) -> tuple[float, float]:
    track = Track(error[:, :, None], P[:, :, None], np.zeros(()), np.zeros((), dtype=np.int64))
    return track.rmse(0, SETTLED), track.anees(0, SETTLED)
