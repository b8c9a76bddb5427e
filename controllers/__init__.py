"""Control of a vehicle and of teams: linear, state-dependent and exact MPC, feedback laws, and solvers.

The public names stand in `__init__.pyi`; each loads at first use.
"""

import sys
from importlib import import_module

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

# Modules that others import by their paths of before: the solvers, the data and the equations of the OCP-QP.
for _former, _path in {"solvers": "qp", "ocp": "qp.ocp", "riccati": "qp.riccati"}.items():
    sys.modules[f"{__name__}.{_former}"] = import_module(f".{_path}", __name__)
