"""Pictures of flights: a Scene becomes an RGB array. Pillow is loaded with the first picture, not before."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..constraints import TOLERANCE
from ..parameters import POSITION, Array
from .canvas import (
    BLUE,
    FAINT,
    FRAME,
    GREEN,
    GRID,
    GROUND,
    INK,
    ORANGE,
    OVERSAMPLING,
    PAPER,
    RED,
    SHADE,
    Canvas,
    mix,
)
from .drawing import (
    DETAILED,
    SPAN,
    draw_links,
    draw_shadows,
    draw_target,
    draw_trails,
    draw_vehicles,
    magnification,
)
from .scenes import Scene, box_corners, depth, project

Frame = NDArray[np.uint8]

_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4)]  # of a box
_DOWN: Array = np.array([0.0, 0.0, 1.0])
_RIM: Array = np.stack([np.cos(a := np.linspace(0.0, 2.0 * math.pi, 60)), np.sin(a)], axis=1)


def render(scene: Scene, width: int, height: int) -> Frame:
    """The picture of a scene.

    Args:
        scene: What to show.
        width: Pixels.
        height: Pixels.

    Returns:
        (height, width, 3) uint8.
    """
    letter = max(10, round(min(height / 34.0, width / 45.0)))  # size of the text, pixels
    glyph = 0.6 * SPAN * height
    canvas = Canvas(
        width, height, scene.view, np.array([glyph, 2.0 * letter + glyph, glyph, 3.0 * letter + glyph])
    )
    magnified = magnification(scene, canvas)
    _draw_ground(scene, canvas)
    _draw_overview(scene, canvas)
    _draw_box(scene, canvas)
    draw_shadows(scene, canvas, magnified)
    _draw_reference(scene, canvas)
    draw_trails(scene, canvas)
    draw_links(scene, canvas)
    draw_target(scene, canvas, letter)
    draw_vehicles(scene, canvas, magnified, letter)
    _write(scene, canvas, letter, magnified)
    return canvas.finish()


def _draw_ground(scene: Scene, canvas: Canvas) -> None:
    """A disc of the grid below what is wanted; lines end on its rim, so that none appears at once."""
    x, y, z, radius = scene.ground
    cell = next(size for size in (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, radius) if radius / size < 9.0)
    canvas.polygon(canvas.flat(_at_height(np.array([x, y]) + radius * _RIM, z)), GROUND)
    for axis, middle in ((0, x), (1, y)):
        lines = np.arange(math.ceil((middle - radius) / cell), math.floor((middle + radius) / cell) + 1)
        places = cell * lines
        chord = np.sqrt(np.maximum(radius**2 - (places - middle) ** 2, 0.0))
        ends = np.zeros((places.size, 2, 2))
        ends[:, :, axis] = places[:, None]
        ends[:, :, 1 - axis] = (y, x)[axis] + chord[:, None] * (-1.0, 1.0)
        for flat in canvas.pixels(_at_height(ends, z)).reshape(-1, 4).tolist():
            canvas.line(flat, GRID)


def _at_height(xy: Array, z: float) -> Array:
    """Positions at one z, (..., 2) to (..., 3)."""
    return np.concatenate([xy, np.full((*xy.shape[:-1], 1), z)], axis=-1)


def _draw_box(scene: Scene, canvas: Canvas) -> None:
    """Edges of the position limits; those of a face that a vehicle is beyond are red."""
    if not scene.box.size:
        return
    x, y, z, radius = scene.ground
    far = np.array([x, y, z]) + 10.0 * radius * np.array([[-1.0], [1.0]])
    corners = box_corners(np.where(np.isfinite(scene.box), scene.box, far))
    pixels, behind = canvas.pixels(corners).tolist(), int(depth(corners).argmax())
    p = scene.plants[:, POSITION]
    low, high = scene.box[0] - TOLERANCE, scene.box[1] + TOLERANCE
    beyond = np.stack([(p < low).any(axis=0), (p > high).any(axis=0)])
    red = [edge for edge in _EDGES if _on_face(edge, beyond)]
    for a, b in sorted(_EDGES, key=lambda edge: edge in red):
        colour = RED if (a, b) in red else SHADE if behind in (a, b) else FRAME
        canvas.line([*pixels[a], *pixels[b]], colour, 6 if (a, b) in red else 3)


def _on_face(edge: tuple[int, int], faces: NDArray[np.bool_]) -> bool:
    """Whether an edge of a box belongs to one of the faces (lower or upper, axis)."""
    same = [axis for axis in range(3) if not (edge[0] ^ edge[1]) & (4 >> axis)]
    return any(faces[int(edge[0] & (4 >> axis) > 0), axis] for axis in same)


def _draw_reference(scene: Scene, canvas: Canvas) -> None:
    """The way so far as a thin line, the way ahead dashed, and a cross where each vehicle should be."""
    canvas.path(scene.behind, mix(GREEN, PAPER, 0.6), 3)
    canvas.dashes(scene.ahead, GREEN, 3)
    few = len(scene.slots) <= DETAILED
    size = 7 if few else 4
    if few and len(scene.slots) == len(scene.plants):
        for p, slot in zip(scene.plants[:, POSITION], scene.slots, strict=True):
            canvas.path(np.stack([p, slot]), mix(GREEN, PAPER, 0.5))
    for x, y in canvas.pixels(scene.slots).tolist():
        canvas.line([x - size, y, x + size, y], GREEN, 3)
        canvas.line([x, y - size, x, y + size], GREEN, 3)


def _draw_overview(scene: Scene, canvas: Canvas) -> None:
    """The whole reference in the corner, where the picture shows only a part of it."""
    if len(scene.overview) < 2:
        return
    side = 0.26 * min(canvas.width, canvas.height) * OVERSAMPLING
    edge = 0.02 * min(canvas.width, canvas.height) * OVERSAMPLING
    right, bottom = OVERSAMPLING * canvas.width - edge, OVERSAMPLING * canvas.height - edge
    canvas.draw.rectangle((right - side, bottom - side, right, bottom), fill=PAPER, outline=SHADE, width=2)
    here = scene.behind[-1:] if len(scene.behind) else scene.ahead[:1]
    uv = project(np.concatenate([scene.overview, here]))
    low, high = uv.min(axis=0), uv.max(axis=0)
    scale = 0.8 * side / max(float((high - low).max()), 1e-6)
    pixels = (uv - 0.5 * (low + high)) * (scale, -scale) + (right - 0.5 * side, bottom - 0.5 * side)
    canvas.line(pixels[:-1].ravel().tolist(), GREEN, 3)
    x, y = pixels[-1].tolist()
    canvas.dot(x, y, 7.0, ORANGE if scene.leader >= 0 else BLUE)


def _write(scene: Scene, canvas: Canvas, letter: int, magnified: float) -> None:
    """Title, time and score above, left, limits on the right; axes and scale below."""
    margin, step = 0.7 * letter, 1.35 * letter
    canvas.text(margin, margin, scene.title, round(1.15 * letter), INK)
    canvas.text(margin, margin + 1.5 * letter, "    ".join(scene.lines), letter, INK)
    canvas.text(margin, margin + 1.5 * letter + step, scene.ended, letter, RED)
    for row, (what, violated) in enumerate(scene.limits):
        y = margin + row * step
        canvas.text(canvas.width - margin, y, what, letter, RED if violated else FAINT, "ra")
        if violated:
            mark = OVERSAMPLING * (canvas.width - 0.45 * margin)
            canvas.line([mark, OVERSAMPLING * y, mark, OVERSAMPLING * (y + letter)], RED, 6)
    _draw_axes(scene, canvas, letter, magnified)


def _draw_axes(scene: Scene, canvas: Canvas, letter: int, magnified: float) -> None:
    """Directions of x, y and up, and a bar of a round length."""
    x0, y0 = 2.4 * letter, canvas.height - 3.2 * letter
    for axis, name in ((np.array([1.0, 0.0, 0.0]), "x"), (np.array([0.0, 1.0, 0.0]), "y"), (-_DOWN, "up")):
        u, v = (2.1 * letter * project(axis)).tolist()
        start = [OVERSAMPLING * x0, OVERSAMPLING * y0]
        canvas.line([*start, OVERSAMPLING * (x0 + u), OVERSAMPLING * (y0 - v)], FAINT, 3)
        canvas.text(x0 + 1.35 * u, y0 - 1.3 * v, name, round(0.85 * letter), FAINT, "mm")
    per_metre = canvas.scale / OVERSAMPLING
    length = next((s for s in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0) if s * per_metre > 3 * letter), 50.0)
    x1, y1 = 6.0 * letter, canvas.height - 1.1 * letter
    ends = [OVERSAMPLING * v for v in (x1, y1, x1 + length * per_metre, y1)]
    canvas.line(ends, FAINT, 4)
    note = f"{length:g} m" + (f", vehicles drawn x{magnified:.1f}" if magnified > 1.05 else "")
    canvas.text(x1, y1 - 0.3 * letter, note, round(0.85 * letter), FAINT, "ls")
