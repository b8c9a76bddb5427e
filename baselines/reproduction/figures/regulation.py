"""Figures 4.16 to 4.25: feedback linearization and LMPC to the origin, with strong and weak rotors."""

from __future__ import annotations

from functools import cache, partial

import numpy as np

from quad_envs.parameters import QuadrotorParams

from ...report.figures import house_style, new_figure
from ..flights import Outcome, fly_all
from ..regulation_claims import (
    GAINS_FROM_ABOVE,
    GAINS_FROM_BELOW,
    WEAK_ROTORS,
    overshoot,
    regulation_flight,
    settled,
)
from ..results import Numbers
from .drawing import LINEAR, NONLINEAR, draw_forces, legend_below, times
from .model import Drawing, Sketch, judge

DT = 0.05  # s
_CURVES = (("LMPC", LINEAR), ("feedback linearization", NONLINEAR))
_SIDES = {"below": GAINS_FROM_BELOW, "above": GAINS_FROM_ABOVE}
_FAR = 8.0  # m, where a flight that is lost leaves the axes


@cache
def flown(d: float, kappa: float) -> dict[str, tuple[Outcome, Outcome]]:
    """Side -> LMPC and feedback linearization from (d, d, d) below or (d, d, -d) above the origin."""
    outcomes = {}
    for side, gains in _SIDES.items():
        flights = [regulation_flight("LMPC", d, side, kappa), regulation_flight("FBL", d, side, kappa, gains)]
        linear, ours = fly_all(flights)
        outcomes[side] = linear, ours
    return outcomes


def _start(d: float, side: str) -> str:
    return f"from ({d:g}, {d:g}, {d if side == 'below' else -d:g}), {side} the origin"


@house_style()
def state_figure(d: float, kappa: float, jobs: int = 1) -> Drawing:
    """Position against time, from below and from above."""
    figure, axes = new_figure(3, 2, height=0.75, sharex=True, sharey="row")
    numbers: Numbers = {}
    right = []
    for column, (side, pair) in enumerate(flown(d, kappa).items()):
        for outcome, (label, colour) in zip(pair, _CURVES, strict=True):
            p = outcome.states[:, :3]
            t = times(len(p))
            for i, axis in enumerate(axes[:, column]):
                axis.plot(t, np.where(np.abs(p[:, i]) < _FAR, p[:, i], np.nan), color=colour, label=label)
                if outcome.record.crashed and abs(p[-1, i]) < _FAR:
                    axis.plot(t[-1], p[-1, i], "x", color=colour)
            numbers[f"{_start(d, side)}, {label}"] = _told(outcome)
        axes[0, column].set_title(_start(d, side))
        axes[-1, column].set_xlabel("time, s")
        linear, ours = pair
        fast = ours.record.settling_time <= linear.record.settling_time + 0.25
        near = settled(linear) and settled(ours) and (fast or kappa < 1.0)
        right.append(near if d < 3.0 else settled(linear) and not settled(ours))
    for axis, name in zip(axes[:, 0], ("x, m", "y, m", "z (down), m"), strict=True):
        axis.set_ylabel(name)
    legend_below(figure, axes[0, 0], 2)
    return Drawing(figure, judge(*right), numbers)


def _told(outcome: Outcome) -> str:
    if outcome.record.crashed:
        return f"lost after {DT * outcome.record.steps:.1f} s"
    if not settled(outcome):
        return "not settled"
    return f"settles in {outcome.record.settling_time:.2f} s, overshoot {overshoot(outcome):.0%}"


@house_style()
def input_figure(d: float, kappa: float, jobs: int = 1) -> Drawing:
    """Rotor forces against time, from below and from above."""
    figure, axes = new_figure(2, 2, height=0.85, sharex=True)
    numbers: Numbers = {}
    right = []
    force_max = kappa * QuadrotorParams().weight
    for column, (side, pair) in enumerate(flown(d, kappa).items()):
        share = [outcome.record.saturation_share for outcome in pair]
        for axis, outcome, (label, _) in zip(axes[:, column], pair, _CURVES, strict=True):
            t = times(len(outcome.commands))
            draw_forces(axis, t, outcome.commands, force_max, f"{label}\n{_start(d, side)}")
            numbers[f"{_start(d, side)}, {label}: share of commands at a limit"] = (
                f"{outcome.record.saturation_share:.1%}"
            )
        right.append(share[1] > 2.0 * share[0] + 0.01)
        axes[1, column].set_xlabel("time, s")
    legend_below(figure, axes[0, 0], 4)
    inside = all(
        (outcome.commands >= -1e-9).all() and (outcome.commands <= force_max + 1e-9).all()
        for pair in flown(d, kappa).values()
        for outcome in pair
    )
    return Drawing(figure, judge(inside) if kappa == 1.0 else judge(*right), numbers)


_WHERE = (
    "Starts are at rest. Since z points down, the printed (d, d, d) lies below the origin; its mirror image "
    "above it is shown beside it. The gains are not printed: each side has a set that was found by search."
)


def _pair(number: int, case: int, d: float, weak: bool) -> list[Sketch]:
    kappa = WEAK_ROTORS if weak else 1.0
    rotors = " with rotors of 2.45 N" if weak else ""
    if d > 2.0:
        said = "Feedback linearization becomes unstable where LMPC continues to track."
        claims = ("4-fbl-unstable",)
    elif weak:
        said, claims = "The same condition with weak rotors; both still regulate.", ("4-fbl-saturates",)
    else:
        said = "Both perform well; feedback linearization is slightly faster, with mild overshoot."
        claims = ("4-fbl-comparable",)
    inputs = (
        "The input of feedback linearization saturates much more than that of LMPC."
        if weak
        else "The inputs of both, within their limits."
    )
    return [
        Sketch(f"4.{number}", f"regulator case {case}{rotors}", said, f"Positions. {_WHERE}",
               partial(state_figure, d, kappa), claims),
        Sketch(f"4.{number + 1}", f"inputs of regulator case {case}{rotors}", inputs,
               f"Rotor forces; dotted red are their limits. {_WHERE}", partial(input_figure, d, kappa),
               ("4-fbl-saturates",) if weak else claims),
    ]  # fmt: skip


SKETCHES = [
    *_pair(16, 1, 1.0, False),
    *_pair(18, 2, 2.0, False),
    *_pair(20, 1, 1.0, True),
    *_pair(22, 2, 2.0, True),
    *_pair(24, 3, 3.0, True),
]
