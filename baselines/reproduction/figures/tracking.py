"""Figures 4.1 to 4.15: three trajectories, followed by LMPC and by the SDC-NMPC of the text."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import numpy as np

from quad_envs.disturbances import TorquePulse
from quad_envs.parameters import Array, QuadrotorParams

from ...report.figures import COLOURS, house_style, new_figure
from ..flights import DESCENDING, Flight, Outcome, fly_all
from ..results import SHOWN, Numbers
from ..tracking_claims import pair, transient_of
from .drawing import (
    LINEAR,
    NONLINEAR,
    REFERENCE,
    draw_forces,
    draw_plan,
    in_space,
    legend_below,
    raised,
    times,
)
from .model import Drawing, Sketch, judge

DT, SECONDS = 0.05, 10.0
TASKS = {"helix": "helical", "spiral": "spherical spiral", "lines": "straight line"}
_ONLY_TRACKED = "spiral"  # of its transient the text says nothing, but for the disturbed one
CURVES = (("LMPC", "LMPC", LINEAR), ("SDC 1/2", "NMPC (SDC, alpha = 1/2)", NONLINEAR))


@cache
def flown(task: str, disturbed: bool) -> tuple[Outcome, Outcome]:
    """LMPC and SDC-NMPC on a task, N = 25; the torque pulse is fed forward, as in 4.7."""
    env: dict[str, Any] = (
        {"disturbance": TorquePulse(clock="absolute"), "reveal_disturbance": True} if disturbed else {}
    )
    linear, nonlinear = fly_all([Flight(name, DESCENDING[task], env=env) for name, _, _ in CURVES])
    return linear, nonlinear


def reference_rows(task: str, steps: int) -> Array:
    """Of a task at the control samples, (steps, 8)."""
    return np.asarray(DESCENDING[task].rows(times(steps), np.random.default_rng(0)))


@house_style()
def path_figure(task: str, disturbed: bool, jobs: int = 1) -> Drawing:
    """Where the vehicles flew: in space, from above, and height against time."""
    outcomes = flown(task, disturbed)
    rows = reference_rows(task, len(outcomes[0].error))
    t = times(len(rows))
    figure, axes = new_figure(1, 3, height=1.25, width=7.2, gridspec_kw={"width_ratios": [1.5, 1.0, 1.0]})
    space = in_space(figure, axes[0, 0])
    plan, side = axes[0, 1:]
    space.plot(*raised(rows[:, :3]), **REFERENCE, label="reference")
    draw_plan(plan, rows[:, :3], **REFERENCE)
    side.plot(t, -rows[:, 2], **REFERENCE)
    for outcome, (_, label, colour) in zip(outcomes, CURVES, strict=True):
        p = outcome.states[: len(rows), :3]
        space.plot(*raised(p), color=colour, label=label)
        draw_plan(plan, p, color=colour)
        side.plot(t[: len(p)], -p[:, 2], color=colour)
    plan.set_aspect("equal", adjustable="datalim")
    plan.set_title("from above")
    side.set_title("height, m")
    side.set_xlabel("time, s")
    legend_below(figure, space, 3)
    ends = [float(outcome.error[-40:].mean()) for outcome in outcomes]
    numbers: Numbers = {
        f"{label}, mean error of the last 2 s, m": end
        for (_, label, _), end in zip(CURVES, ends, strict=True)
    }
    return Drawing(figure, judge(*(end < 0.1 * _extent(rows) for end in ends)), numbers)


def _extent(rows: Array) -> float:
    return float(np.ptp(rows[:, :3], axis=0).max())


@house_style()
def error_figure(task: str, disturbed: bool, jobs: int = 1) -> Drawing:
    """Tracking errors of each axis and together; with the disturbance also the rotor forces."""
    outcomes = flown(task, disturbed)
    rows = reference_rows(task, len(outcomes[0].error))
    figure, axes = new_figure(3 if disturbed else 2, 2, height=0.85, sharex=True)
    for outcome, (_, label, colour) in zip(outcomes, CURVES, strict=True):
        error = outcome.states[: len(outcome.error), :3] - rows[: len(outcome.error), :3]
        t = times(len(error))
        for i, axis in enumerate(axes.flat[:3]):
            axis.plot(t, error[:, i], color=colour, label=label)
        axes.flat[3].plot(t, outcome.error, color=colour)
    for axis, name in zip(axes.flat, ("x, m", "y, m", "z (down), m", "distance, m"), strict=False):
        axis.set_title(f"error of the position: {name}")
    if disturbed:
        for axis, outcome, (_, label, _) in zip(axes[2], outcomes, CURVES, strict=True):
            t = times(len(outcome.commands))
            draw_forces(axis, t, outcome.commands, QuadrotorParams().weight, f"{label}: rotor forces, N")
            axis.set_ylabel("")
        axes[2, 1].legend(ncols=4, fontsize=6, loc="upper center", handlelength=1.0, columnspacing=0.8)
    for axis in axes[-1]:
        axis.set_xlabel("time, s")
    legend_below(figure, axes[0, 0], 2)
    return Drawing(figure, *_error_verdict(task, disturbed, outcomes))


def _error_verdict(task: str, disturbed: bool, outcomes: tuple[Outcome, Outcome]) -> tuple[str, Numbers]:
    """NMPC is better in RMS and, where the text says so, in the transient; disturbed, they keep close."""
    rms = [outcome.record.position_rms for outcome in outcomes]
    what, value = transient_of(task)
    transient = [value(outcome.error) for outcome in outcomes]
    numbers: Numbers = {"RMS, m": pair(rms), what: pair(transient)}
    right = [rms[1] < rms[0]]
    if disturbed or task != _ONLY_TRACKED:
        right.append(transient[1] < transient[0])
    if disturbed:
        clean = [outcome.record.position_rms for outcome in flown(task, False)]
        share = [f"{outcome.record.saturation_share:.1%}" for outcome in outcomes]
        numbers["RMS of the flight without disturbance, m"] = pair(clean)
        numbers["share of commands at a limit"] = pair(share)
        right.append(all(ours < 1.1 * before for ours, before in zip(rms, clean, strict=True)))
    return judge(*right), numbers


@house_style()
def velocity_figure(task: str, jobs: int = 1) -> Drawing:
    """The velocity of a reference."""
    rows = reference_rows(task, round(SECONDS / DT) + 1)
    t = times(len(rows))
    figure, axes = new_figure(1, 1, height=1.0)
    for i, (name, colour) in enumerate(zip("xyz", ("blue", "orange", "green"), strict=True)):
        label = f"$v_{name}$" + " (down)" * (name == "z")
        axes[0, 0].step(t, rows[:, 3 + i], "--" if name == "y" else "-", color=COLOURS[colour], where="post",
                        label=label)  # fmt: skip
    axes[0, 0].set_ylabel("velocity, m/s")
    axes[0, 0].set_xlabel("time, s")
    axes[0, 0].margins(y=0.12)
    legend_below(figure, axes[0, 0], 3)
    speed = np.linalg.norm(rows[:, 3:6], axis=1)
    numbers: Numbers = {"speed, m/s": f"{speed.min():.3f} to {speed.max():.3f}"}
    return Drawing(figure, SHOWN, numbers)


def _pair(number: int, task: str, disturbed: bool) -> list[Sketch]:
    what = f"{TASKS[task]} trajectory" + ", disturbed" * disturbed
    how = "LMPC and SDC-NMPC (N = 25, alpha = 1/2, Q = R = I)"
    aside = ", torque disturbance from 5 s on, which both are told of and feed forward" if disturbed else ""
    acts = "perform well under the disturbance" if disturbed else "achieve good tracking"
    better = "The transient response of the nonlinear MPC is clearly better"
    if task == _ONLY_TRACKED and not disturbed:
        better = "Both controllers achieve successful tracking"
    kept = "; errors stay acceptable and the inputs within their bounds" if disturbed else ""
    claims = ("4-disturbance",) if disturbed else ("4-rms", "4-transient")
    return [
        Sketch(
            f"4.{number}", f"path on the {what}", f"Both controllers {acts}.",
            f"Reference and flights of {how}{aside}. The verdict is whether both end within a tenth of the "
            "extent of the reference.",
            partial(path_figure, task, disturbed), claims,
        ),
        Sketch(
            f"4.{number + 1}", f"errors on the {what}", f"{better}{kept}.",
            f"Tracking errors of {how}{aside}; dotted red are the limits of the rotors." if disturbed
            else f"Tracking errors of {how}.",
            partial(error_figure, task, disturbed), claims,
        ),
    ]  # fmt: skip


SKETCHES = [
    *(sketch for i, task in enumerate(TASKS) for sketch in _pair(1 + 2 * i, task, False)),
    *(sketch for i, task in enumerate(TASKS) for sketch in _pair(7 + 2 * i, task, True)),
    *(
        Sketch(
            f"4.{13 + i}",
            f"velocity of the {name} reference",
            "The picture alone; radii and rates are not printed and were found by fitting both tables.",
            f"Velocity of the {name} reference in the inertial frame, as the tables were reproduced with.",
            partial(velocity_figure, task),
        )
        for i, (task, name) in enumerate(TASKS.items())
    ),
]
