"""Draws docs/airframes.svg: rotor order, spin and arms of both frames, from the parameters themselves.

    python docs/airframes.py

MkDocs does not read this file; a test holds the picture to what it draws.
"""

from __future__ import annotations

import math
from pathlib import Path

from quad_envs.parameters import FRAMES, QuadrotorParams

OUT = Path(__file__).with_suffix(".svg")
_ARM, _ROTOR = 100.0, 46.0  # pixels
_WIDTH, _HEIGHT, _MIDDLE = 420, 400, 205.0
_CLOCKWISE, _COUNTER, _INK, _PALE = "#2b6cb0", "#c05621", "#1a202c", "#a0aec0"


def _arc(x: float, y: float, radius: float, clockwise: bool) -> str:
    """Three quarters of a circle with a head that shows which way a rotor turns, seen from above."""
    start, sweep = math.radians(-45.0), math.radians(250.0) * (1.0 if clockwise else -1.0)
    x0, y0 = x + radius * math.cos(start), y + radius * math.sin(start)
    x1, y1 = x + radius * math.cos(start + sweep), y + radius * math.sin(start + sweep)
    colour = _CLOCKWISE if clockwise else _COUNTER
    along = start + sweep + (1.0 if clockwise else -1.0) * math.pi / 2.0
    head = " ".join(
        f"{x1 + size * math.cos(along + turn):.1f},{y1 + size * math.sin(along + turn):.1f}"
        for size, turn in ((11.0, 0.0), (7.0, 2.3), (7.0, -2.3))
    )
    return (
        f'<path d="M {x0:.1f} {y0:.1f} A {radius:g} {radius:g} 0 1 {int(clockwise)} {x1:.1f} {y1:.1f}" '
        f'fill="none" stroke="{colour}" stroke-width="3"/><polygon points="{head}" fill="{colour}"/>'
    )


def _text(x: float, y: float, words: str, size: int = 14, weight: str = "normal", colour: str = _INK) -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" font-weight="{weight}" fill="{colour}" '
        f'text-anchor="middle">{words}</text>'
    )


def _line(x0: float, y0: float, x1: float, y1: float, colour: str, width: float) -> str:
    return (
        f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="{colour}" '
        f'stroke-width="{width:g}"/>'
    )


def _axis(x: float, y: float, dx: float, dy: float, name: str) -> str:
    """A body axis from the centre, with its name at the head."""
    tip_x, tip_y, back = x + dx, y + dy, 10.0 / math.hypot(dx, dy)
    left = f"{tip_x - back * dx - 0.5 * back * dy:.1f},{tip_y - back * dy + 0.5 * back * dx:.1f}"
    right = f"{tip_x - back * dx + 0.5 * back * dy:.1f},{tip_y - back * dy - 0.5 * back * dx:.1f}"
    return (
        _line(x, y, tip_x, tip_y, _PALE, 2)
        + f'<polygon points="{tip_x:.1f},{tip_y:.1f} {left} {right}" fill="{_PALE}"/>'
        + _text(tip_x + 12.0 * (dx > 0.0), tip_y + 0.05 * dy + 5.0 * (dx > 0.0), name, 13)
    )


def _frame(name: str, x: float, y: float) -> list[str]:
    """One airframe seen from above; forward is up, and the y axis to the right."""
    params = QuadrotorParams(frame=name)
    places = [
        (x + _ARM * right / params.arm, y - _ARM * forward / params.arm)
        for forward, right in params.rotor_positions().tolist()
    ]
    parts = [_axis(x, y, 0.0, -168.0, "x, forward"), _axis(x, y, 168.0, 0.0, "y")]
    for i, j in ((0, 2), (1, 3)):
        parts.append(_line(*places[i], *places[j], _INK, 5))
    yaw = params.mixer()[3].tolist()
    for i, (px, py) in enumerate(places):
        clockwise = yaw[i] < 0.0  # the body is turned the other way
        parts.append(
            f'<circle cx="{px:.1f}" cy="{py:.1f}" r="{_ROTOR - 12.0:g}" fill="white" stroke="{_PALE}"/>'
        )
        parts.append(_arc(px, py, _ROTOR - 4.0, clockwise))
        parts.append(_text(px, py + 7.0, f"F{i + 1}", 20, "bold"))
    parts.append(f'<circle cx="{x:g}" cy="{y:g}" r="7" fill="{_INK}"/>')
    parts.append(_text(x, y + 190.0, f"frame = {name}", 16, "bold"))
    return parts


def drawing() -> str:
    """The picture as SVG."""
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {2 * _WIDTH} {_HEIGHT + 50}" '
        'font-family="sans-serif" role="img" aria-label="Rotor order, spin and arms of both frames">',
        f'<rect width="{2 * _WIDTH}" height="{_HEIGHT + 50}" fill="white"/>',
    ]
    for column, name in enumerate(FRAMES):
        parts += _frame(name, _WIDTH * (column + 0.5), _MIDDLE)
    for column, (words, colour) in enumerate(
        (
            ("turns clockwise: yaws the body to the left", _CLOCKWISE),
            ("turns the other way: to the right", _COUNTER),
        )
    ):
        parts.append(_text(_WIDTH * (column + 0.5), _HEIGHT + 32.0, words, 14, "normal", colour))
    return "\n".join([*parts, "</svg>", ""])


if __name__ == "__main__":
    OUT.write_text(drawing(), encoding="utf-8")
    print(OUT)
