"""A window for `render_mode="human"` of the multi-agent environments; pygame is loaded when it opens."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arguments.extras import install_command


class Window:
    """Shows pictures at the pace of the flight.

    Args:
        size: Width and height, pixels.
        title: In its frame.

    Raises:
        ImportError: If pygame is not installed.
    """

    def __init__(self, size: tuple[int, int], title: str) -> None:
        try:
            import pygame
        except ImportError as error:
            raise ImportError(
                f'render_mode="human" needs pygame: {install_command("human")}, or use '
                'render_mode="rgb_array"'
            ) from error
        self._pygame: Any = pygame
        pygame.display.init()
        pygame.display.set_caption(title)
        self._screen = pygame.display.set_mode(size)
        self._clock = pygame.time.Clock()

    def show(self, frame: NDArray[np.uint8], rate: float) -> None:
        """Show a picture (height, width, 3) and wait, so that there are at most `rate` in a second."""
        pygame = self._pygame
        pygame.event.pump()
        pygame.surfarray.blit_array(self._screen, frame.transpose(1, 0, 2))
        pygame.display.flip()
        self._clock.tick(rate)

    def close(self) -> None:
        """Close the window."""
        self._pygame.display.quit()
