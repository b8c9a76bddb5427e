"""Wrappers for libraries that learn, in the words of `gymnasium.wrappers`; `vector` has those of vectors.

`encoding` is what they share with learners and with networks that fly.
"""

from .filter_and_rescale import FilterAndRescale

__all__ = ["FilterAndRescale"]
