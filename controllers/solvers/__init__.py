"""Solvers of the OCP-QP behind one interface."""

from .solution import Backend, Multipliers, Residuals, Solution, Status, residuals
from .structured import StructuredSolver

__all__ = [
    "Backend",
    "Multipliers",
    "Residuals",
    "Solution",
    "Status",
    "StructuredSolver",
    "residuals",
]
