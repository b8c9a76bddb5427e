"""Figures 7.4 to 7.9: a team that estimates a target and keeps its formation beside it, on two graphs."""

from __future__ import annotations

from functools import cache, partial

import numpy as np

from quad_envs.envs.team.options import CHAPTER_7_SLOTS
from quad_envs.parameters import POSITION, Array

from ...report.figures import COLOURS, house_style, new_figure
from ..results import Numbers
from ..target_claims import CLOSE, by_vehicle, estimate_error, flights, of_vehicles, tracking_error
from .drawing import LIMIT, REFERENCE, VEHICLES, draw_plan, in_space, legend_below, raised
from .formation import TeamPath, fly_path
from .model import Drawing, Sketch, judge

_REACH = 3.0  # m, of the panels around the formation
_TIMES = (0.0, 2.0, 5.0, 10.0, 15.0, 24.0)  # s


@cache
def flown(case: int) -> TeamPath:
    """The corrected scheme behind a target that turns, seed 0."""
    return fly_path(flights(case, "turn", "corrected")[0])


def _wanted(path: TeamPath) -> Array:
    """The true slot of each vehicle beside the target, (T, N, 3), m."""
    return np.stack([e.references[: len(e.commands), POSITION] for e in path.episodes], axis=1)


def _target(path: TeamPath) -> Array:
    """Where the target is, (T, 3), m: a slot less its place beside the target."""
    return np.asarray(_wanted(path)[:, 0] - np.array(CHAPTER_7_SLOTS[0]))


def _verdict(case: int) -> tuple[str, Numbers]:
    """Whether all stay with the target, those who have no contact to it, too."""
    outcome = flown(case).outcome
    error, estimate = tracking_error([outcome]), estimate_error([outcome])
    numbers: Numbers = {
        "tracking error, RMS of the last 5 s, m": by_vehicle(error.tolist()),
        "error of the estimates of the target, m": by_vehicle(estimate.tolist()),
        "smallest distance of two vehicles, m": outcome.gap,
    }
    return judge(bool((error < CLOSE).all())), numbers


@house_style()
def plane_figure(case: int, jobs: int = 1) -> Drawing:
    """Paths from above and from the side, distances to the slots, errors of the estimates."""
    path = flown(case)
    target, t = _target(path), path.outcome.dt * np.arange(len(path.forces))
    figure, axes = new_figure(2, 2, height=1.1)
    above, side, distance, estimates = axes.flat
    for second, axis in (("y", above), ("height", side)):
        draw_plan(axis, target, second, **REFERENCE, label="target")
        for i, colour in enumerate(VEHICLES):
            draw_plan(axis, path.p[:, i], second, color=colour, lw=0.9, label=f"{i + 1}")
    above.set_aspect("equal", adjustable="datalim")
    above.set_title("from above")
    side.set_title("from the side")
    for i, colour in enumerate(VEHICLES):
        error = np.linalg.norm(path.outcome.error[: len(t), i], axis=-1)
        distance.plot(t, error, color=colour, lw=0.9)
        wrong = np.linalg.norm(path.outcome.estimate_error[:, i], axis=-1)
        estimates.semilogy(t, wrong, color=colour, lw=0.8)
    distance.set_title("distance to the own slot beside the target, m")
    estimates.set_title("error of the own estimate of the target, m")
    for axis in (distance, estimates):
        axis.set_xlabel("time, s")
    legend_below(figure, above, 7)
    return Drawing(figure, *_verdict(case))


@house_style()
def stage_figure(case: int, jobs: int = 1) -> Drawing:
    """Paths in space, and vehicles beside their slots at several times."""
    path = flown(case)
    target, wanted = _target(path), _wanted(path)
    figure, axes = new_figure(1, 2, height=1.6, width=7.2)
    space = in_space(figure, axes[0, 0])
    space.plot(*raised(target), **REFERENCE, label="target")
    for i, colour in enumerate(VEHICLES):
        space.plot(*raised(path.p[:, i]), color=colour, lw=0.9, label=f"{i + 1}")
    grid = axes[0, 1].get_subplotspec().subgridspec(2, 3)
    axes[0, 1].remove()
    for place, time in enumerate(_TIMES):
        k = round(time / path.outcome.dt)
        axis = figure.add_subplot(grid[place // 3, place % 3])
        axis.plot(*target[k, :2], "*", color=COLOURS["ink"], ms=6)
        for i, colour in enumerate(VEHICLES):
            axis.plot(*path.p[k, i, :2], "o", color=colour, ms=3.5)
            axis.plot(*wanted[k, i, :2], "x", color=colour, ms=5)
        axis.set_title(f"t = {time:g} s")
        x, y, _ = wanted[k].mean(axis=0)
        axis.set_xlim(x - _REACH, x + _REACH)
        axis.set_ylim(y - _REACH, y + _REACH)
        axis.tick_params(labelsize=6)
    legend_below(figure, space, 7)
    return Drawing(figure, *_verdict(case))


@house_style()
def input_figure(case: int, jobs: int = 1) -> Drawing:
    """Rotor forces of each vehicle."""
    path = flown(case)
    t = path.outcome.dt * np.arange(len(path.forces))
    figure, axes = new_figure(3, 2, height=0.7, sharex=True, sharey=True)
    for i, axis in enumerate(axes.flat):
        for rotor, colour in enumerate(("blue", "orange", "green", "purple")):
            axis.plot(t, path.forces[:, i, rotor], color=COLOURS[colour], lw=0.6, label=f"rotor {rotor + 1}")
        for bound in (0.0, path.force_max):
            axis.axhline(bound, **LIMIT)
        axis.set_title(f"vehicle {i + 1}: rotor forces, N")
    for axis in axes[-1]:
        axis.set_xlabel("time, s")
    legend_below(figure, axes[0, 0], 4)
    inside = bool((path.forces >= -1e-9).all() and (path.forces <= path.force_max + 1e-9).all())
    at_limit = np.isclose(path.forces, 0.0, atol=1e-6) | np.isclose(path.forces, path.force_max, atol=1e-6)
    numbers: Numbers = {
        "smallest command, N": f"{path.forces.min():.2f}",
        "largest command, N": f"{path.forces.max():.2f}",
        "share of commands at a limit": dict(
            zip(of_vehicles(), [f"{share:.1%}" for share in at_limit.mean(axis=(0, 2))], strict=True)
        ),
    }
    return Drawing(figure, judge(inside), numbers)


def _three(case: int) -> list[Sketch]:
    first = 1 + 3 * case
    who = (
        "all vehicles measure, a two-way ring"
        if case == 1
        else "only vehicles 1 and 2 measure; 5 and 6 hear nobody who does"
    )
    how = (
        f"Case {case} ({who}; our reading, the graphs of the two cases are pictures). Target in a turn at "
        "0.8 m/s, P_f = 0.1, EKF, extrapolated neighbours, 25 s."
    )
    said = "The vehicles keep the formation beside the target they estimate."
    if case == 2:
        said = "Vehicles without contact to the target stay close when connected to one that has it."
    claims = ("7-trust", "7-contact") if case == 2 else ("7-trust",)
    return [
        Sketch(f"7.{first}", f"case {case}: planes", said, how, partial(plane_figure, case), claims),
        Sketch(
            f"7.{first + 1}", f"case {case}: space and references", said,
            f"{how} Dots are vehicles, crosses their true slots beside the target (star).",
            partial(stage_figure, case), claims,
        ),
        Sketch(
            f"7.{first + 2}", f"case {case}: inputs", "The inputs of each vehicle, within their limits.",
            f"{how} Dotted red are the limits.", partial(input_figure, case),
        ),
    ]  # fmt: skip


SKETCHES = [*_three(1), *_three(2)]
