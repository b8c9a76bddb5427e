"""Beyond the text, several vehicles: what messages say against how many come; frozen neighbours and d_s."""

from __future__ import annotations

from typing import Any

import numpy as np

from quad_envs.parameters import Array

from ...report.figures import COLOURS, house_style, new_figure
from ..formation_claims import RULES, SEPARATION, formation
from ..meetings import meet
from ..results import Numbers
from ..team_flights import FROZEN, NO_ROWS, fly_teams
from .drawing import BETTER, LINEAR, NONLINEAR, grouped_bars, legend_below
from .model import Drawing, Sketch, judge

_FREE: dict[str, Any] = {**NO_ROWS, "reach": np.inf, "speed": np.inf}
_CONTENT: dict[str, dict[str, Any]] = {
    "neighbours frozen": {**FROZEN, **NO_ROWS},
    "constant velocity": _FREE,
    "plans": {**_FREE, "neighbour": "plan"},
}
_GRAPHS = {"weak": {}, "strong": {"leader_weight": 10.0}, "complete": {"leader_weight": 10.0}}
_SPEEDS = (0.25, 0.5, 1.0, 1.5, 2.0)  # m/s, of each vehicle
_RUNS = 6
_ROUNDING = 1e-3  # m by which soft rows give way


@house_style()
def message_figure(jobs: int = 1) -> Drawing:
    """Error behind a moving leader: message content on graphs of growing density."""
    flights = [
        formation("triangle", graph, "line", policy, start="sorted", **weights,
                  **({"comm": "plan"} if policy.get("neighbour") == "plan" else {}))
        for policy in _CONTENT.values() for graph, weights in _GRAPHS.items()
    ]  # fmt: skip
    flown = fly_teams(flights, jobs)
    n = len(_GRAPHS)
    figure, axes = new_figure(1, 2, height=1.1)
    table = {name: np.array([o.final for o in flown[i * n : (i + 1) * n]]) for i, name in enumerate(_CONTENT)}
    colours = (NONLINEAR, LINEAR, BETTER)
    grouped_bars(axes[0, 0], list(_GRAPHS), {k: np.maximum(v, 1e-5) for k, v in table.items()}, colours)
    axes[0, 0].set_yscale("log")
    axes[0, 0].set_title("error of the worst vehicle after 20 s, m")
    axes[0, 0].set_xlabel("graph, sparse to dense")
    for (name, _), colour, outcome in zip(_CONTENT.items(), colours, flown[::n], strict=True):
        t = outcome.dt * np.arange(len(outcome.distance))
        axes[0, 1].semilogy(t, np.maximum(outcome.distance, 1e-5), color=colour, label=name)
    axes[0, 1].set_title("weak graph: largest error, m")
    axes[0, 1].set_xlabel("time, s")
    legend_below(figure, axes[0, 1], 3)
    numbers: Numbers = {
        f"{name}: error, m": dict(zip(_GRAPHS, [f"{value:.4f}" for value in row], strict=True))
        for name, row in table.items()
    }
    frozen, ours = table["neighbours frozen"], table["constant velocity"]
    return Drawing(figure, judge(bool(frozen.min() > 0.1), bool(ours[0] < 0.01)), numbers)


_SHOWN = {
    "text, sign fixed": ("neighbour frozen, as printed (sign corrected)", NONLINEAR),
    "default": ("ours", BETTER),
}


@house_style()
def frozen_figure(jobs: int = 1) -> Drawing:
    """Smallest distance of two vehicles that meet head-on, against their speed."""
    figure, axes = new_figure(1, 1, height=1.3)
    axis = axes[0, 0]
    gaps: dict[str, Array] = {}
    for rule, (label, colour) in _SHOWN.items():
        gaps[rule] = np.stack([meet(RULES[rule], speed, 2, _RUNS).gap for speed in _SPEEDS])
        axis.plot(_SPEEDS, gaps[rule].min(axis=1), "-", color=colour, label=label)
        axis.plot(np.repeat(_SPEEDS, _RUNS), gaps[rule].ravel(), "o", color=colour, ms=3)
    axis.axhline(SEPARATION, color=COLOURS["red"], lw=0.9, ls=":", label="$d_s$")
    axis.set_ylim(bottom=0.0)
    axis.set_xlabel("speed of each vehicle, m/s")
    axis.set_title("smallest distance of two vehicles that exchange places, m (dots: runs)")
    legend_below(figure, axis, 3)
    numbers: Numbers = {
        f"{label}: smallest distance, m": {
            f"at {speed:g} m/s": f"{gap:.3f}"
            for speed, gap in zip(_SPEEDS, gaps[rule].min(axis=1), strict=True)
        }
        for rule, (label, _) in _SHOWN.items()
    }
    kept = SEPARATION - _ROUNDING
    broken, held = gaps["text, sign fixed"].min(axis=1) < kept, gaps["default"].min(axis=1) >= kept
    return Drawing(figure, judge(bool(broken.all()), bool(held.all())), numbers)


SKETCHES = [
    Sketch(
        "beyond-messages", "message content against graph density",
        "Strongly connected followers improve the formation; messages are states, frozen over the horizon.",
        "Our finding: what a message says matters more than how many there are. With frozen neighbours a "
        "moving leader is followed with an error on every graph; extrapolated at constant velocity it "
        "vanishes on the sparsest one. Denser graphs have weights of 10 toward the leader.",
        message_figure, ("5-moving", "5-height-triangle"),
    ),
    Sketch(
        "beyond-separation", "the constraint with a frozen neighbour violates d_s",
        "No two vehicles are ever nearer than d_s, by a constraint on each other's position at the sample.",
        "Our finding: with the neighbour frozen over the horizon the constraint is broken at every speed of "
        "a head-on meeting, however slow; reciprocal rows with a braking row keep it. Six runs per speed.",
        frozen_figure, ("5-separation-printed", "5-separation"),
    ),
]  # fmt: skip
