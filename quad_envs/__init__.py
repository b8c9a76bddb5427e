"""Quadrotor environments for Gymnasium and PettingZoo; importing the package registers their ids."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .registration import register

if TYPE_CHECKING:
    from .disturbances import Gusts, Impulse, Steady, TorquePulse
    from .parameters import Limits, QuadrotorParams, Weights
    from .references import (
        Heading,
        Helix,
        Lemniscate,
        OutAndBack,
        Racetrack,
        RandomSmooth,
        Reference,
        SetPoint,
        SphericalSpiral,
        from_csv,
        from_function,
    )
    from .tasks import Task

__version__ = "0.1.0"

# Public name -> module; loaded at first use, so that importing the package stays cheap.
_PUBLIC = {
    "Gusts": "disturbances",
    "Heading": "references",
    "Helix": "references",
    "Impulse": "disturbances",
    "Lemniscate": "references",
    "Limits": "parameters",
    "OutAndBack": "references",
    "QuadrotorParams": "parameters",
    "Racetrack": "references",
    "RandomSmooth": "references",
    "Reference": "references",
    "SetPoint": "references",
    "SphericalSpiral": "references",
    "Steady": "disturbances",
    "Task": "tasks",
    "TorquePulse": "disturbances",
    "Weights": "parameters",
    "from_csv": "references",
    "from_function": "references",
}

__all__ = [
    "Gusts",
    "Heading",
    "Helix",
    "Impulse",
    "Lemniscate",
    "Limits",
    "OutAndBack",
    "QuadrotorParams",
    "Racetrack",
    "RandomSmooth",
    "Reference",
    "SetPoint",
    "SphericalSpiral",
    "Steady",
    "Task",
    "TorquePulse",
    "Weights",
    "from_csv",
    "from_function",
]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(f".{_PUBLIC[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


register()
