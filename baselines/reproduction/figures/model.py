"""What a figure of the reproduction is: what the source says of it, who draws it, and what came out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..results import Numbers, verdict

REDRAWN = "Redrawn from our own flights: in the source the data of this figure is a picture only."
DRAWN = "Drawn from our own graphs and formations: in the source this figure is a picture only."
OWN = "Not in the source: an experiment of our own."


class Drawing(NamedTuple):
    """A figure as it was drawn."""

    figure: Any  # matplotlib's, or the text of an SVG
    verdict: str  # HOLDS, PARTLY, FALSE or NOT REPRODUCED, computed from the numbers; or SHOWN
    numbers: Numbers


@dataclass(frozen=True, slots=True)
class Sketch:
    """A figure that can be drawn.

    `draw` takes the number of flights in parallel. `printed` is what the source says of the figure, or of the
    matter where it has no such figure; `claims` are the keys of claims that treat the same in numbers.
    """

    key: str  # "4.1", or "beyond-alpha"
    title: str
    printed: str
    caption: str
    draw: Callable[[int], Drawing]
    claims: tuple[str, ...] = ()
    flown: bool = True  # whether its data comes from flights

    @property
    def own(self) -> bool:
        """Whether the source has no such figure."""
        return not self.key[0].isdigit()

    @property
    def name(self) -> str:
        """Of its files, without the ending: figure-4-01 sorts before figure-4-10."""
        if self.own:
            return self.key
        chapter, number = self.key.split(".")
        return f"figure-{chapter}-{int(number):02d}"

    @property
    def whole_caption(self) -> str:
        """The caption, with where its data comes from."""
        return f"{self.caption} {OWN if self.own else REDRAWN if self.flown else DRAWN}"


def judge(*right: bool) -> str:
    """HOLDS where all of it is right, FALSE where nothing is, PARTLY in between."""
    return verdict(float(np.mean(right)))
