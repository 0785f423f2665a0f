"""A heat map over two keys, a panel for each value of a third, with the interval of each cell written into it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.report.style import DOUBLE_COLUMN, SINGLE_COLUMN, MatplotlibFigure, decimals_for, fixed, new_figure

LOGARITHMIC_FROM = 20.0
MOST_COLUMNS_SIDE_BY_SIDE = 6
CELL_HEIGHT = 0.42  # in
NO_VALUE = "#ececec"
LUMINANCE = (0.2126, 0.7152, 0.0722)  # of red, green and blue


@dataclass(frozen=True, eq=False)
class Panel:
    """One panel of a heat map."""

    title: str  # what it shows; may be empty
    mean: FloatArray  # colour and first line of each cell, NaN where there is none; shape (R, C)
    half: FloatArray  # half the interval, NaN where there is none; shape (R, C)
    marked: tuple[int, int] | None = None  # row and column of the cell with a frame


def heat_map(
    panels: Sequence[Panel], columns: Sequence[str], rows: Sequence[str], column_label: str, row_label: str, quantity: str
) -> MatplotlibFigure:
    """Panels, (R, C) each, on one scale of colours, the darker the larger; logarithmic where the largest value is 20 times the smallest."""
    import matplotlib
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, LogNorm, Normalize

    values = np.concatenate([panel.mean.ravel() for panel in panels])
    finite = values[np.isfinite(values)] if np.isfinite(values).any() else np.zeros(1)
    low, high = float(finite.min()), float(finite.max())
    scale = LogNorm(low, high) if low > 0 and high / low > LOGARITHMIC_FROM else Normalize(low, high if high > low else low + 1.0)
    across = 1 if len(columns) > MOST_COLUMNS_SIDE_BY_SIDE else min(len(panels), 2)
    down = math.ceil(len(panels) / across)
    width = SINGLE_COLUMN if across == 1 and len(columns) <= MOST_COLUMNS_SIDE_BY_SIDE else DOUBLE_COLUMN
    with new_figure(width, down * (0.75 + CELL_HEIGHT * len(rows))) as figure:
        grid = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False)
        shades = LinearSegmentedColormap.from_list("shades", matplotlib.colormaps["Blues"](np.linspace(0.1, 0.95, 64)))
        colours = ScalarMappable(scale, shades)
        for axes, panel in zip(grid.flat, panels, strict=False):
            _draw(axes, panel, colours, decimals_for(finite.tolist()))
            axes.set_title(panel.title, loc="left")
            axes.set_xticks(range(len(columns)), columns)
            axes.set_yticks(range(len(rows)), rows)
        for axes in list(grid.flat)[len(panels) :]:
            axes.set_visible(False)
        for axes in grid[-1]:
            axes.set_xlabel(column_label)
        for axes in grid[:, 0]:
            axes.set_ylabel(row_label)
        figure.colorbar(colours, ax=list(grid.flat), label=quantity, pad=0.02, aspect=25).outline.set_visible(False)
    return figure


def _draw(axes: Any, panel: Panel, colours: Any, decimals: int) -> None:
    from matplotlib.patches import Rectangle

    edges = [np.arange(number + 1) - 0.5 for number in panel.mean.T.shape]
    axes.pcolormesh(*edges, panel.mean, cmap=colours.cmap, norm=colours.norm, edgecolors="white", linewidth=0.8)
    axes.set_facecolor(NO_VALUE)
    for row, column in np.ndindex(panel.mean.shape):
        mean, half = float(panel.mean[row, column]), float(panel.half[row, column])
        words = fixed(mean, decimals) + (f"\n±{fixed(half, decimals)}" if math.isfinite(half) else "")
        ink = "white" if math.isfinite(mean) and float(np.dot(LUMINANCE, colours.to_rgba(mean)[:3])) < 0.45 else "#111111"
        axes.text(column, row, words, ha="center", va="center", fontsize=6.5, color=ink, linespacing=1.1)
    if panel.marked is not None:
        row, column = panel.marked
        axes.add_patch(Rectangle((column - 0.46, row - 0.46), 0.92, 0.92, fill=False, edgecolor="#d6336c", linewidth=1.8))
    axes.grid(visible=False)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
