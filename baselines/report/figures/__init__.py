"""Figures by matplotlib in one house style."""

from .style import COLOURS, ellipse, house_style, new_figure, save_figure

__all__ = ["COLOURS", "ellipse", "house_style", "new_figure", "save_figure"]
