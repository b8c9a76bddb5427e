"""The figures of chapters 4 to 7 redrawn from our own flights, and those of what was found beyond them."""

from __future__ import annotations

from pathlib import Path

from ...files import write_atomic
from ...report.figures import house_style, save_figure
from ..results import Plate, Section
from . import (
    beyond_teams,
    beyond_tracking,
    beyond_tuning,
    estimation,
    formation,
    graphs,
    regulation,
    schemes,
    target,
    tracking,
)
from .model import Drawing, Sketch

__all__ = ["FIGURES", "Drawing", "Sketch", "draw_section"]

FIGURES: dict[str, tuple[Sketch, ...]] = {
    "figures-4": (*tracking.SKETCHES, *regulation.SKETCHES),
    "figures-5": (*graphs.FORMATIONS, *formation.SKETCHES),
    "figures-6": (*graphs.SCENES, *estimation.SKETCHES),
    "figures-7": (*schemes.SCHEMES, *graphs.BESIDE, *target.SKETCHES),
    "beyond": (*beyond_tracking.SKETCHES, *beyond_tuning.SKETCHES, *beyond_teams.SKETCHES),
}
_TITLES = {
    "beyond": "What we found beyond the text",
    **{f"figures-{chapter}": f"Figures of chapter {chapter}" for chapter in range(4, 8)},
}


def draw_section(name: str, out: Path, jobs: int = 1) -> Section:
    """Draw the figures of a section, each saved once it is drawn: OUT/figures/NAME.png and .pdf, or .svg.

    Raises:
        MissingPackageError: If matplotlib is not installed.
        ResultsError: If a figure cannot be written.
    """
    plates = [draw_plate(sketch, out, jobs) for sketch in FIGURES[name]]
    return Section(name, _TITLES[name], [], [], tuple(plates))


def draw_plate(sketch: Sketch, out: Path, jobs: int = 1) -> Plate:
    """Draw and save one figure."""
    drawing = sketch.draw(jobs)
    return Plate(
        sketch.key,
        sketch.title,
        sketch.printed,
        sketch.whole_caption,
        drawing.verdict,
        drawing.numbers,
        sketch.claims,
        tuple(file.relative_to(out).as_posix() for file in _saved(sketch, drawing, out / "figures")),
    )


def _saved(sketch: Sketch, drawing: Drawing, folder: Path) -> list[Path]:
    if isinstance(drawing.figure, str):
        write_atomic(folder / f"{sketch.name}.svg", drawing.figure.encode())
        return [folder / f"{sketch.name}.svg"]
    head = sketch.title if sketch.own else f"Figure {sketch.key}, redrawn: {sketch.title}"
    with house_style():
        drawing.figure.suptitle(head, x=0.01, ha="left", fontsize=9.0, fontweight="bold")
        return list(save_figure(drawing.figure, folder, sketch.name))
