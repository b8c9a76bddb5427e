"""What a person may ask of pictures: modes and sizes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from ...arguments.names import shown

NO_RENDERING = 'there are no pictures without a render_mode: make the environment with "rgb_array"'
_SMALLEST, _LARGEST = 160, 4096  # pixels


class RenderModes(list[str]):
    """Modes of pictures. Gymnasium asks whether one is among them, then for its ending, which text has."""

    def __contains__(self, mode: object) -> bool:
        if not isinstance(mode, str):
            raise ValueError(_unknown_mode(mode, self))
        return super().__contains__(mode)


def _unknown_mode(mode: object, known: Iterable[str]) -> str:
    return f"render_mode must be None or {' or '.join(map(repr, known))}, got {shown(mode)}"


def checked_rendering(mode: str | None, known: tuple[str, ...], render_size: Any) -> tuple[int, int]:
    """Width and height of pictures.

    Raises:
        ValueError: If the mode is unknown, or the size is not a pair of whole numbers that suits the text.
    """
    if mode is not None and mode not in known:
        remedy = ""
        if mode == "human":
            remedy = '; gymnasium.make(..., render_mode="human") or its HumanRendering wrapper opens a window'
        raise ValueError(_unknown_mode(mode, known) + remedy)
    pair = tuple(render_size) if isinstance(render_size, tuple | list) else ()
    whole = all(isinstance(n, int | np.integer) and not isinstance(n, bool) for n in pair)
    if len(pair) != 2 or not whole or not all(_SMALLEST <= n <= _LARGEST for n in pair):
        raise ValueError(
            f"render_size must be (width, height) in pixels, whole numbers from {_SMALLEST} to {_LARGEST}, "
            f"got {shown(render_size)}"
        )
    return int(pair[0]), int(pair[1])
