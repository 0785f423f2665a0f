"""Dot plot of the errors of all seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.report.style import DOUBLE_COLUMN, Line, MatplotlibFigure, new_figure

MIN_LOGARITHMIC_RATIO = 20.0
"""Largest over smallest value, from which on the axis is logarithmic."""


@dataclass(frozen=True, eq=False)
class Spread:
    """One row of a dot plot."""

    label: str  # of the row
    line: Line
    values: FloatArray  # a value for each of S seeds, (S,); those that are not finite are omitted
    chosen: float  # value of the chosen seed


def spread_figure(rows: Sequence[Spread], quantity: str) -> MatplotlibFigure:
    """Dots of all seeds, a row a step; the chosen seed as a diamond, the median as a tick."""
    with new_figure(DOUBLE_COLUMN * 0.86, 0.7 + 0.27 * max(len(rows), 2)) as figure:
        axes = figure.add_subplot()
        for position, row in enumerate(rows):
            values = row.values[np.isfinite(row.values)]
            not_chosen = np.delete(values, np.flatnonzero(values == row.chosen)[:1])
            offsets = 0.2 * np.resize([1.0, -1.0, 0.5, -0.5, 0.0], len(not_chosen))
            axes.scatter(
                not_chosen,
                position + offsets,
                s=11,
                color=row.line.colour,
                alpha=0.65,
                linewidths=0,
                zorder=3,
            )
            if len(values) > 1:
                axes.plot(
                    [values.min(), values.max()],
                    [position] * 2,
                    color=row.line.colour,
                    linewidth=0.8,
                    alpha=0.5,
                    zorder=2,
                )
                axes.plot(
                    [np.median(values)] * 2,
                    [position - 0.36, position + 0.36],
                    color=row.line.colour,
                    linewidth=1.6,
                    zorder=2,
                )
            axes.scatter(
                row.chosen,
                position,
                s=30,
                marker="D",
                color=row.line.colour,
                edgecolors="black",
                linewidths=0.8,
                zorder=4,
            )
        axes.set_yticks(range(len(rows)), [row.label for row in rows])
        axes.set_ylim(len(rows) - 0.4, -0.6)
        axes.grid(axis="x")
        axes.grid(visible=False, axis="y")
        axes.tick_params(axis="y", length=0)
        axes.set_xlabel(quantity)
        _set_scale(axes, np.concatenate([row.values for row in rows]))
        _draw_legend(axes)
    return figure


def _set_scale(axes: Any, values: FloatArray) -> None:
    finite = values[np.isfinite(values)]
    if len(finite) and finite.min() > 0 and finite.max() / finite.min() > MIN_LOGARITHMIC_RATIO:
        axes.set_xscale("log")
    elif len(finite):
        axes.set_xlim(0.0, 1.04 * float(finite.max()) or 1.0)


def _draw_legend(axes: Any) -> None:
    from matplotlib.lines import Line2D

    grey = "#666666"
    handles = [
        Line2D([], [], linestyle="none", marker="o", color=grey, markersize=3.5, label="a seed"),
        Line2D(
            [],
            [],
            linestyle="none",
            marker="|",
            color=grey,
            markersize=9,
            markeredgewidth=1.6,
            label="median",
        ),
        Line2D(
            [],
            [],
            linestyle="none",
            marker="D",
            color=grey,
            markeredgecolor="black",
            markersize=5,
            label="seed chosen on validation",
        ),
    ]
    axes.legend(
        handles=handles, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, borderaxespad=0.2
    )
