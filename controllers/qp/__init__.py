"""Solvers of the OCP-QP behind one interface. `OsqpSolver` lives in `.osqp`, imported by who uses it."""

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
