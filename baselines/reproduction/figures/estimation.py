"""Figures 6.2 to 6.6: four vehicles estimate a target with communication that changes at 2.5 and 5 s."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from controllers.estimation.trilateration import trilaterate
from quad_envs.parameters import Array

from ...report.figures import COLOURS, house_style, new_figure
from ..estimation_claims import by_interval
from ..estimation_scenes import aircraft, aircraft_scene, range_filter, range_scene
from ..results import SHOWN, Numbers
from ..scenes import INTERVALS, Scene, Track
from .drawing import in_space, legend_below, raised
from .model import Drawing, Sketch, judge

_DT = 0.05  # s
_GOOD = 0.2  # m, RMSE at which the aircraft counts as tracked
_NEEDED = 4  # ranges that trilateration needs

# Measurements held at each sample, RMSE and sqrt(tr P) of the three intervals -> what is right.
Judged = Callable[[NDArray[np.int64], list[float], list[float]], list[bool]]


def _a_run(track: Track) -> int:
    """The first run in which no filter settled on the wrong side."""
    return int(np.flatnonzero(~track.lost().any(axis=1))[0])


@house_style()
def range_figure(vehicles: tuple[int, int], jobs: int = 1) -> Drawing:
    """Errors with ranges alone: the EKF, and fixes where four ranges are held."""
    right = _follows if vehicles == (0, 1) else _three_or_two
    return _error_figure(range_scene(), range_filter("EKF"), vehicles, right, fixes=True)


@house_style()
def aircraft_figure(vehicles: tuple[int, int], jobs: int = 1) -> Drawing:
    """Errors with range and angles on the aircraft, polar filter with V' = 0."""
    return _error_figure(aircraft_scene(), aircraft("constant"), vehicles, _close)


def _error_figure(
    scene: Scene, track: Track, vehicles: tuple[int, int], judged: Judged, fixes: bool = False
) -> Drawing:
    run, n = _a_run(track), scene.task.vehicles
    t = _DT * np.arange(len(track.error))
    figure, axes = new_figure(4, 2, height=0.62, sharex=True, sharey="row")
    numbers: Numbers = {}
    right = []
    for column, vehicle in enumerate(vehicles):
        error, P = track.error[:, run, vehicle], track.P[:, run, vehicle]
        sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
        held = np.asarray(scene.held[:, run * n + vehicle].sum(axis=-1))
        for i, axis in enumerate(axes[:3, column]):
            band, marks = 2.0 * sigma[:, i], {"color": COLOURS["blue"], "alpha": 0.15, "lw": 0}
            axis.fill_between(t, -band, band, label="two standard deviations", **marks)
            axis.plot(t, error[:, i], color=COLOURS["blue"], label="EKF")
            when = held >= _NEEDED
            if fixes and when.any():
                fix = _fixes(scene, run * n + vehicle, when)
                axis.plot(t[when], fix[:, i], ".", color=COLOURS["orange"], ms=2.5, label="trilateration")
            axis.axhline(0.0, color=COLOURS["ink"], lw=0.5)
            reach = 1.25 * float(np.abs(track.error[40:, run, list(vehicles), i]).max()) + 0.3
            axis.set_ylim(-reach, reach)
        axes[3, column].step(t, held, where="post", color=COLOURS["ink"])
        axes[0, column].set_title(f"vehicle {vehicle + 1}")
        axes[3, column].set_xlabel("time, s")
        usable = track.without(track.lost()[:, vehicle])
        rmse = [usable.rmse(vehicle, part) for part in INTERVALS]
        sure = [usable.sigma(vehicle, part) for part in INTERVALS]
        who = f"vehicle {vehicle + 1}, {usable.error.shape[1]} of {track.error.shape[1]} runs"
        numbers[f"{who}: RMSE, m"] = by_interval(rmse)
        numbers[f"{who}: sqrt(tr P), m"] = by_interval(sure)
        right += judged(held, rmse, sure)
    for axis, name in zip(axes[:, 0], ("x error, m", "y error, m", "z error, m", "held"), strict=True):
        axis.set_ylabel(name)
    axes[3, 0].set_ylim(0.5, 4.5)
    axes[3, 0].set_yticks([1, 2, 3, 4])
    shown = axes[0, int(np.argmax([len(axis.lines) for axis in axes[0]]))]
    legend_below(figure, shown, 3)
    return Drawing(figure, judge(*right), numbers)


def _follows(held: NDArray[np.int64], rmse: list[float], sure: list[float]) -> list[bool]:
    """Whether the covariance grows where measurements are lost, and shrinks where they are gained."""
    last = [int(held[part][-1]) for part in INTERVALS]
    return [(sure[i + 1] > sure[i]) == (last[i + 1] < last[i]) for i in range(2) if last[i + 1] != last[i]]


def _three_or_two(held: NDArray[np.int64], rmse: list[float], sure: list[float]) -> list[bool]:
    return [set(held.tolist()) <= {2, 3}]


def _close(held: NDArray[np.int64], rmse: list[float], sure: list[float]) -> list[bool]:
    return [max(rmse) < _GOOD]


def _fixes(scene: Scene, row: int, when: NDArray[np.bool_]) -> Array:
    """Errors of trilaterated positions, without any filter, m."""
    z, places, held = scene.z[when, row, :, 0], scene.places[when, row], scene.held[when, row]
    if not len(z):
        return np.zeros((0, 3))
    fix = trilaterate(places, z, scene.task.sensor_sigma[0], held)
    return np.where(fix.accepted[:, None], fix.r - scene.target[when, row, :3], np.nan)


@house_style()
def target_figure(jobs: int = 1) -> Drawing:
    """The true path of the aircraft."""
    r = aircraft_scene().target[:, 0, :3]
    t = _DT * np.arange(len(r))
    figure, axes = new_figure(1, 2, height=1.3)
    space, axis = in_space(figure, axes[0, 0]), axes[0, 1]
    space.plot(*raised(r), color=COLOURS["ink"])
    space.plot(*raised(r[:1]), "o", color=COLOURS["ink"], mfc="white", ms=4)
    colours = {"x": "blue", "y": "orange", "height": "green"}
    for values, (name, colour) in zip(raised(r), colours.items(), strict=True):
        axis.plot(t, values, color=COLOURS[colour], label=name)
    axis.set_title("position, m")
    axis.set_xlabel("time, s")
    axis.legend()
    length = float(np.linalg.norm(np.diff(r, axis=0), axis=1).sum())
    return Drawing(figure, SHOWN, {"length of the path, m": length, "time, s": float(t[-1])})


_CHANGES = "at first four, then three, then two measurements for vehicle 1, and the reverse for vehicle 2"
_RANGE_NOTE = (
    "One run of sixty; runs whose filter settles on the wrong side do not enter the numbers. Ranges alone "
    "(sigma 0.1 m), constant-velocity filter; the band is what the filter believes. The dots "
    "are positions trilaterated from four ranges, without a filter."
)
_AIRCRAFT_NOTE = "One run of forty, range and angles, the filter (6.12) with V' = 0 in place of V' = -V."

SKETCHES = [
    Sketch(
        "6.2", "constant velocity, vehicles 1 and 2",
        "Trilateration estimates reasonably well, the EKF with three measurements is smoother, and fewer "
        "accessible vehicles raise the covariance; for vehicle 2 the topology is reversed.",
        f"{_RANGE_NOTE} The last row counts measurements held: {_CHANGES}.", partial(range_figure, (0, 1)),
        ("6-trilateration", "6-covariance", "6-benefit"),
    ),
    Sketch(
        "6.3", "constant velocity, vehicles 3 and 4",
        "These vehicles use three and two measurements throughout.",
        _RANGE_NOTE, partial(range_figure, (2, 3)), ("6-covariance", "6-honesty"),
    ),
    Sketch(
        "6.4", "aircraft, vehicles 1 and 2",
        "Tracking with similar changes of topology, with range and angles.",
        f"{_AIRCRAFT_NOTE} The last row counts measurements held: {_CHANGES}.",
        partial(aircraft_figure, (0, 1)),
        ("6-aircraft", "6-aircraft-printed"),
    ),
    Sketch(
        "6.5", "aircraft, vehicles 3 and 4", "The same for the other two vehicles.", _AIRCRAFT_NOTE,
        partial(aircraft_figure, (2, 3)), ("6-aircraft",),
    ),
    Sketch(
        "6.6", "aircraft, true position",
        "The path of the point-mass aircraft; its manoeuvre is not printed.",
        "Our manoeuvre of the point-mass aircraft: a weaving climb.", target_figure,
    ),
]  # fmt: skip
