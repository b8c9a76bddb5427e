"""The report of a results folder: one self-contained page with the leaderboard and the flights to look at."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
