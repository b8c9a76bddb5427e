"""What a reproduction gives: printed cells beside ours, and claims with their verdict."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from ..table import format_number, format_table


class Cell(NamedTuple):
    """A printed number beside ours."""

    where: str  # "helix, N = 25, LMPC"
    quantity: str  # "RMS, m"
    printed: float
    ours: float

    @property
    def ratio(self) -> float:
        """Ours divided by printed."""
        return self.ours / self.printed


class Claim(NamedTuple):
    """A sentence of the dissertation, what was measured, and whether it holds."""

    key: str
    text: str
    verdict: str  # HOLDS, PARTLY or FALSE, computed from the numbers
    numbers: Mapping[str, float | str]


class Section(NamedTuple):
    """One thing that can be asked for: a table or the claims of a chapter."""

    name: str
    title: str
    cells: list[Cell]
    claims: list[Claim]

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "name": self.name,
            "title": self.title,
            "cells": [{**cell._asdict(), "ratio": cell.ratio} for cell in self.cells],
            "claims": [{**claim._asdict(), "numbers": dict(claim.numbers)} for claim in self.claims],
        }

    def __str__(self) -> str:
        parts = [self.title]
        if self.cells:
            rows = [
                [cell.where, cell.quantity, f"{cell.printed:.4f}", f"{cell.ours:.4f}", f"{cell.ratio:.3f}"]
                for cell in self.cells
            ]
            parts.append(format_table(["", "quantity", "printed", "ours", "ratio"], rows))
            misfit = [abs(cell.ratio - 1.0) for cell in self.cells]
            mean_square = sum(m * m for m in misfit) / len(misfit)
            parts.append(f"relative misfit: rms {mean_square**0.5:.1%}, largest {max(misfit):.1%}")
        for claim in self.claims:
            numbers = "; ".join(f"{name}: {_show(value)}" for name, value in claim.numbers.items())
            parts.append(f"[{claim.verdict}] {claim.text}\n    {numbers}")
        return "\n\n".join(parts)


def _show(value: float | str) -> str:
    return value if isinstance(value, str) else format_number(value, 3)


def verdict(share: float) -> str:
    """HOLDS where all cases agree with the claim, FALSE where none does, PARTLY in between."""
    return "HOLDS" if share >= 1.0 else "FALSE" if share <= 0.0 else "PARTLY"
