"""Quadrotor environments for Gymnasium and PettingZoo; importing the package registers their ids.

The public names stand in `__init__.pyi`; each loads at first use.
"""

import lazy_loader

from .registration import register

__version__ = "0.2.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

register()
