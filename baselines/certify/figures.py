"""The figures of a certificate: the value along the flight, the eigenvalues, the ellipsoids."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from quad_envs.parameters import N_STATE, Array

from ..report.figures import COLOURS, ellipse, house_style, new_figure, save_figure
from . import _INSCRIBED, _LARGEST, Region, Report
from .flight import Trace
from .verdicts import descent

# Planes in which the ellipsoids are shown: label and index of the state on each axis.
_PLANES = (
    (("x, m", 0), ("u, m/s", 3)),
    (("x, m", 0), ("pitch, rad", 7)),
    (("z, m", 2), ("w, m/s", 5)),
    (("pitch, rad", 7), ("q, rad/s", 10)),
    (("yaw, rad", 8), ("r, rad/s", 11)),
)
_AROUND = 1.4  # axes beyond the shadow


def draw(report: Report, folder: Path) -> list[Path]:
    """Write all figures of a report as PNG and PDF.

    Raises:
        MissingPackageError: If matplotlib is not installed.
        ResultsError: If they cannot be written.
    """
    title = f"{report.policy} in {report.env}"
    paths = []
    if report.trace is not None:
        paths += save_figure(value_figure(report.trace, title), folder, "value")
        paths += save_figure(margin_figure(report, report.trace, title), folder, "margins")
    for key, (name, _) in (("ellipsoid", _INSCRIBED), ("largest-ellipsoid", _LARGEST)):
        if name in report.regions:
            figure = region_figure(report, report.regions[name], title)
            paths += save_figure(figure, folder, key)
    return paths


@house_style()
def value_figure(trace: Trace, title: str) -> Any:
    """The value function with the bound that (9.10) sets it, and how far that is missed."""
    figure, axes = new_figure(2, 1, sharex=True)
    t = trace.dt * np.arange(len(trace.value))
    bound = trace.value[:-1] - trace.stage[:-1]
    top, low = axes[0, 0], axes[1, 0]
    top.plot(t, trace.value, color=COLOURS["blue"], label="value $V_k$")
    top.plot(t[1:], bound, color=COLOURS["orange"], ls="--", label="bound $V_{k-1} - l_{k-1}$ of (9.10)")
    if (bound > 0.0).all():
        top.set_yscale("log")
    top.set_title(f"{title}: value function along the flight")
    top.set_ylabel("cost")
    _legend(top)
    found = descent(trace)
    lines = (
        ("following", "the next sample's problem", "purple", 2.2),
        ("plant", "from where the plant is", "orange", 1.2),
        ("model", "from where the model says", "blue", 1.2),
    )
    for name, label, colour, width in lines:
        low.plot(t[:-1], getattr(found, name), color=COLOURS[colour], lw=width, label=label)
    low.axhline(0.0, color=COLOURS["ink"], lw=0.6)
    finite = np.concatenate([layer[np.isfinite(layer)] for layer in found])
    decade = float(np.ceil(np.log10(max(np.abs(finite).max(initial=0.0), 1e-5))))
    low.set_yscale("symlog", linthresh=10.0 ** (decade - 4.0), linscale=0.5)
    ticks = 10.0 ** (decade - np.array([0.0, 1.0, 2.0, 3.0]))
    low.set_yticks([*-ticks, 0.0, *ticks[::-1]])
    low.minorticks_off()
    low.set_title("$V$ of what comes next $- (V_k - l_k)$; above zero the descent fails")
    low.set_ylabel("cost")
    low.set_xlabel("time, s")
    low.set_ylim(top=10.0 ** (decade + 1.5))
    low.legend(loc="upper right", ncols=3)
    return figure


@house_style()
def margin_figure(report: Report, trace: Trace, title: str) -> Any:
    """Eigenvalues of the terminal inequality, terminal limits, and where the plans end."""
    figure, axes = new_figure(3, 1, sharex=True)
    t = trace.dt * np.arange(len(trace.value))
    top, middle, low = axes[:, 0]
    for values, label, colour, style in (
        (trace.riccati_gain, "gain of the Riccati equation at $x_k$", "orange", "-"),
        (trace.decrease, "gain that suits $Q_f$ best", "blue", "-"),
        (trace.riccati_weight, "and $Q_f = P(x_k)$", "green", "--"),
    ):
        top.plot(t, values, color=COLOURS[colour], ls=style, label=label)
    if np.nanmax(trace.riccati_gain) < 1e-6:  # all equalities: show that, not the rounding
        top.set_ylim(-1.0, 1.0)
    top.axhline(0.0, color=COLOURS["ink"], lw=0.6)
    top.set_title(
        f"{title}\nlargest eigenvalue of the terminal inequality (9.6), (9.28); above zero it fails"
    )
    _legend(top)
    middle.plot(t, trace.inputs, color=COLOURS["blue"], label="rotor limits, N")
    if np.isfinite(trace.outputs).any():
        middle.plot(t, trace.outputs, color=COLOURS["purple"], label="state limits, SI")
    middle.axhline(0.0, color=COLOURS["ink"], lw=0.6)
    middle.set_title(
        "distance of the terminal law to the limits (9.17), (9.18); below zero they are exceeded"
    )
    _legend(middle)
    low.semilogy(t, np.maximum(trace.end_level, 1e-12), color=COLOURS["blue"], label="end of the plan")
    if _INSCRIBED[0] in report.regions:
        level = report.regions[_INSCRIBED[0]].ellipsoid.level
        low.axhline(level, color=COLOURS["green"], ls="--", label="invariant ellipsoid of hover")
    low.set_title("$(x_N - r_N)'Q_f(x_N - r_N)$: below the line no limit is ever met again, at hover")
    low.set_xlabel("time, s")
    _legend(low)
    return figure


@house_style()
def region_figure(report: Report, region: Region, title: str) -> Any:
    """Shadows of an ellipsoid with the limits, and tracks of random starts on the plant."""
    figure, axes = new_figure(2, 3, height=1.1)
    unit, K = np.eye(N_STATE), report.gain
    for axis, ((x_label, i), (y_label, j)) in zip(axes.flat, _PLANES, strict=False):
        _shadow(axis, report, region, unit[i], unit[j])
        axis.set_xlabel(x_label)
        axis.set_ylabel(y_label)
    axis = axes.flat[-1]
    _shadow(axis, report, region, -K[0], -K[2])
    axis.set_xlabel("rotor 1 of the law, N")
    axis.set_ylabel("rotor 3 of the law, N")
    fraction = region.plant[-1].fraction
    text = f"{title}: shadow of the invariant ellipsoid (blue), limits (red)\nflights of the plant: "
    if fraction == 1.0:
        text += "grey, from the dots"
    else:
        end = "all keep the limits" if region.plant[-1].safe else "some still exceed a limit"
        text += f"orange from all of it; grey from {fraction:g} of its radius (dotted): {end}"
    figure.suptitle(text, fontsize=8.5, x=0.01, ha="left")
    return figure


def _legend(axis: Any) -> None:
    """A legend in one line above the curves."""
    low, high = axis.get_ylim()
    logarithmic = axis.get_yscale() == "log"
    axis.set_ylim(top=high * (high / low) ** 0.25 if logarithmic else high + 0.25 * (high - low))
    axis.legend(loc="upper right", ncols=3)


def _shadow(axis: Any, report: Report, region: Region, first: Array, second: Array) -> None:
    """The ellipsoid's shadow in one plane, the limits that are lines in it, and flights of the plant."""
    x, y = ellipse(region.ellipsoid.projection(first, second))
    axis.fill(x, y, color=COLOURS["blue"], alpha=0.12, lw=0)
    axis.plot(x, y, color=COLOURS["blue"])
    axis.set_xlim(-_AROUND * x.max(), _AROUND * x.max())
    axis.set_ylim(-_AROUND * y.max(), _AROUND * y.max())
    for normal, bound in zip(report.limits.normals, report.limits.bounds, strict=True):
        for direction, line in ((first, axis.axvline), (second, axis.axhline)):
            if np.allclose(np.abs(normal), np.abs(direction)):
                line(bound, color=COLOURS["red"], lw=0.8)
                line(-bound, color=COLOURS["red"], lw=0.8)
    whole, last = region.plant[0], region.plant[-1]
    if last.fraction < 1.0:
        axis.plot(last.fraction * x, last.fraction * y, color=COLOURS["blue"], ls=":")
        axis.plot((whole.tracks @ first).T, (whole.tracks @ second).T, color=COLOURS["orange"], lw=0.5)
    flat, high = last.tracks @ first, last.tracks @ second
    axis.plot(flat.T, high.T, color=COLOURS["slate"], lw=0.5)
    axis.plot(flat[:, 0], high[:, 0], ".", color=COLOURS["ink"], ms=3)
