"""Figures 7.1 and 7.2: how estimates and messages lead to commands, drawn from lists of blocks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

from ..results import SHOWN, Numbers
from ..target_claims import P_F
from .model import Drawing, Sketch
from .svg import Point, arrow, box, document, words

_WIDTH, _HEIGHT = 240.0, 84.0  # of a block, pixels
_ACROSS, _DOWN = 44.0, 50.0  # between blocks
_MARGIN = 20.0
_LINE = 17.0  # from line to line


class Block(NamedTuple):
    """A step of a scheme, with its place on a grid."""

    column: float
    row: float
    lines: tuple[str, ...]  # the first one is its name

    @property
    def corner(self) -> Point:
        """Upper left."""
        return Point(_MARGIN + self.column * (_WIDTH + _ACROSS), _MARGIN + self.row * (_HEIGHT + _DOWN))

    @property
    def middle(self) -> Point:
        """Its centre."""
        return Point(self.corner.x + 0.5 * _WIDTH, self.corner.y + 0.5 * _HEIGHT)


class Scheme(NamedTuple):
    """Blocks, and from which to which something goes."""

    title: str
    blocks: Mapping[str, Block]
    links: Sequence[tuple[str, str]]


COOPERATION = Scheme(
    "Cooperative control and estimation",
    {
        "vehicles": Block(0, 0, ("Vehicles 1 to 6", "rotor forces, states")),
        "measurements": Block(1, 0, ("Measurements of the target", "range, or range and angles")),
        "topology": Block(2, 0, ("Connection topology", "who hears whom:", "measurements and positions")),
        "estimate": Block(
            2, 1, ("Estimate of each vehicle", "trilateration if it holds four,", "else the EKF")
        ),
        "reference": Block(1, 1, ("Reference generation", "consensus and target estimate,", "figure 7.2")),
        "control": Block(0, 1, ("MPC of each vehicle", "tracks its own reference")),
    },
    (
        ("vehicles", "measurements"),
        ("measurements", "topology"),
        ("topology", "estimate"),
        ("topology", "reference"),
        ("estimate", "reference"),
        ("reference", "control"),
        ("control", "vehicles"),
    ),
)
REFERENCES = Scheme(
    "Reference generation for the MPC",
    {
        "neighbours": Block(0, 0, ("Positions of those heard", "and the formation, d_ij")),
        "target": Block(0, 1, ("Own estimate of the target", "and the slot beside it, d_it")),
        "consensus": Block(
            1, 0, ("Neighbour consensus, (7.1)", f"covariance P_f = {P_F:g} m^2", "by choice")
        ),
        "slot": Block(1, 1, ("Slot by the target", "covariance P_t", "of the estimate")),
        "fusion": Block(2, 0.5, ("Weighted mean, (7.2)", "by the inverses", "of both covariances")),
        "control": Block(3, 0.5, ("MPC", "tracks the reference")),
    },
    (
        ("neighbours", "consensus"),
        ("target", "slot"),
        ("consensus", "fusion"),
        ("slot", "fusion"),
        ("fusion", "control"),
    ),
)


def scheme_marks(scheme: Scheme) -> Iterator[str]:
    """Its blocks, and arrows from side to side of them."""
    for start, end in scheme.links:
        yield arrow(list(_sides(scheme.blocks[start], scheme.blocks[end])), "slate")
    for block in scheme.blocks.values():
        yield box(block.corner, _WIDTH, _HEIGHT, "blue")
        first = block.middle.y - 0.5 * _LINE * (len(block.lines) - 1)
        for k, line in enumerate(block.lines):
            yield words(Point(block.middle.x, first + k * _LINE), line, 14.0 if k == 0 else 12.5, bold=k == 0)


def _sides(start: Block, end: Block) -> tuple[Point, Point]:
    """Where an arrow leaves a block and meets another: beside each other, above each other, or across."""
    a, b = start.middle, end.middle
    if start.column == end.column:
        side = 0.5 * _HEIGHT * (1.0 if b.y > a.y else -1.0)
        return Point(a.x, a.y + side), Point(b.x, b.y - side)
    if start.row == end.row or abs(start.row - end.row) < 1.0:
        side = 0.5 * _WIDTH * (1.0 if b.x > a.x else -1.0)
        return Point(a.x + side, a.y), Point(b.x - side, b.y)
    across, down = (1.0 if b.x > a.x else -1.0), (1.0 if b.y > a.y else -1.0)
    return (
        Point(a.x + 0.3 * across * _WIDTH, a.y + 0.5 * down * _HEIGHT),
        Point(b.x - 0.3 * across * _WIDTH, b.y - 0.5 * down * _HEIGHT),
    )


def scheme_figure(scheme: Scheme, jobs: int = 1) -> Drawing:
    """A scheme, as large as its blocks need."""
    far = [Point(block.corner.x + _WIDTH, block.corner.y + _HEIGHT) for block in scheme.blocks.values()]
    width, height = max(p.x for p in far) + _MARGIN, max(p.y for p in far) + _MARGIN
    numbers: Numbers = {"blocks": f"{len(scheme.blocks)}", "links": f"{len(scheme.links)}"}
    return Drawing(document(width, height, scheme.title, scheme_marks(scheme)), SHOWN, numbers)


SCHEMES = [
    Sketch(
        "7.1", "cooperative control and estimation",
        "Measurements and what neighbours say give each vehicle an estimate, and with positions a reference.",
        "As `cooperative-mpc` does it: each vehicle runs all of it by itself.",
        partial(scheme_figure, COOPERATION), flown=False,
    ),
    Sketch(
        "7.2", "reference generation",
        "A wanted place by the neighbours, and one by the target estimate, weighted by their covariances.",
        "A good estimate keeps a vehicle with the target, a bad one with the formation.",
        partial(scheme_figure, REFERENCES), ("7-trust",), False,
    ),
]  # fmt: skip
