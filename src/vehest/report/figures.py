"""The figures that studies share, as functions of plain arrays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from vehest.constants import FloatArray
from vehest.report.style import (
    DOUBLE_COLUMN,
    REFERENCE,
    REFERENCE_GREY,
    SINGLE_COLUMN,
    Line,
    MatplotlibFigure,
    new_figure,
    significant,
)

if TYPE_CHECKING:
    import pandas as pd

STATIC_POINTS = 500  # points of a line in `traces_figure`, about
MIN_UNIX_SECONDS = 1e8  # s, from which on times count from 1970
MAX_POINTS = 2000  # points of a line over a whole drive, about
# smallest number of samples in a bin of lateral acceleration with which it shows an error
MIN_SAMPLES_IN_BIN = 20
LABEL_STEP = 0.05  # least distance of two labels, as a share of the axis
SIDESTEP = 0.005  # shift of intervals that would cover each other, as a share of the axis
# the reference under the estimates: wide enough to show on both sides of a line
BELOW_ESTIMATES = {"color": REFERENCE_GREY, "linewidth": 2.4}
LOSSES = ("epoch", "train_loss", "validation_loss")  # columns of a training history

Errors = tuple[
    str, Line, FloatArray
]  # name of an estimator, its line, and its sideslip errors, estimate minus reference [deg], (K,)


@dataclass(frozen=True, eq=False)
class Traces:
    """Time series of one source on the common grid; NaN breaks a line."""

    label: str  # name of the source
    line: Line  # colour, dash and marker
    vy: FloatArray  # lateral velocity [m/s], shape (K,)
    sideslip: FloatArray  # sideslip angle [deg], shape (K,)


def traces_figure(
    time: FloatArray,
    reference: Traces,
    estimates: Sequence[Traces],
    rmse_sideslip: Sequence[float],
    time_label: str,
) -> MatplotlibFigure:
    """Reference and estimate over a whole test set, ``time`` (K,) [s], one row an estimator:
    lateral velocity left, sideslip right, with its RMSE [deg].

    Parameters
    ----------
    time : FloatArray
        (K,) [s].
    reference : Traces
        Drawn in every row.
    estimates : sequence of Traces
        One a row.
    rmse_sideslip : sequence of float
        Of each estimate [deg].
    time_label : str
        Of the time axis.
    """
    with new_figure(DOUBLE_COLUMN, 0.75 + 0.68 * max(len(estimates), 2)) as figure:
        grid = figure.subplots(len(estimates), 2, sharex=True, sharey="col", squeeze=False)
        for (left, right), estimate, rmse in zip(grid, estimates, rmse_sideslip, strict=True):
            for axes, measured, estimated in (
                (left, reference.vy, estimate.vy),
                (right, reference.sideslip, estimate.sideslip),
            ):
                axes.plot(*decimated(time, measured, STATIC_POINTS), **BELOW_ESTIMATES)
                axes.plot(
                    *decimated(time, estimated, STATIC_POINTS),
                    color=estimate.line.colour,
                    linewidth=0.8,
                )
                axes.margins(x=0.005)
            left.set_title(
                estimate.label,
                loc="left",
                pad=2.0,
                fontsize=7.5,
                fontweight="bold",
            )
            right.set_title(f"RMSE(β) {significant(rmse)}°", loc="right", pad=2.0, fontsize=7.0)
        for column, label in enumerate(("lateral velocity [m/s]", "sideslip angle [deg]")):
            grid[-1][column].set_xlabel(time_label)
            grid[(len(estimates) - 1) // 2][column].set_ylabel(label)
    return figure


@dataclass(frozen=True, eq=False)
class Band:
    """Half widths of the calibrated 90 % bands of one estimate, NaN where there is none."""

    estimate: Traces  # the estimate that the band belongs to
    vy: FloatArray  # half width for v [m/s], shape (K,)
    sideslip: FloatArray  # half width for β [deg], shape (K,)


def zoom_figure(
    time: FloatArray,
    ay: FloatArray | None,
    reference: Traces,
    estimates: Sequence[Traces],
    time_label: str,
    band: Band | None = None,
) -> MatplotlibFigure:
    """Reference and estimates over a short time, (K,) [s]: sideslip with a band, its error, v and,
    if given, ``ay`` (K,) [m/s²].

    Parameters
    ----------
    time : FloatArray
        (K,) [s].
    ay : FloatArray or None
        Measured; None: no panel.
    reference : Traces
        The reference, to which errors are taken.
    estimates : sequence of Traces
        The first one is drawn on top.
    time_label : str
        Of the time axis.
    band : Band or None
        Of one of the estimates.
    """
    from matplotlib.ticker import MaxNLocator

    heights = (2.0, 1.2, 1.3, 0.6) if ay is not None else (2.0, 1.2, 1.3)
    with new_figure(DOUBLE_COLUMN, 1.25 * sum(heights)) as figure:
        all_axes = list(figure.subplots(len(heights), 1, sharex=True, height_ratios=heights))
        (top, middle, below) = all_axes[:3]
        bottom = all_axes[-1]
        for estimate in reversed(estimates):
            middle.plot(time, estimate.sideslip - reference.sideslip, **_looks(estimate.line))
        draw_quantity(top, time, "sideslip", reference, estimates, band)
        draw_quantity(below, time, "vy", reference, estimates, band)
        middle.axhline(0.0, color=reference.line.colour, linewidth=0.7)
        if ay is not None:
            bottom.plot(time, ay, color="#444444", linewidth=0.8)
        labels = ("sideslip [deg]", "error of sideslip [deg]", "v [m/s]", "$a_y$ [m/s²]")
        for axes, label in zip(all_axes, labels, strict=False):
            axes.set_ylabel(label)
            axes.margins(x=0.0)
        bottom.set_xlabel(time_label)
        figure.align_ylabels()
        bottom.xaxis.set_major_locator(MaxNLocator(nbins=11, integer=True))
        legend_above(figure, top)
    return figure


def _looks(line: Line) -> dict[str, Any]:
    """Arguments of matplotlib for colour, dash and width of an estimate's line."""
    return {"color": line.colour, "linestyle": line.dash, "linewidth": 1.0}


def draw_quantity(
    axes: Any,
    time: FloatArray,
    quantity: Literal["vy", "sideslip"],
    reference: Traces | None,
    estimates: Sequence[Traces],
    band: Band | None,
) -> None:
    """Draw a quantity of estimates, the first one above the others, with a band, over a wide line
    of the reference.
    """
    for estimate in reversed(estimates):
        points = decimated(time, getattr(estimate, quantity), MAX_POINTS)
        axes.plot(*points, label=estimate.label, **_looks(estimate.line))
    if band is not None:
        centre = getattr(band.estimate, quantity)
        half_width = getattr(band, quantity)
        axes.fill_between(
            *envelope(time, centre - half_width, centre + half_width, MAX_POINTS),
            color=band.estimate.line.colour,
            alpha=0.2,
            linewidth=0.0,
            label=f"90 % band of {band.estimate.label}",
        )
    if reference is not None:
        points = decimated(time, getattr(reference, quantity), MAX_POINTS)
        axes.plot(*points, label=reference.label, zorder=1, **BELOW_ESTIMATES)


def error_histogram(estimates: Sequence[Errors]) -> MatplotlibFigure:
    """Density of the sideslip error of each estimator on common bins.

    Those beyond the axis count in the outermost bins.

    Parameters
    ----------
    estimates : sequence of Errors
        The axis ends at the largest 99.5 % quantile of their magnitudes.
    """
    with new_figure(DOUBLE_COLUMN, 3.2) as figure:
        axes = figure.add_subplot()
        limit = max(float(np.quantile(np.abs(error), 0.995)) for _, _, error in estimates)
        limit = limit if limit > 0 else 1.0
        edges = np.linspace(-limit, limit, 81)
        for name, line, error in reversed(estimates):
            counts, _ = np.histogram(np.clip(error, -limit, limit), edges)
            density = counts / len(error) / np.diff(edges)
            label = f"{name}: {significant(root_mean_square(error))}°"
            axes.stairs(
                density, edges, color=line.colour, linestyle=line.dash, linewidth=1.2, label=label
            )
        axes.axvline(0.0, color=REFERENCE.colour, linewidth=0.7)
        axes.set_xlabel("sideslip error, estimate - reference [deg]".replace("-", "\N{MINUS SIGN}"))
        axes.set_ylabel("density [1/deg]")
        axes.set_xlim(-limit, limit)
        axes.set_ylim(bottom=0.0)
        samples = len(estimates[0][2]) * (edges[1] - edges[0])
        counts_axis = axes.secondary_yaxis(
            "right", functions=(lambda density: density * samples, lambda count: count / samples)
        )
        counts_axis.set_ylabel("samples a bin")
        handles, labels = axes.get_legend_handles_labels()
        axes.legend(
            handles[::-1], labels[::-1], loc="upper right", title="RMSE(β)", alignment="left"
        )
    return figure


def error_over_ay(ay: FloatArray, estimates: Sequence[Errors]) -> MatplotlibFigure:
    """RMSE of the sideslip in bins of 1 m/s² of |a_y|, (K,) [m/s²], and how many samples each
    contains.

    Bins of fewer than 20 show none.

    Parameters
    ----------
    ay : FloatArray
        Measured, at the samples of the errors.
    estimates : sequence of Errors
        All at the same samples.
    """
    n_bins = max(math.ceil(float(np.abs(ay).max())), 1)
    edges = np.arange(n_bins + 1)
    centres = edges[:-1] + 0.5
    index = np.minimum(np.abs(ay).astype(int), n_bins - 1)
    counts = np.bincount(index, minlength=n_bins)
    with new_figure(DOUBLE_COLUMN, 3.4) as figure:
        axes, below = figure.subplots(2, 1, sharex=True, height_ratios=(3.2, 1))
        for name, line, error in reversed(estimates):
            squares = np.bincount(index, weights=np.square(error), minlength=n_bins)
            rmse = np.sqrt(
                np.divide(
                    squares, counts, out=np.full(n_bins, np.nan), where=counts >= MIN_SAMPLES_IN_BIN
                )
            )
            axes.plot(
                centres,
                rmse,
                color=line.colour,
                linestyle=line.dash,
                marker=line.marker,
                label=name,
            )
        below.bar(centres, counts, width=0.9, color="#b5b9be")
        axes.set_ylabel("RMSE(β) [deg]")
        axes.set_ylim(bottom=0.0)
        below.set_ylabel("samples")
        below.set_xlabel("$|a_y|$ [m/s²]")
        below.set_xlim(0.0, edges[-1])
        figure.align_ylabels()
        legend_above(figure, axes)
    return figure


def learning_curves(runs: Sequence[tuple[str, Line, pd.DataFrame]]) -> MatplotlibFigure:
    """Losses over the epochs, logarithmic, of runs with name, line and history.

    A marker where the validation loss is lowest.
    """
    with new_figure(DOUBLE_COLUMN, 3.0) as figure:
        left, right = figure.subplots(1, 2, sharex=True, sharey=True)
        for name, line, history in reversed(runs):
            epoch, train, validation = (history[column].to_numpy(np.float64) for column in LOSSES)
            looks = {"color": line.colour, "linestyle": line.dash}
            best = int(np.nanargmin(validation)) if np.isfinite(validation).any() else 0
            left.plot(epoch, train, label=name, **looks)
            right.plot(epoch, validation, **looks)
            for axes, losses in ((left, train), (right, validation)):
                axes.plot(
                    epoch[best],
                    losses[best],
                    color=line.colour,
                    marker=line.marker,
                    markeredgecolor="black",
                    markersize=4.5,
                )
        for axes, title in ((left, "training"), (right, "validation")):
            axes.set_title(title, loc="left")
            axes.set_yscale("log")
            axes.set_xlabel("epoch")
            axes.set_xlim(left=0)
        left.set_ylabel("loss [m²/s²]")
        legend_above(figure, left)
    return figure


@dataclass(frozen=True, eq=False)
class Reliability:
    """Coverages of one estimator's bands, each of shape (L,); NaN where not known."""

    label: str  # name of the estimator
    line: Line  # colour and marker
    coverage: FloatArray  # share of errors inside the band of each level
    low: FloatArray  # lower end of the interval of each coverage
    high: FloatArray  # upper end of the interval of each coverage


def reliability_figure(levels: Sequence[float], rows: Sequence[Reliability]) -> MatplotlibFigure:
    """Coverage over nominal level, one line an estimator with its name at the end.

    On the diagonal, coverage is as stated.

    Parameters
    ----------
    levels : sequence of float
        (L,), nominal coverages, ascending.
    rows : sequence of Reliability
        One an estimator.
    """
    nominal = np.array(levels)
    aside = SIDESTEP * (np.arange(len(rows)) - 0.5 * (len(rows) - 1))
    with new_figure(SINGLE_COLUMN * 1.55, 3.2) as figure:
        axes = figure.add_subplot()
        axes.plot([0.0, 1.0], [0.0, 1.0], color=REFERENCE.colour, linewidth=0.7)
        for position, row in enumerate(rows):
            at = nominal + aside[position]
            axes.vlines(at, row.low, row.high, color=row.line.colour, linewidth=0.8, alpha=0.6)
            axes.plot(
                at,
                row.coverage,
                color=row.line.colour,
                linestyle=row.line.dash,
                marker=row.line.marker,
            )
        lowest = float(
            np.nanmin([[row.coverage.min(), np.nanmin(row.low, initial=1.0)] for row in rows])
        )
        bottom = max(min(lowest, float(nominal[0])) - 0.05, 0.0)
        axes.set_xlim(nominal[0] - 0.05, 1.0)
        axes.set_ylim(bottom, 1.01)
        axes.set_xticks(nominal, [f"{100 * level:.0f}" for level in levels])
        axes.set_yticks(
            ticks := np.arange(np.ceil(10 * bottom) / 10, 1.01, 0.1),
            [f"{100 * tick:.0f}" for tick in ticks],
        )
        axes.set_xlabel("nominal level [%]")
        axes.set_ylabel("errors of β inside [%]")
        heights = spread_heights(
            [float(row.coverage[-1]) for row in rows], LABEL_STEP * (1.01 - bottom), 1.0
        )
        for position, (row, height) in enumerate(zip(rows, heights, strict=True)):
            axes.annotate(
                row.label,
                (float(nominal[-1] + aside[position]), float(row.coverage[-1])),
                (1.02, height),
                color=row.line.colour,
                fontsize=6.5,
                va="center",
                annotation_clip=False,
                arrowprops={
                    "arrowstyle": "-",
                    "color": row.line.colour,
                    "linewidth": 0.4,
                    "shrinkA": 1,
                    "shrinkB": 2,
                    "relpos": (0, 0.5),
                },
            )
    return figure


def spread_heights(heights: Sequence[float], step: float, top: float) -> list[float]:
    """Move heights of labels down as far as needed, so that they are at least a step apart and
    below ``top``; order is kept.
    """
    placed = [0.0] * len(heights)
    last = top + step
    for position in np.argsort([-height for height in heights], kind="stable"):
        last = min(heights[position], last - step)
        placed[int(position)] = last
    return placed


def decimated(time: FloatArray, values: FloatArray, n_points: int) -> tuple[FloatArray, FloatArray]:
    """Fewer points of a time series, (K,), that keep its peaks: lowest and highest value of each
    segment, in their order.

    Returns
    -------
    tuple of FloatArray
        About ``n_points`` points, in the order of time; a NaN of each segment with gaps stays, so
        that lines break there.
    """
    if len(values) <= n_points:
        return time, values
    indices: list[int] = []
    for segment in np.array_split(np.arange(len(values)), max(n_points // 2, 1)):
        part = values[segment]
        finite = np.isfinite(part)
        if not finite.all():
            indices.append(int(segment[np.argmin(finite)]))
        if finite.any():
            indices += [int(segment[np.nanargmin(part)]), int(segment[np.nanargmax(part)])]
    order = np.unique([0, *indices, len(values) - 1])
    return time[order], values[order]


def envelope(
    time: FloatArray, low: FloatArray, high: FloatArray, n_points: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Fewer points of the ends of a band, (K,), that contain it: lowest and highest of each
    segment.

    NaN where either end is.
    """
    if len(time) <= n_points:
        return time, low, high
    starts = np.linspace(0, len(time), n_points, endpoint=False).astype(int)
    return time[starts], np.minimum.reduceat(low, starts), np.maximum.reduceat(high, starts)


def legend_above(figure: Any, axes: Any) -> None:
    """A legend over the whole width, in the reverse of the order in which lines were drawn."""
    handles, labels = (entries[::-1] for entries in axes.get_legend_handles_labels())
    fitting = [
        n for n in range(1, len(labels) + 1) if _legend_width(labels, n) <= figure.get_figwidth()
    ]
    columns = max(fitting, default=1)
    figure.legend(
        handles,
        labels,
        loc="outside upper left",
        ncols=columns,
        columnspacing=1.2,
        handlelength=2.8,
    )


def _legend_width(labels: Sequence[str], columns: int) -> float:
    """Approximate width of a legend of 7 pt [in]; its entries fill one column after another."""
    widths = [
        max(len(label) for label in column)
        for column in np.array_split(np.array(labels, dtype=object), columns)
    ]
    return sum(0.54 + 0.052 * width for width in widths)


def root_mean_square(values: FloatArray) -> float:
    """Root mean square, gaps left out.

    NaN, with a warning of NumPy, where all values are gaps.
    """
    return float(np.sqrt(np.nanmean(np.square(values))))
