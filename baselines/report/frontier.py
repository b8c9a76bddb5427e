"""The frontier: score against quadratic cost, the family of an MPC as lines, every contender as a point.

One drawing for the page and for files: colours are those of the page's style, by their names.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from html import escape
from importlib import resources
from typing import NamedTuple

import numpy as np

from .answer import rounded
from .model import Frontier

_WIDTH, _HEIGHT = 900.0, 440.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 56.0, 20.0, 14.0, 46.0  # margins
_LINE, _NAME = 15.0, 170.0  # px, between two names, and the room of one
_COLOURS = 8  # that the page's style names
_FAR = 2.0  # spans of the family's scores below it, and
_DEAR = 2.5  # times its largest cost, beyond which a contender is not drawn


class Spread(NamedTuple):
    """A number and the ends of its interval, nan where there is none."""

    value: float
    low: float
    high: float

    @property
    def half(self) -> float:
        """Half its width."""
        return 0.5 * (self.high - self.low)

    @property
    def ends(self) -> tuple[float, float]:
        """Of what is drawn."""
        return (self.low, self.high) if math.isfinite(self.half) else (self.value, self.value)


class Point(NamedTuple):
    """A contender in the plane of score and quadratic cost."""

    name: str
    trace: str  # line on which it lies, "" for none
    colour: int  # number of its colour
    score: Spread
    cost: Spread

    @property
    def known(self) -> bool:
        """Whether it has a place: a policy that crashed has no honest cost."""
        return math.isfinite(self.score.value) and self.cost.value > 0.0


class _Plane(NamedTuple):
    """Axes; that of the cost is logarithmic."""

    scores: tuple[float, float]
    costs: tuple[float, float]

    def x(self, cost: float) -> float:
        low, high = map(math.log, self.costs)
        return _LEFT + (_WIDTH - _LEFT - _RIGHT) * (math.log(cost) - low) / (high - low)

    def y(self, score: float) -> float:
        low, high = self.scores
        return _TOP + (_HEIGHT - _TOP - _BOTTOM) * (1.0 - (score - low) / (high - low))


def draw_frontier(points: Sequence[Point]) -> Frontier:
    """Draw contenders and the family; nothing where there is no family.

    Args:
        points: Those on a trace are the family.
    """
    family = [point for point in points if point.trace and point.known]
    if len(family) < 2:
        return Frontier()
    scores = [point.score.value for point in family]
    floor = min(scores) - _FAR * (max(scores) - min(scores) + 0.02)
    dearest = _DEAR * max(point.cost.value for point in family)
    others = [point for point in points if not point.trace]
    near = [one for one in others if one.known and one.score.value > floor and one.cost.value < dearest]
    plane = _plane([*family, *near])
    parts = [*_axes(plane), *_traces(plane, family), *_contenders(plane, near)]
    away = [point.name for point in others if point not in near]
    note = f"Not in the picture, since they crash or lie far off: {', '.join(away)}." if away else ""
    label = "Score against quadratic cost"
    svg = (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="frontier" viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" '
        f'role="img" aria-label="{label}">{"".join(parts)}</svg>'
    )
    return Frontier(svg, note)


def as_file(svg: str) -> str:
    """A picture that stands by itself, in light colours, with what it needs of the page's style."""
    style = resources.files("baselines.report").joinpath("page", "style.css").read_text("utf-8")
    rules = re.findall(r"^:root \{.*?\n\}", style, re.DOTALL | re.MULTILINE)[:1]
    rules += re.findall(r"^\.frontier[^\n]*", style, re.MULTILINE)
    head, body = svg.split(">", 1)
    paper = f'<rect width="{_WIDTH:g}" height="{_HEIGHT:g}" fill="#ffffff"/>'
    return f"{head}><style>{escape(' '.join(rules), quote=False)}</style>{paper}{body}\n"


def _plane(points: Sequence[Point]) -> _Plane:
    """Axes that hold all of these, with a margin."""

    def span(values: Sequence[float]) -> tuple[float, float]:
        low, high = min(values), max(values)
        margin = 0.05 * (high - low) or 0.05
        return low - margin, high + margin

    scores = span([end for point in points for end in point.score.ends])
    low, high = span([math.log(end) for point in points for end in point.cost.ends if end > 0.0])
    return _Plane(scores, (math.exp(low), math.exp(high)))


def _ticks(low: float, high: float, wanted: int) -> list[float]:
    """Round numbers over a range."""
    raw = (high - low) / wanted
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= raw)
    return [float(tick) for tick in step * np.arange(math.ceil(low / step), math.floor(high / step) + 1)]


def _text(x: float, y: float, anchor: str, text: str, kind: str = "") -> str:
    name = f' class="{kind}"' if kind else ""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{name}>{escape(text)}</text>'


def _line(kind: str, x1: float, y1: float, x2: float, y2: float) -> str:
    return f'<line class="{kind}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'


def _axes(plane: _Plane) -> list[str]:
    right, bottom = _WIDTH - _RIGHT, _HEIGHT - _BOTTOM
    parts = []
    for score in _ticks(*plane.scores, 6):
        y = plane.y(score)
        parts += [_line("axis", _LEFT, y, right, y), _text(_LEFT - 8, y + 4, "end", f"{score:.4g}")]
    for cost in _ticks(*plane.costs, 7):
        x = plane.x(cost)
        parts += [_line("axis", x, _TOP, x, bottom), _text(x, bottom + 18, "middle", f"{cost:.4g}")]
    parts.append(_text(right, _HEIGHT - 8, "end", "quadratic cost, less is better"))
    return [*parts, _text(_LEFT, _HEIGHT - 8, "start", "\u2191 score, more is better")]


def _titled(point: Point) -> str:
    score, cost = (rounded(one.value, one.half) for one in (point.score, point.cost))
    return f"<title>{escape(point.name)}: score {score}, quadratic cost {cost}</title>"


def _traces(plane: _Plane, family: Sequence[Point]) -> list[str]:
    parts = []
    for trace in dict.fromkeys(point.trace for point in family):
        line = sorted((one for one in family if one.trace == trace), key=lambda one: one.cost.value)
        places = [(plane.x(one.cost.value), plane.y(one.score.value)) for one in line]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
        parts.append(f'<polyline class="trace" points="{path}"/>')
        parts += [
            f'<circle class="step" cx="{x:.1f}" cy="{y:.1f}" r="3">{_titled(one)}</circle>'
            for one, (x, y) in zip(line, places, strict=True)
        ]
        parts.append(_text(places[-1][0], places[-1][1] - 9, "end", trace))
    return parts


def _contenders(plane: _Plane, points: Sequence[Point]) -> list[str]:
    """Points, and their names beside them, moved down where two would stand on each other."""
    parts, taken = [], list[tuple[float, float]]()
    for point in sorted(points, key=lambda one: -one.score.value):
        x, y = plane.x(point.cost.value), plane.y(point.score.value)
        parts.append(f'<g class="own{point.colour % _COLOURS}">')
        if math.isfinite(point.cost.half):
            parts.append(_line("spread", plane.x(point.cost.low), y, plane.x(point.cost.high), y))
        if math.isfinite(point.score.half):
            parts.append(_line("spread", x, plane.y(point.score.low), x, plane.y(point.score.high)))
        dot = f'<circle class="point" cx="{x:.1f}" cy="{y:.1f}" r="5">{_titled(point)}</circle>'
        parts.append(f"{dot}</g>")
        height, beside = y - 6.0, x > 0.75 * _WIDTH
        while any(abs(u - x) < _NAME and abs(v - height) < _LINE for u, v in taken):
            height += _LINE
        taken.append((x, height))
        parts.append(
            _text(x + (-9.0 if beside else 9.0), height, "end" if beside else "start", point.name, "name")
        )
    return parts
