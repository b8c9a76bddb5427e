"""The house style of all figures: sizes, colours, and how they are saved. matplotlib is loaded at need.

    @house_style()
    def value_figure(t, value):
        figure, axes = new_figure(2, 1, height=1.4)
        axes[0, 0].plot(t, value, color=COLOURS["blue"])
        axes[0, 0].set_title("value function along the flight")
        return figure

    save_figure(value_figure(t, value), folder, "value")

Figures are made without pyplot: nothing global changes, no window opens, and nothing has to be closed.
"""

from __future__ import annotations

import io
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from quad_envs.arguments.extras import install_command
from quad_envs.pictures import canvas

from ...errors import MissingPackageError
from ...files import write_atomic

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FULL_WIDTH, HALF_WIDTH = 6.5, 3.2  # inches: a text column, and half of one
PANEL_HEIGHT = 2.2  # inches, of one row of axes
_DPI = 200


def _share(colour: canvas.Colour) -> tuple[float, float, float]:
    red, green, blue = (part / 255.0 for part in colour)
    return red, green, blue


# The colours of the frames, so that a policy or a limit looks alike everywhere; red is for violations alone.
COLOURS: dict[str, tuple[float, float, float]] = {
    "ink": _share(canvas.INK),
    "faint": _share(canvas.FAINT),
    "grid": _share(canvas.GRID),
    "blue": _share(canvas.BLUE),
    "orange": _share(canvas.ORANGE),
    "green": _share(canvas.GREEN),
    "purple": _share(canvas.PURPLE),
    "slate": _share(canvas.SLATE),
    "red": _share(canvas.RED),
}
CYCLE = ("blue", "orange", "green", "purple", "slate")  # of curves that mean nothing in particular

_STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib, so figures are alike on all machines
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.titlelocation": "left",
    "axes.labelsize": 8.0,
    "axes.edgecolor": COLOURS["faint"],
    "axes.labelcolor": COLOURS["ink"],
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.linewidth": 0.6,
    "grid.color": COLOURS["grid"],
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.2,
    "xtick.color": COLOURS["faint"],
    "ytick.color": COLOURS["faint"],
    "xtick.labelcolor": COLOURS["ink"],
    "ytick.labelcolor": COLOURS["ink"],
    "text.color": COLOURS["ink"],
    "legend.edgecolor": "none",
    "legend.fancybox": False,
    "legend.framealpha": 0.8,
    "legend.fontsize": 7.5,
    "pdf.fonttype": 42,  # text stays text in the PDF
}


@contextmanager
def house_style() -> Iterator[None]:
    """The style for everything that is drawn meanwhile, titles and legends too; also a decorator.

    Raises:
        MissingPackageError: If matplotlib is not installed; the message names the extra.
    """
    try:
        import matplotlib
        from cycler import cycler
    except ImportError as error:
        raise MissingPackageError(
            f"figures need matplotlib ({error}): {install_command('report')}"
        ) from error
    style: Any = {**_STYLE, "axes.prop_cycle": cycler(color=[COLOURS[name] for name in CYCLE])}
    with matplotlib.rc_context(style):
        yield


@house_style()
def new_figure(
    rows: int = 1, columns: int = 1, *, width: float = FULL_WIDTH, height: float = 1.0, **options: Any
) -> tuple[Figure, NDArray[Any]]:
    """A figure with a grid of axes; call it inside `house_style`, so that what is drawn into it fits.

    Args:
        rows: Of axes.
        columns: Of axes.
        width: Inches.
        height: Of one row, in units of PANEL_HEIGHT.
        options: Of `Figure.subplots`, as sharex.

    Returns:
        The figure and its axes, (rows, columns).

    Raises:
        MissingPackageError: If matplotlib is not installed; the message names the extra.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, rows * height * PANEL_HEIGHT), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


@house_style()
def save_figure(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write NAME.png and NAME.pdf, each complete or not at all; the same figure gives the same bytes.

    Raises:
        MissingPackageError: If matplotlib is not installed.
        ResultsError: If they cannot be written.
    """
    logging.getLogger("fontTools").setLevel(logging.ERROR)  # it remarks on the dates of the font
    paths = []
    for kind, metadata in (("png", {"Software": None}), ("pdf", {"CreationDate": None, "ModDate": None})):
        data = io.BytesIO()
        figure.savefig(data, format=kind, dpi=_DPI, metadata=metadata)
        write_atomic(folder / f"{name}.{kind}", data.getvalue())
        paths.append(folder / f"{name}.{kind}")
    return paths


def ellipse(shape: NDArray[np.float64], points: int = 181) -> NDArray[np.float64]:
    """The curve y'W^-1 y = 1 in the plane, (2, points)."""
    angle = np.linspace(0.0, 2.0 * np.pi, points)
    values, vectors = np.linalg.eigh(shape)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return np.asarray(vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * circle))
