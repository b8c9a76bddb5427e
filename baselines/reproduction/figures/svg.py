"""Marks of a drawing as SVG: what a graph, a formation or a scheme is drawn from. Coordinates are pixels."""

from __future__ import annotations

import math
from collections.abc import Iterable
from html import escape
from typing import NamedTuple

from ...report.figures import COLOURS

_FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif"
_HEAD = 8.0  # length of an arrow's head
_COLOURS = {**COLOURS, "paper": (1.0, 1.0, 1.0)}


class Point(NamedTuple):
    """A place in a drawing; y points down."""

    x: float
    y: float

    def toward(self, other: Point, length: float) -> Point:
        """The point at this distance on the way to another one."""
        whole = math.hypot(other.x - self.x, other.y - self.y)
        share = length / whole if whole > 0.0 else 0.0
        return Point(self.x + share * (other.x - self.x), self.y + share * (other.y - self.y))


def colour(name: str) -> str:
    """A colour of the house as #rrggbb."""
    return "#" + "".join(f"{round(255.0 * part):02x}" for part in _COLOURS[name])


def document(width: float, height: float, title: str, marks: Iterable[str]) -> str:
    """The whole drawing, on white paper."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}" '
        f'viewBox="0 0 {width:.0f} {height:.0f}" font-family="{_FONT}"><title>{escape(title)}</title>'
        f'<rect width="100%" height="100%" fill="{colour("paper")}"/>\n' + "\n".join(marks) + "\n</svg>\n"
    )


def words(at: Point, text: str, size: float = 13.0, ink: str = "ink", bold: bool = False) -> str:
    """A line of text, centred at a point."""
    weight = ' font-weight="600"' if bold else ""
    return (
        f'<text x="{at.x:.1f}" y="{at.y + 0.35 * size:.1f}" font-size="{size:g}" fill="{colour(ink)}" '
        f'text-anchor="middle"{weight}>{escape(text)}</text>'
    )


def disc(at: Point, radius: float, ink: str, full: bool = True) -> str:
    """A circle, full or open."""
    fill = colour(ink if full else "paper")
    return (
        f'<circle cx="{at.x:.1f}" cy="{at.y:.1f}" r="{radius:g}" fill="{fill}" stroke="{colour(ink)}" '
        'stroke-width="1.8"/>'
    )


def star(at: Point, radius: float, ink: str) -> str:
    """A star of five rays."""
    rays = (
        (at.x + r * math.sin(0.2 * math.pi * i), at.y - r * math.cos(0.2 * math.pi * i))
        for i, r in enumerate((radius, 0.42 * radius) * 5)
    )
    return f'<polygon points="{" ".join(f"{x:.1f},{y:.1f}" for x, y in rays)}" fill="{colour(ink)}"/>'


def box(corner: Point, width: float, height: float, ink: str = "ink") -> str:
    """A rectangle with round corners."""
    return (
        f'<rect x="{corner.x:.1f}" y="{corner.y:.1f}" width="{width:.1f}" height="{height:.1f}" rx="8" '
        f'fill="{colour("paper")}" stroke="{colour(ink)}" stroke-width="1.5"/>'
    )


def head(tip: Point, behind: Point, ink: str) -> str:
    """The head of an arrow that comes from `behind`."""
    angle = math.atan2(behind.y - tip.y, behind.x - tip.x)
    wings = (
        (tip.x + _HEAD * math.cos(angle + turn), tip.y + _HEAD * math.sin(angle + turn))
        for turn in (-0.42, 0.42)
    )
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in ((tip.x, tip.y), *wings))
    return f'<polygon points="{points}" fill="{colour(ink)}"/>'


def arrow(points: list[Point], ink: str = "ink", both: bool = False, dashed: bool = False) -> str:
    """Straight pieces with a head at the end, or at both ends."""
    path = " L ".join(f"{p.x:.1f} {p.y:.1f}" for p in points)
    marks = _line(f"M {path}", ink, dashed) + head(points[-1], points[-2], ink)
    return marks + (head(points[0], points[1], ink) if both else "")


def bent_arrow(start: Point, end: Point, bend: float, ink: str = "ink", both: bool = False) -> str:
    """A curve whose middle is `bend` to the left of the straight way, seen from its start."""
    length = math.hypot(end.x - start.x, end.y - start.y)
    across = Point((end.y - start.y) / length, -(end.x - start.x) / length)
    middle = Point(
        0.5 * (start.x + end.x) + 2.0 * bend * across.x, 0.5 * (start.y + end.y) + 2.0 * bend * across.y
    )
    path = f"M {start.x:.1f} {start.y:.1f} Q {middle.x:.1f} {middle.y:.1f} {end.x:.1f} {end.y:.1f}"
    marks = _line(path, ink, False) + head(end, middle, ink)
    return marks + (head(start, middle, ink) if both else "")


def loop(at: Point, radius: float, ink: str = "ink") -> str:
    """An arrow from a disc of this radius to itself, above it."""
    reach = 2.1 * radius
    left, right = (Point(at.x + side * radius, at.y - 0.87 * radius) for side in (-0.5, 0.5))
    path = (
        f"M {left.x:.1f} {left.y:.1f} C {at.x - reach:.1f} {at.y - 1.6 * reach:.1f} "
        f"{at.x + reach:.1f} {at.y - 1.6 * reach:.1f} {right.x:.1f} {right.y:.1f}"
    )
    return _line(path, ink, False) + head(right, Point(at.x + reach, at.y - 1.6 * reach), ink)


def _line(path: str, ink: str, dashed: bool) -> str:
    dashes = ' stroke-dasharray="4 4"' if dashed else ""
    return f'<path d="{path}" fill="none" stroke="{colour(ink)}" stroke-width="1.6"{dashes}/>'
