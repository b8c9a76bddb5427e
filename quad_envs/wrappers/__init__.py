"""Wrappers for libraries that learn, in the words of `gymnasium.wrappers`; `vector` has those of vectors."""

from .filter_and_rescale import FilterAndRescale

__all__ = ["FilterAndRescale"]
