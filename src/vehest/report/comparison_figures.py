"""Figures that compare estimators with each other and with the reference: forest plot, agreement, β
over ay, g-g diagram.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.report.style import (
    DOUBLE_COLUMN,
    REFERENCE_GREY,
    Line,
    MatplotlibFigure,
    decimals_for,
    fixed,
    new_figure,
)

FOREST_WIDTH = 4.4  # width of the figure, in, narrow enough for a phone
FOREST_FONT = 8.5  # pt
MIN_RATIO_FOR_LOG = 8.0  # highest over lowest RMSE, from which the axis is logarithmic
MAX_POINTS = 500  # points of a cloud of samples, about; of a longer one every n-th is drawn
AGREEMENT_COLUMNS = 4  # clouds side by side at most; further ones begin a row
TITLE_CHARACTERS = 25  # largest number of characters of an estimator's name in a line
MARKER_SIZE = 2.2  # pt, of a sample
FIRST_MARKER_SIZE = 3.6  # pt, of a sample of the cloud that is drawn first


@dataclass(frozen=True)
class ForestRow:
    """One estimator of a forest plot.

    Parameters
    ----------
    label : str
        Name of the estimator.
    line : Line
        Its colour and marker.
    rmse, low, high : float
        RMSE(β) and the ends of its interval [deg]; NaN where there is no interval.
    is_filled : bool
        Whether its marker is filled.
    """

    label: str
    line: Line
    rmse: float
    low: float
    high: float
    is_filled: bool


def forest_figure(rows: Sequence[ForestRow]) -> MatplotlibFigure:
    """RMSE(β) with its interval, one row an estimator, the first on top.

    Logarithmic where the errors differ much.

    Parameters
    ----------
    rows : sequence of ForestRow
        At least one; RMSE in degrees.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    sizes = [row.rmse for row in rows]
    decimals = max(2, decimals_for(sizes, 2))
    with new_figure(FOREST_WIDTH, 0.6 + 0.29 * len(rows)) as figure:
        axes = figure.add_subplot()
        for height, row in enumerate(rows):
            if math.isfinite(row.low):
                axes.plot(
                    [row.low, row.high], [height, height], color=row.line.colour, linewidth=1.6
                )
            axes.plot(
                row.rmse,
                height,
                marker=row.line.marker,
                markersize=4.5,
                color=row.line.colour,
                markerfacecolor=row.line.colour if row.is_filled else "white",
            )
            axes.annotate(
                _size_with_interval(row, decimals),
                (1.02, height),
                xycoords=("axes fraction", "data"),
                fontsize=FOREST_FONT,
                va="center",
                annotation_clip=False,
            )
        axes.set_yticks(
            range(len(rows)),
            [_wrapped(row.label) for row in rows],
            fontsize=FOREST_FONT,
        )
        axes.set_ylim(len(rows) - 0.4, -0.6)
        axes.tick_params(axis="y", length=0)
        axes.tick_params(axis="x", labelsize=FOREST_FONT)
        axes.grid(visible=False, axis="y")
        x_label = "RMSE(β) [deg]"
        if min(sizes) > 0 and max(sizes) > MIN_RATIO_FOR_LOG * min(sizes):
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.xaxis.set_minor_formatter(NullFormatter())
            x_label += ", logarithmic scale"
        else:
            axes.set_xlim(left=0.0)
        axes.set_xlabel(x_label, fontsize=FOREST_FONT)
    return figure


def _size_with_interval(row: ForestRow, decimals: int) -> str:
    """Text of an RMSE with its interval in brackets, if it has one."""
    size = fixed(row.rmse, decimals)
    if not math.isfinite(row.low):
        return size
    return f"{size} [{fixed(row.low, decimals)}, {fixed(row.high, decimals)}]"


@dataclass(frozen=True, eq=False)
class Cloud:
    """Samples of two quantities, (K,) each, drawn as points."""

    label: str  # name in the legend or title
    colour: str  # hexadecimal
    x: FloatArray  # horizontal coordinates, (K,)
    y: FloatArray  # vertical coordinates, (K,)


def clouds_figure(
    panels: Sequence[tuple[Sequence[Cloud], str, str, bool]],
) -> MatplotlibFigure:
    """Panels side by side, each of clouds, label of x, label of y, and whether both axes have one
    scale.

    Parameters
    ----------
    panels : sequence of tuple
        At least one; the first cloud of each is drawn larger, below the others.
    """
    with new_figure(DOUBLE_COLUMN, 3.4) as figure:
        all_axes = figure.subplots(1, len(panels), squeeze=False)[0]
        for axes, (clouds, x_label, y_label, has_equal_scales) in zip(
            all_axes, panels, strict=True
        ):
            for cloud in clouds:
                # the first one is larger, so that it stays visible below the others
                draw_cloud(axes, cloud, FIRST_MARKER_SIZE if cloud is clouds[0] else MARKER_SIZE)
            axes.set_xlabel(x_label)
            axes.set_ylabel(y_label)
            if has_equal_scales:
                axes.set_aspect("equal", adjustable="datalim")
            axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, markerscale=2)
    return figure


def agreement_figure(reference: FloatArray, estimates: Sequence[Cloud]) -> MatplotlibFigure:
    """Estimated over measured sideslip, (K,) [deg], one panel an estimator, with the line on which
    both are equal.

    Parameters
    ----------
    reference : FloatArray
        Its largest magnitude is the range of both axes.
    estimates : sequence of Cloud
        Cloud of each, x the measured and y the estimated sideslip [deg].
    """
    columns = min(len(estimates), AGREEMENT_COLUMNS)
    n_rows = math.ceil(len(estimates) / columns)
    limit = 1.05 * float(np.nanmax(np.abs(reference))) or 1.0  # of a reference that is zero
    with new_figure(DOUBLE_COLUMN, 0.4 + 1.85 * n_rows) as figure:
        grid = figure.subplots(n_rows, columns, sharex=True, sharey=True, squeeze=False)
        for axes, cloud in zip(grid.flat, estimates, strict=False):
            draw_cloud(axes, cloud)
            axes.axline((0.0, 0.0), slope=1.0, color=REFERENCE_GREY, linewidth=0.9)
            axes.set_title(_wrapped(cloud.label), loc="left", fontsize=6.5)
            axes.set_xlim(-limit, limit)
            axes.set_ylim(-limit, limit)
        for axes in grid.flat[len(estimates) :]:
            axes.set_axis_off()
        figure.supxlabel("measured sideslip [deg]", fontsize=7.5)
        figure.supylabel("estimated sideslip [deg]", fontsize=7.5)
    return figure


def _wrapped(label: str) -> str:
    """A label on lines of at most `TITLE_CHARACTERS`, an equation such as ``P = 2`` on one of
    them.
    """
    return textwrap.fill(
        label.replace(" = ", "\N{NO-BREAK SPACE}=\N{NO-BREAK SPACE}"), TITLE_CHARACTERS
    )


def draw_cloud(axes: Any, cloud: Cloud, marker_size: float = MARKER_SIZE) -> None:
    """Draw the points of a cloud, every n-th, so that a figure stays small."""
    step = max(len(cloud.x) // MAX_POINTS, 1)
    axes.plot(
        cloud.x[::step],
        cloud.y[::step],
        color=cloud.colour,
        linestyle="none",
        marker=".",
        markersize=marker_size,
        markeredgewidth=0.0,
        label=cloud.label,
    )
