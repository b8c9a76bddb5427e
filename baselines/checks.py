"""Checks of arguments that several functions share."""

from __future__ import annotations

from typing import Any

import numpy as np


def require_whole(what: str, value: Any, least: int) -> None:
    """Check that a value is a whole number that is large enough.

    Args:
        what: What it is, for the message.
        value: It.
        least: The smallest that is allowed.

    Raises:
        ValueError: If it is not.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{what} must be a whole number >= {least}, got {value!r}")
