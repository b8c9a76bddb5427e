"""Marks of a picture: lines, dashes, rotor discs, text, on a Pillow canvas twice as large as the picture.

Pillow draws without smoothing; halving the canvas smooths everything but the text, which is smooth already
and comes last.
"""

from __future__ import annotations

import functools
import math
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..compilation.decorators import kernel
from ..parameters import Array
from .scenes import project

Colour = tuple[int, int, int]
Floats = NDArray[np.float32]
Words = NDArray[np.uint32]
Flat = list[float]  # x, y, x, y, ... in canvas pixels

# Okabe and Ito's colours, which stay apart for colour-blind eyes; red is for violations alone.
PAPER: Colour = (252, 252, 250)
GROUND: Colour = (243, 244, 246)
GRID: Colour = (222, 226, 231)
SHADE: Colour = (203, 208, 214)
FRAME: Colour = (158, 166, 176)
INK: Colour = (38, 42, 48)
FAINT: Colour = (112, 119, 128)
BLUE: Colour = (0, 114, 178)
ORANGE: Colour = (230, 149, 0)
GREEN: Colour = (0, 145, 106)
PURPLE: Colour = (168, 60, 130)
SLATE: Colour = (104, 112, 126)
RED: Colour = (214, 16, 24)

OVERSAMPLING = 2
_MOST_DASHES = 200  # of a line
_ROUND = 14  # corners of a rotor disc
_TURN: Array = np.linspace(0.0, 2.0 * math.pi, _ROUND, endpoint=False)
CIRCLE: Array = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=1)


@functools.lru_cache(maxsize=512)
def mix(colour: Colour, other: Colour, share: float) -> Colour:
    """The colour with a share of another one."""
    r, g, b = (round(c + share * (o - c)) for c, o in zip(colour, other, strict=True))
    return r, g, b


class _Memory(threading.local):
    """Pixels of the last canvas of this thread: new memory of this size costs more than the drawing."""

    def __init__(self) -> None:
        self._pixels = np.empty((0, 0, 4), dtype=np.uint8)

    def pixels(self, width: int, height: int) -> NDArray[np.uint8]:
        """(height, width, 4), with what was drawn before."""
        if self._pixels.shape[:2] != (height, width):
            self._pixels = np.empty((height, width, 4), dtype=np.uint8)
        return self._pixels


_MEMORY = _Memory()


class Canvas:
    """An image in the making; positions are NED, m, unless they are called pixels.

    A thread finishes one canvas before it begins the next: they share their memory.

    Args:
        width: Of the finished picture, pixels.
        height: Likewise.
        view: Left, bottom, right, top of the image plane that must be seen, m.
        margins: Left, bottom, right, top that stay free of it, pixels.
    """

    def __init__(self, width: int, height: int, view: Array, margins: Array) -> None:
        from PIL import Image, ImageDraw

        self.width, self.height = width, height
        size = OVERSAMPLING * width, OVERSAMPLING * height
        self._pixels = _MEMORY.pixels(*size)
        self._pixels.view(np.uint32).fill(np.array((*PAPER, 255), dtype=np.uint8).view(np.uint32)[0])
        # Pillow draws into our memory; an image made that way is read-only until told otherwise.
        self.image = Image.frombuffer("RGBX", size, self._pixels, "raw", "RGBX", 0, 1)
        self.image.readonly = 0
        self.draw: Any = ImageDraw.Draw(self.image)
        room = np.array([width, height]) - margins[:2] - margins[2:]
        self.scale = OVERSAMPLING * float((room / (view[2:] - view[:2])).min())  # canvas pixels per m
        middle = 0.5 * (view[:2] + view[2:])
        centre = OVERSAMPLING * np.array(
            [margins[0] + 0.5 * room[0], height - margins[1] - 0.5 * room[1]], dtype=np.float64
        )
        self._flip = np.array([self.scale, -self.scale])
        self._origin = centre - middle * self._flip
        self._texts: list[tuple[float, float, str, int, Colour, str]] = []

    def pixels(self, points: Array) -> Array:
        """Canvas pixels of positions, (..., 3) to (..., 2)."""
        return np.asarray(project(points) * self._flip + self._origin)

    def flat(self, points: Array) -> Flat:
        """Canvas pixels of positions (n, 3) as Pillow takes them."""
        flat: Flat = self.pixels(points).ravel().tolist()
        return flat

    def line(self, flat: Sequence[float], colour: Colour, width: int = 2) -> None:
        """A line through pixels."""
        if len(flat) >= 4:
            self.draw.line(flat, fill=colour, width=width)

    def path(self, points: Array, colour: Colour, width: int = 2) -> None:
        """A line through positions (n, 3)."""
        self.line(self.flat(points), colour, width)

    def dashes(self, points: Array, colour: Colour, width: int = 2, dash: float = 7.0) -> None:
        """A dashed line through positions (n, 3); a dash and a gap are `dash` picture pixels long each."""
        uv = self.pixels(points)
        if len(uv) < 2:
            return
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(uv, axis=0).T))])
        if along[-1] <= 0.0:
            return
        count = min(int(along[-1] / (2.0 * OVERSAMPLING * dash)) + 1, _MOST_DASHES)
        ends = OVERSAMPLING * dash * np.arange(2 * count)
        at = np.stack([np.interp(ends, along, uv[:, c]) for c in (0, 1)], axis=1).reshape(count, 4)
        inside = (at[:, :2] > 0.0).all(axis=1) & (at[:, :2] < self.image.size).all(axis=1)
        for flat in at[inside].tolist():
            self.draw.line(flat, fill=colour, width=width)

    def polygon(self, flat: Flat, fill: Colour, outline: Colour | None = None, width: int = 2) -> None:
        """A filled polygon of pixels."""
        self.draw.polygon(flat, fill=fill)
        if outline is not None:
            self.draw.line(flat + flat[:4], fill=outline, width=width)

    def ring(self, x: float, y: float, radius: float, colour: Colour, width: int = 3) -> None:
        """A circle around a pixel, radius in canvas pixels."""
        self.draw.ellipse((x - radius, y - radius, x + radius, y + radius), outline=colour, width=width)

    def dot(self, x: float, y: float, radius: float, colour: Colour) -> None:
        """A disc around a pixel, radius in canvas pixels."""
        self.draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)

    def text(
        self, x: float, y: float, what: str, size: int, colour: Colour = INK, anchor: str = "la"
    ) -> None:
        """Text at picture pixels; drawn when the picture is finished. Anchors as Pillow's."""
        self._texts.append((x, y, what, size, colour, anchor))

    def finish(self) -> NDArray[np.uint8]:
        """The picture, (height, width, 3)."""
        frame = np.empty((self.height, self.width, 3), dtype=np.uint8)
        halve(self._pixels.view(np.uint32)[..., 0], np.empty(self.width, dtype=np.uint32), frame)
        for x, y, what, size, colour, anchor in self._texts:
            keep, add, left, top = _stencil(what, size, colour, anchor)
            left, top = round(x) + left, round(y) + top
            rows = slice(max(0, -top), max(0, min(len(keep), self.height - top)))
            columns = slice(max(0, -left), max(0, min(keep.shape[1], self.width - left)))
            part = frame[max(0, top) : top + rows.stop, max(0, left) : left + columns.stop]
            part[...] = part * keep[rows, columns] + add[rows, columns]
        return frame


@functools.lru_cache(maxsize=16)
def _font(size: int) -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(size=size)


@functools.lru_cache(maxsize=256)
def _stencil(what: str, size: int, colour: Colour, anchor: str) -> tuple[Floats, Floats, int, int]:
    """Text with a halo as factor and summand of the pixels below it, and where its corner lies.

    Most texts recur from picture to picture.
    """
    from PIL import Image, ImageDraw, ImageFilter

    font, rim = _font(size), 2
    left, top, right, bottom = font.getbbox(what, anchor=anchor)
    left, top = math.floor(left) - rim, math.floor(top) - rim
    mask = Image.new("L", (math.ceil(right) - left + rim + 1, math.ceil(bottom) - top + rim + 1), 0)
    ImageDraw.Draw(mask).text((-left, -top), what, fill=255, font=font, anchor=anchor)
    halo = mask.filter(ImageFilter.MaxFilter(2 * rim + 1))
    ink, around = (np.asarray(layer, dtype=np.float32)[..., None] / 255.0 for layer in (mask, halo))
    add = ink * np.array(colour, dtype=np.float32) + (1.0 - ink) * around * np.array(PAPER, dtype=np.float32)
    return (1.0 - ink) * (1.0 - around), add, left, top


@kernel
def halve(words: Words, row: Words, out: NDArray[np.uint8]) -> None:
    """Mean of each block of four pixels, rounded.

    Every second channel is summed at once: four of 8 bits and 2 for rounding fit into 16.

    Args:
        words: Pixels (2 h, 2 w), their channels from the low byte on.
        row: Scratch, (w,).
        out: Result, (h, w, 3).
    """
    mask, half, eight, two = np.uint32(0x00FF00FF), np.uint32(0x00020002), np.uint32(8), np.uint32(2)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            a, b = words[2 * i, 2 * j], words[2 * i, 2 * j + 1]
            c, d = words[2 * i + 1, 2 * j], words[2 * i + 1, 2 * j + 1]
            even = (a & mask) + (b & mask) + (c & mask) + (d & mask) + half
            odd = (a >> eight & mask) + (b >> eight & mask) + (c >> eight & mask) + (d >> eight & mask) + half
            row[j] = (even >> two & mask) | ((odd >> two & mask) << eight)
        for j in range(out.shape[1]):
            out[i, j, 0] = row[j] & np.uint32(255)
            out[i, j, 1] = row[j] >> eight & np.uint32(255)
            out[i, j, 2] = row[j] >> np.uint32(16) & np.uint32(255)
