"""Vehicles and what belongs to them in a picture: shadows, trails, links, the target, the crosses."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..parameters import ATTITUDE, FORCES, POSITION, Array
from ..rotations import rotation_body_from_inertial
from .canvas import (
    BLUE,
    CIRCLE,
    FRAME,
    INK,
    ORANGE,
    OVERSAMPLING,
    PAPER,
    PURPLE,
    RED,
    SHADE,
    SLATE,
    Canvas,
    Colour,
    Flat,
    mix,
)
from .scenes import Scene, depth, project

SPAN = 0.09  # of the picture's height; a vehicle that would be smaller is drawn larger than it is
_MOST_MAGNIFIED = 8.0
_ROTOR = 0.62  # radius of a rotor disc, relative to the arm
_NUMBERED = 12  # vehicles up to which each shows its number
DETAILED = 24  # and up to which each shows its rotor forces and a drop line with a scale


def magnification(scene: Scene, canvas: Canvas) -> float:
    """How much larger than life vehicles are drawn: to be seen, yet apart where they should be."""
    span = 2.0 * (1.0 + _ROTOR) * scene.arm
    wished = OVERSAMPLING * SPAN * canvas.height / (span * canvas.scale)
    if len(scene.slots) > 1:
        uv = project(scene.slots)
        apart = np.hypot(*(uv[:, None] - uv[None]).transpose(2, 0, 1))
        np.fill_diagonal(apart, np.inf)
        wished = min(wished, 1.1 * float(np.median(apart.min(axis=1))) / span)
    return min(max(wished, 1.0), _MOST_MAGNIFIED)


def draw_shadows(scene: Scene, canvas: Canvas, magnified: float) -> None:
    """On the ground below each vehicle and the target: a shadow, and a line up to it with a mark each m."""
    floor = scene.ground[2]
    flying = scene.plants[:, POSITION]
    points = np.concatenate([flying, scene.target[-1:]])
    feet = points.copy()
    feet[:, 2] = floor
    spot = 0.8 * magnified * scene.arm * CIRCLE
    spots = np.concatenate([feet[:, None, :2] + spot, np.full((len(feet), len(CIRCLE), 1), floor)], axis=2)
    for flat in canvas.pixels(spots).reshape(len(feet), 2 * len(CIRCLE)).tolist():
        canvas.polygon(flat, SHADE)
    if len(flying) > DETAILED:
        return
    for point, foot in zip(points.tolist(), feet.tolist(), strict=True):
        top, bottom = canvas.pixels(np.array([point, foot])).tolist()
        canvas.line([*top, *bottom], SHADE, 3)
        low, high = sorted((point[2], floor))
        heights = np.arange(math.ceil(low), math.ceil(high))[:60]
        for v in np.interp(heights, [low, high], sorted((top[1], bottom[1]))).tolist():
            canvas.line([top[0] - 5, v, top[0] + 5, v], FRAME)


def draw_trails(scene: Scene, canvas: Canvas) -> None:
    """Where the vehicles and the target have been, fading with age; crosses where vehicles crashed."""
    _fading(canvas, scene.target[:, None], [PURPLE])
    colours = [ORANGE if i == scene.leader else BLUE for i in range(len(scene.plants))]
    _fading(canvas, scene.trails, colours)
    for x, y in canvas.pixels(scene.wrecks).tolist():
        canvas.line([x - 10, y - 10, x + 10, y + 10], RED, 5)
        canvas.line([x - 10, y + 10, x + 10, y - 10], RED, 5)


def _fading(canvas: Canvas, trails: Array, colours: list[Colour]) -> None:
    """Trails (m, n, 3) in pieces, the older the paler; with many vehicles only the youngest pieces."""
    m = len(trails)
    if m < 2:
        return
    pieces = 4 if len(colours) <= DETAILED else 2
    cuts = np.linspace(0, m - 1, pieces + 1).astype(int)
    pixels = canvas.pixels(trails).transpose(1, 0, 2)
    for piece in range(pieces):
        pale = 0.8 - 0.6 * (piece + 1) / pieces
        for track, colour in zip(pixels[:, cuts[piece] : cuts[piece + 1] + 1], colours, strict=True):
            canvas.line(track.ravel().tolist(), mix(colour, PAPER, pale), 3)


def draw_links(scene: Scene, canvas: Canvas) -> None:
    """Who hears whom: the thicker the heavier, the paler the older; an arrow where nobody answers."""
    pixels = canvas.pixels(scene.plants[:, POSITION]).tolist()
    pairs = {(i, j) for i, j in scene.links.tolist()}
    for (i, j), (weight, fresh) in zip(scene.links.tolist(), scene.strength.tolist(), strict=True):
        answered = (j, i) in pairs
        if answered and j < i:
            continue
        (x, y), (from_x, from_y) = pixels[i], pixels[j]
        colour = mix(SLATE, PAPER, 0.75 * (1.0 - fresh))
        canvas.line([from_x, from_y, x, y], colour, 2 + round(3.0 * weight))
        length = math.hypot(x - from_x, y - from_y)
        if not answered and length > 24.0:
            a, b = (x - from_x) / length, (y - from_y) / length
            tip_x, tip_y = from_x + 0.6 * (x - from_x), from_y + 0.6 * (y - from_y)
            back_x, back_y = tip_x - 14.0 * a, tip_y - 14.0 * b
            wing = [back_x - 7.0 * b, back_y + 7.0 * a, back_x + 7.0 * b, back_y - 7.0 * a]
            canvas.polygon([tip_x, tip_y, *wing], mix(colour, INK, 0.25))


def draw_target(scene: Scene, canvas: Canvas, letter: int) -> None:
    """The target as a diamond, and lines of sight of those that measure it."""
    if not len(scene.target):
        return
    here = scene.target[-1]
    for p in scene.plants[scene.sights, POSITION]:
        canvas.dashes(np.stack([p, here]), mix(PURPLE, PAPER, 0.55), 2, 3.0)
    ((x, y),) = canvas.pixels(here[None]).tolist()
    for believed_x, believed_y in canvas.pixels(scene.estimates).tolist():
        canvas.line([believed_x, believed_y, x, y], mix(PURPLE, PAPER, 0.3), 3)
        canvas.ring(believed_x, believed_y, 0.55 * letter, BLUE, 4)
    size = 1.1 * letter
    canvas.polygon([x, y - size, x + size, y, x, y + size, x - size, y], PURPLE, INK)
    canvas.polygon([x, y - size, x + size, y, x - size, y], mix(PURPLE, PAPER, 0.4))
    canvas.text(x / 2 + 0.7 * letter, y / 2 - 0.2 * letter, "target", letter, PURPLE, "ls")


def draw_vehicles(scene: Scene, canvas: Canvas, magnified: float, letter: int) -> None:
    """Crosses with rotor discs, the farthest first."""
    plants = scene.plants
    if not len(plants):
        return
    parts = _vehicle_pixels(scene, canvas, magnified)
    for i in np.argsort(-depth(plants[:, POSITION])).tolist():
        colour = ORANGE if i == scene.leader else BLUE
        _draw_vehicle(parts, i, colour, bool(scene.violated[i]), len(plants) <= DETAILED, canvas)
        x, y = parts.centres[i]
        if scene.crowded[i]:
            canvas.ring(x, y, 0.5 * scene.separation * canvas.scale + 4.0, RED)
        if 1 < len(plants) <= _NUMBERED:
            what = f"{scene.numbers[i]}" + (" leader" if i == scene.leader else "")
            ink = RED if scene.violated[i] else INK
            aside = 0.5 * parts.reach / OVERSAMPLING
            canvas.text(x / OVERSAMPLING + aside, y / OVERSAMPLING + aside, what, letter, ink, "lt")


class _VehiclePixels(NamedTuple):
    """Canvas pixels of n vehicles."""

    centres: list[list[float]]  # (n, 2)
    hubs: list[list[list[float]]]  # (n, 4, 2)
    tops: list[list[list[float]]]  # (n, 4, 2), ends of the force bars
    discs: list[list[Flat]]  # (n, 4, 2 corners)
    saturated: list[list[bool]]  # (n, 4)
    stroke: int  # width of an arm
    reach: float  # radius of a vehicle


def _vehicle_pixels(scene: Scene, canvas: Canvas, magnified: float) -> _VehiclePixels:
    """Where the parts of all vehicles lie."""
    plants, n, arm = scene.plants, len(scene.plants), magnified * scene.arm
    p, R_BI = plants[:, POSITION], rotation_body_from_inertial(plants[:, ATTITUDE])
    arms = np.concatenate([scene.arms, np.zeros((len(scene.arms), 1))], axis=1)
    disc = np.concatenate([CIRCLE, np.zeros((len(CIRCLE), 1))], axis=1)
    forces = plants[:, FORCES] / scene.forces[0]
    bars = arm * (arms + forces[..., None] * (0.0, 0.0, -1.0))  # thrust points up, -z of the body
    discs = arm * (arms[:, None] + _ROTOR * disc).reshape(-1, 3)
    body = np.concatenate([np.broadcast_to(arm * arms, (n, 4, 3)), bars, np.tile(discs, (n, 1, 1))], axis=1)
    pixels = canvas.pixels(p[:, None] + body @ R_BI)  # row vectors, so that R_BI leads back to inertial axes
    reach = (1.0 + _ROTOR) * arm * canvas.scale
    return _VehiclePixels(
        canvas.pixels(p).tolist(),
        pixels[:, :4].tolist(),
        pixels[:, 4:8].tolist(),
        pixels[:, 8:].reshape(n, 4, -1).tolist(),
        (plants[:, FORCES] > 0.995 * scene.forces[1]).tolist(),
        min(max(round(0.06 * reach), 3), 9),
        reach,
    )


def _draw_vehicle(
    parts: _VehiclePixels, i: int, colour: Colour, violated: bool, detailed: bool, canvas: Canvas
) -> None:
    """One vehicle: the first arm leads forward and has the filled disc; bars are as long as the forces."""
    hubs, (x, y) = parts.hubs[i], parts.centres[i]
    rim = RED if violated else mix(colour, INK, 0.35)
    pale, width = mix(colour, PAPER, 0.72), parts.stroke
    for rotor in (3, 1, 2, 0):
        fill = colour if rotor == 0 else pale
        canvas.polygon(parts.discs[i][rotor], fill, rim, (width if violated else max(2, width - 3)))
    canvas.line([*hubs[2], *hubs[0]], INK, width)
    canvas.line([*hubs[1], *hubs[3]], INK, width)
    canvas.dot(x, y, 1.3 * width, RED if violated else INK)
    if detailed:
        for rotor in range(4):
            top = parts.tops[i][rotor]
            canvas.line([*hubs[rotor], *top], ORANGE if parts.saturated[i][rotor] else INK, max(3, width - 2))
