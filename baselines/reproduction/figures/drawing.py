"""Marks that the figures of several chapters share. Height is up in them: z points down in the equations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from quad_envs.parameters import Array

from ...report.figures import COLOURS

# Of vehicles 1 to 6; the leader, or the first, is ink.
VEHICLES = tuple(COLOURS[name] for name in ("ink", "blue", "orange", "green", "purple", "slate"))
LINEAR, NONLINEAR, BETTER = COLOURS["blue"], COLOURS["orange"], COLOURS["green"]
REFERENCE: dict[str, Any] = {"color": COLOURS["ink"], "ls": "--", "lw": 0.9}
LIMIT: dict[str, Any] = {"color": COLOURS["red"], "lw": 0.8, "ls": ":"}


def in_space(figure: Any, axis: Any) -> Any:
    """Axes with three dimensions in place of flat ones."""
    spec = axis.get_subplotspec()
    axis.remove()
    space = figure.add_subplot(spec, projection="3d")
    for direction in (space.xaxis, space.yaxis, space.zaxis):
        direction.set_pane_color((1.0, 1.0, 1.0, 0.0))
        direction.set_tick_params(labelsize=6.5, pad=-1)
        direction.labelpad = -4
        direction.get_major_locator().set_params(nbins=4)
    space.set_box_aspect(None, zoom=1.12)
    space.set_xlabel("x, m")
    space.set_ylabel("y, m")
    space.set_title("in space; up is height, m")
    return space


def times(steps: int, dt: float = 0.05) -> Array:
    """Of so many samples, s."""
    return np.asarray(dt * np.arange(steps), dtype=np.float64)


def raised(p: Array) -> tuple[Array, Array, Array]:
    """x, y and height of positions (..., 3)."""
    return p[..., 0], p[..., 1], -p[..., 2]


def draw_plan(axis: Any, p: Array, second: str = "y", **marks: Any) -> None:
    """Positions seen from above (second = "y") or from the side ("height")."""
    x, y, height = raised(p)
    axis.plot(x, y if second == "y" else height, **marks)
    axis.set_xlabel("x, m")
    axis.set_ylabel(f"{second}, m")


def draw_forces(axis: Any, t: Array, F: Array, force_max: float, title: str) -> None:
    """The four rotor forces of a vehicle with their limits, N."""
    for i, colour in enumerate(("blue", "orange", "green", "purple")):
        axis.plot(t, F[:, i], color=COLOURS[colour], lw=0.8, drawstyle="steps-post", label=f"rotor {i + 1}")
    for bound in (0.0, force_max):
        axis.axhline(bound, **LIMIT)
    axis.set_ylim(-0.06 * force_max, 1.06 * force_max)
    axis.set_title(title)
    axis.set_ylabel("force, N")


def legend_below(figure: Any, axis: Any, columns: int) -> None:
    """One legend for all axes, of what the given one shows, under the figure."""
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=columns)


def grouped_bars(
    axis: Any, groups: Sequence[str], values: Mapping[str, Array], colours: Sequence[Any]
) -> None:
    """Bars side by side: what each name of `values` has in each group; nan is told as lost."""
    width = 0.8 / len(values)
    for i, ((name, heights), colour) in enumerate(zip(values.items(), colours, strict=False)):
        x = np.arange(len(groups)) + (i - (len(values) - 1) / 2) * width
        axis.bar(x, heights, width, color=colour, label=name)
        for place, height in zip(x, heights, strict=True):
            if not np.isfinite(height):
                axis.annotate("lost", (place, 0.0), (0, 2), textcoords="offset points", ha="center",
                              color=COLOURS["red"], fontsize=7, rotation=90)  # fmt: skip
    axis.set_xticks(np.arange(len(groups)), groups)
    axis.grid(axis="x", visible=False)
