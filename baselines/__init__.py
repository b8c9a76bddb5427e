"""What a user runs: policies, their evaluation, benchmarks.

The public names stand in `__init__.pyi`; each loads at first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
