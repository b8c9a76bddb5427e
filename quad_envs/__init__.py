"""Quadrotor environments for Gymnasium and PettingZoo; importing the package registers their ids."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .lazy import load_public, public_names
from .registration import TEAMS, register

if TYPE_CHECKING:
    from .array_info import ArrayInfo
    from .disturbances import Gusts, Impulse, Steady, TorquePulse
    from .formations import make_formation
    from .graphs import Switching, Timed, adjacency, make_graph, toward_leader
    from .parameters import Limits, QuadrotorParams, Weights
    from .references import (
        Heading,
        Helix,
        Lemniscate,
        Line,
        OutAndBack,
        Racetrack,
        RandomSmooth,
        Reference,
        SetPoint,
        SphericalSpiral,
        from_csv,
        from_function,
    )
    from .targets import (
        Aircraft,
        ConstantVelocity,
        PathTarget,
        StaticTarget,
        Target,
        TurningTarget,
        target_from_function,
    )
    from .tasks import Task

__version__ = "0.1.0"

# Public name -> module; loaded at first use, so that importing the package stays cheap.
_PUBLIC = {
    "Aircraft": "targets",
    "ArrayInfo": "array_info",
    "ConstantVelocity": "targets",
    "Gusts": "disturbances",
    "Heading": "references",
    "Helix": "references",
    "Impulse": "disturbances",
    "Lemniscate": "references",
    "Limits": "parameters",
    "Line": "references",
    "OutAndBack": "references",
    "PathTarget": "targets",
    "QuadrotorParams": "parameters",
    "Racetrack": "references",
    "RandomSmooth": "references",
    "Reference": "references",
    "SetPoint": "references",
    "SphericalSpiral": "references",
    "StaticTarget": "targets",
    "Steady": "disturbances",
    "Switching": "graphs",
    "Target": "targets",
    "Task": "tasks",
    "Timed": "graphs",
    "TorquePulse": "disturbances",
    "TurningTarget": "targets",
    "Weights": "parameters",
    "adjacency": "graphs",
    "from_csv": "references",
    "from_function": "references",
    "make_formation": "formations",
    "make_graph": "graphs",
    "target_from_function": "targets",
    "toward_leader": "graphs",
}

# The modules of teams, `formation_v0` and so on.
_TEAM_MODULES = [module.rpartition(".")[2] for module in TEAMS.values()]

__all__ = [
    "Aircraft",
    "ArrayInfo",
    "ConstantVelocity",
    "Gusts",
    "Heading",
    "Helix",
    "Impulse",
    "Lemniscate",
    "Limits",
    "Line",
    "OutAndBack",
    "PathTarget",
    "QuadrotorParams",
    "Racetrack",
    "RandomSmooth",
    "Reference",
    "SetPoint",
    "SphericalSpiral",
    "StaticTarget",
    "Steady",
    "Switching",
    "Target",
    "Task",
    "Timed",
    "TorquePulse",
    "TurningTarget",
    "Weights",
    "adjacency",
    "from_csv",
    "from_function",
    "make_formation",
    "make_graph",
    "target_from_function",
    "toward_leader",
]


def __getattr__(name: str) -> Any:
    if name in _TEAM_MODULES:
        return import_module(f".{name}", __name__)
    return load_public(__name__, _PUBLIC, name)


def __dir__() -> list[str]:
    return public_names(globals(), *_TEAM_MODULES)


register()
