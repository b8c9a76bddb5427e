"""What a reproduction gives: printed cells beside ours, and claims with their verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

from ..evaluation.table import format_number, format_table

# Verdicts beside HOLDS, PARTLY and FALSE.
SHOWN = "SHOWN"  # nothing is stated that could hold or fail
FITTED = "FITTED"  # our numbers were chosen by the printed ones
NOT_REPRODUCED = "NOT REPRODUCED"  # does not show, but what is not printed may be why

Value: TypeAlias = "float | str"
# What was measured -> its value, or column -> value where several stand side by side.
Numbers: TypeAlias = "dict[str, Value | Mapping[str, Value]]"


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


class Measured(NamedTuple):
    """A number of which the dissertation prints nothing: that of an independent prototype beside ours."""

    where: str  # "line, constant velocity"
    quantity: str  # "lag, m"
    prototype: float
    ours: float

    @property
    def difference(self) -> float:
        """Ours less the prototype's."""
        return self.ours - self.prototype


class Claim(NamedTuple):
    """A sentence of the dissertation, what was measured, and whether it holds."""

    key: str
    text: str
    verdict: str  # HOLDS, PARTLY, FALSE or NOT REPRODUCED, computed from the numbers
    numbers: Numbers
    prototype: str = ""  # verdict that an independent prototype led to, where there is one
    own: bool = False  # a sentence of ours: the dissertation does not say it


class Plate(NamedTuple):
    """A figure that was drawn and saved."""

    key: str  # "4.1"
    title: str
    printed: str  # what the source says of it
    caption: str
    verdict: str  # as of a claim; SHOWN where the source states nothing
    numbers: Numbers
    claims: tuple[str, ...]  # keys of the claims that treat the same
    files: tuple[str, ...]  # PNG and PDF, or one SVG, relative to the results folder


class Section(NamedTuple):
    """One thing that can be asked for: a table, the claims or the figures of a chapter."""

    name: str
    title: str
    cells: list[Cell] | list[Measured]
    claims: list[Claim]
    plates: tuple[Plate, ...] = ()
    fitted: str = ""  # what was chosen so that ours meet the printed cells; "": nothing was

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "name": self.name,
            "title": self.title,
            "fitted": self.fitted,
            "cells": [_cell_to_dict(cell) for cell in self.cells],
            "claims": [_claim_to_dict(claim) for claim in self.claims],
            "figures": [{**plate._asdict(), "numbers": _finite_all(plate.numbers)} for plate in self.plates],
        }

    def __str__(self) -> str:
        parts = [self.title, *([f"[{FITTED}] {self.fitted}"] if self.fitted else [])]
        printed = [cell for cell in self.cells if isinstance(cell, Cell)]
        measured = [cell for cell in self.cells if isinstance(cell, Measured)]
        if printed:
            rows = [
                [cell.where, cell.quantity, f"{cell.printed:.4f}", f"{cell.ours:.4f}", f"{cell.ratio:.3f}"]
                for cell in printed
            ]
            parts.append(format_table(["", "quantity", "printed", "ours", "ratio"], rows))
            misfit = [abs(cell.ratio - 1.0) for cell in printed]
            mean_square = sum(m * m for m in misfit) / len(misfit)
            parts.append(f"relative misfit: rms {mean_square**0.5:.1%}, largest {max(misfit):.1%}")
        if measured:
            rows = [[cell.where, cell.quantity, show(cell.prototype), show(cell.ours)] for cell in measured]
            parts.append(format_table(["", "quantity", "prototype", "ours"], rows))
        parts += map(_claim_text, self.claims)
        parts += map(_plate_text, self.plates)
        return "\n\n".join(parts)


def _cell_to_dict(cell: Cell | Measured) -> dict[str, Any]:
    """With its ratio or difference, and None for what JSON has no number for."""
    more = {"ratio": cell.ratio} if isinstance(cell, Cell) else {"difference": cell.difference}
    return {name: _finite(value) for name, value in {**cell._asdict(), **more}.items()}


def _claim_to_dict(claim: Claim) -> dict[str, Any]:
    said = {**claim._asdict(), "numbers": _finite_all(claim.numbers)}
    if not claim.prototype:
        del said["prototype"]
    return said


def _finite_all(numbers: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _finite(value) for name, value in numbers.items()}


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return _finite_all(value)
    return value if isinstance(value, str) or math.isfinite(value) else None


def _claim_text(claim: Claim) -> str:
    numbers = "; ".join(f"{name}: {show(value)}" for name, value in claim.numbers.items())
    differs = claim.prototype and claim.prototype != claim.verdict
    aside = f", prototype: {claim.prototype}" if differs else ""
    ours = "our finding " if claim.own else ""
    return f"[{ours}{claim.verdict}{aside}] {claim.text}\n    {numbers}"


def _plate_text(plate: Plate) -> str:
    numbers = "; ".join(f"{name}: {show(value)}" for name, value in plate.numbers.items())
    return f"[{plate.verdict}] {plate.key} {plate.title}: {plate.files[0]}\n    {numbers}"


def show(value: Value | Mapping[str, Value]) -> str:
    """A number of a claim as text; of several each behind the name of its column."""
    if isinstance(value, Mapping):
        return ", ".join(f"{column}: {show(each)}" for column, each in value.items())
    return value if isinstance(value, str) else format_number(value, 3)


def verdict(share: float) -> str:
    """HOLDS where all cases agree with the claim, FALSE where none does, PARTLY in between."""
    return "HOLDS" if share >= 1.0 else "FALSE" if share <= 0.0 else "PARTLY"
