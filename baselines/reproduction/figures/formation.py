"""Figures 5.6 to 5.13: six vehicles from a line to a triangle and to a hexagon, on weak and strong graphs."""

from __future__ import annotations

from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

from quad_envs.formations import make_formation
from quad_envs.graphs import make_graph
from quad_envs.parameters import POSITION, Array

from ...evaluation.rollout import Episode
from ...report.figures import house_style, new_figure
from ..formation_claims import CONVERGED, KEPT, MODES, formation, reduced
from ..results import NOT_REPRODUCED, Numbers
from ..team_flights import TeamFlight, TeamOutcome, outcome_of, team_episodes
from .drawing import VEHICLES, draw_plan, in_space, legend_below, raised
from .model import Drawing, Sketch, judge

_VEHICLES = 6
_MODE = "reciprocal rows"
_TIMES = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0)  # s, of the stages that are shown
_SCENARIOS = (("triangle", "weak"), ("triangle", "strong"), ("hexagon", "weak"), ("hexagon", "strong"))


class TeamPath(NamedTuple):
    """A flight of a team with its paths."""

    outcome: TeamOutcome
    p: Array  # (T+1, N, 3), m
    forces: Array  # (T, N, 4), commanded, N
    episodes: list[Episode]
    force_max: float  # N


def fly_path(flight: TeamFlight) -> TeamPath:
    """Fly one episode."""
    episodes = team_episodes(flight)
    p = np.stack([episode.states[:, POSITION] for episode in episodes], axis=1)
    forces = np.stack([episode.commands for episode in episodes], axis=1)
    return TeamPath(outcome_of(episodes), p, forces, episodes, float(episodes[0].task.force_max.max()))


@cache
def flown(shape: str, graph: str) -> TeamPath:
    """The text's consensus, with neighbours frozen over the horizon, behind a leader that hovers."""
    return fly_path(formation(shape, graph, "static", MODES[_MODE]))


@house_style()
def plane_figure(shape: str, graph: str, jobs: int = 1) -> Drawing:
    """Paths from above and from the side, and height errors against time."""
    path = flown(shape, graph)
    t = path.outcome.dt * np.arange(len(path.p))
    figure, axes = new_figure(2, 2, height=1.1)
    above, side, heights, distance = axes.flat
    for i, colour in enumerate(VEHICLES):
        marks: dict[str, Any] = {"color": colour, "lw": 1.0}
        draw_plan(above, path.p[:, i], **marks)
        draw_plan(side, path.p[:, i], "height", **marks, label=_who(i))
        for axis, second in ((above, 1), (side, 2)):
            sign = -1.0 if second == 2 else 1.0
            axis.plot(path.p[0, i, 0], sign * path.p[0, i, second], "o", color=colour, mfc="white", ms=4)
            axis.plot(path.p[-1, i, 0], sign * path.p[-1, i, second], "o", color=colour, ms=4)
        heights.plot(t, -path.outcome.error[:, i, 2], **marks)
        distance.plot(t, np.linalg.norm(path.outcome.error[:, i], axis=-1), **marks)
    above.set_title("from above: start (open) and end (full)")
    side.set_title("from the side")
    above.set_aspect("equal", adjustable="datalim")
    heights.set_title("height over the own slot, m")
    distance.set_title("distance to the slot beside the leader, m")
    for axis in (heights, distance):
        axis.set_xlabel("time, s")
    legend_below(figure, side, _VEHICLES)
    return Drawing(figure, *_verdict(shape, graph))


def _who(i: int) -> str:
    return "1, leader" if i == 0 else f"{i + 1}"


def _verdict(shape: str, graph: str) -> tuple[str, Numbers]:
    """Whether the formation closes; of a strong graph, whether it diverges less than with the weak one."""
    outcome = flown(shape, graph).outcome
    numbers: Numbers = {
        "error of the worst vehicle after 20 s, m": outcome.final,
        "settling (all within 0.1 m), s": outcome.settling,
        "smallest distance of two vehicles, m": outcome.gap,
    }
    if graph == "weak":
        return judge(outcome.final < CONVERGED, outcome.gap >= KEPT), numbers
    weak = flown(shape, "weak").outcome
    for name, each in (("weak", weak), ("strong", outcome)):
        numbers[f"{name} graph"] = {
            "largest height error, m": f"{each.height[0]:.3f}",
            "rms height error, m": f"{each.height[1]:.3f}",
            "rms error in x and y, m": f"{each.level:.3f}",
        }
    word = judge(*reduced(weak, outcome))
    return NOT_REPRODUCED if word == "FALSE" else word, numbers


@house_style()
def stage_figure(shape: str, graph: str, jobs: int = 1) -> Drawing:
    """Paths in space, and where the neighbours want each vehicle at several times."""
    path = flown(shape, graph)
    figure, axes = new_figure(1, 2, height=1.6, width=7.2)
    space = in_space(figure, axes[0, 0])
    wanted = _wanted(path.p, shape, graph)
    for i, colour in enumerate(VEHICLES):
        space.plot(*raised(path.p[:, i]), color=colour, lw=1.0, label=_who(i))
        space.plot(*raised(path.p[-1:, i]), "o", color=colour, ms=4)
    grid = axes[0, 1].get_subplotspec().subgridspec(2, 3)
    axes[0, 1].remove()
    shared: Any = None
    for place, time in enumerate(_TIMES):
        k = round(time / path.outcome.dt)
        axis = figure.add_subplot(grid[place // 3, place % 3], sharex=shared, sharey=shared)
        shared = shared or axis
        for i, colour in enumerate(VEHICLES):
            axis.plot(*np.stack([path.p[k, i], wanted[k, i]])[:, :2].T, color=colour, lw=0.7)
            axis.plot(*path.p[k, i, :2], "o", color=colour, ms=4)
            axis.plot(*wanted[k, i, :2], "x", color=colour, ms=5)
        axis.set_title(f"t = {time:g} s")
        axis.tick_params(labelleft=place % 3 == 0, labelbottom=place > 2, labelsize=6.5)
    legend_below(figure, space, _VEHICLES)
    gap = np.linalg.norm(wanted - path.p, axis=-1).max(axis=1)
    numbers: Numbers = {
        f"largest distance of a vehicle to its reference at {time:g} s, m": float(
            gap[round(time / path.outcome.dt)]
        )
        for time in (0.0, 4.0, 16.0)
    }
    return Drawing(figure, judge(bool(gap[-1] < CONVERGED), path.outcome.final < CONVERGED), numbers)


def _wanted(p: Array, shape: str, graph: str) -> Array:
    """To what (5.4) with frozen neighbours leads a follower: the mean of what those whom it hears ask for."""
    slots = make_formation(shape, _VEHICLES)
    G = make_graph(graph, shape, _VEHICLES) * ~np.eye(_VEHICLES, dtype=bool)
    heard = G.sum(axis=1)
    asked = p[:, None] + (slots[:, None] - slots[None])  # (T+1, i, j, 3)
    out = np.einsum("ij,tijc->tic", G, asked) / np.maximum(heard, 1.0)[:, None]
    out[:, 0] = p[0, 0]  # the leader's set-point
    return np.asarray(out)


def _pair(number: int, scenario: int, shape: str, graph: str) -> list[Sketch]:
    strong = graph == "strong"
    what = f"{shape}, {'strongly connected followers' if strong else 'weakly connected'}"
    said = (
        "Strongly connected followers significantly reduce divergence in z, without loss in x and y."
        if strong
        else "Starting from a straight line, the six vehicles reach the formation without collision."
    )
    how = (
        "The consensus of the text with its sum corrected, neighbours frozen over the horizon, equal "
        "weights, rows of separation that keep d_s, and a leader that hovers; how the text's leader moves "
        "is not printed."
    )
    claims = ("5-consensus", f"5-height-{shape}")
    return [
        Sketch(f"5.{number}", f"scenario {scenario}, {what}: planes", said, how,
               partial(plane_figure, shape, graph), claims),
        Sketch(
            f"5.{number + 1}", f"scenario {scenario}, {what}: space and references",
            "Trajectories in space, and the references at several stages.",
            "Left the paths, right, from above, vehicles (dots) and where those whom they hear want them "
            f"(crosses). {how}",
            partial(stage_figure, shape, graph), claims,
        ),
    ]  # fmt: skip


SKETCHES = [sketch for i, scenario in enumerate(_SCENARIOS) for sketch in _pair(6 + 2 * i, i + 1, *scenario)]
