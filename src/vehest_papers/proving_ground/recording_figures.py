"""Figures of recordings themselves: traces, handling diagram, distributions and spectra, as functions of plain arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.report.figures import decimated
from vehest.report.style import DOUBLE_COLUMN, LINEAR_BLUES, NONLINEAR_ORANGES, OTHER_COLOURS, new_figure, paper_style

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

POINTS = 1200
GREYS = 12
FARTHEST_ANGLE = 6.0  # deg, to which a characteristic is shown beyond the samples
GAP_SHARE = 0.012  # of the time axis, between two stretches
SOURCES = {"simulated": (LINEAR_BLUES[1], "solid"), "real": (NONLINEAR_ORANGES[1], "dashed")}
_CURVES = ((LINEAR_BLUES[1], "solid"), (NONLINEAR_ORANGES[0], "dashed"), (OTHER_COLOURS[0], "dashdot"), (OTHER_COLOURS[2], "dotted"))


@dataclass(frozen=True, eq=False)
class Trace:
    """A stretch of a recording.

    Args:
        label: written above it.
        time: from its beginning (K,) [s].
        values: quantity with unit -> samples (K,).
    """

    label: str
    time: FloatArray
    values: Mapping[str, FloatArray]


@dataclass(frozen=True, eq=False)
class Curve:
    """A line of the handling diagram.

    Args:
        label: for the legend.
        ay: (M,) [m/s²].
        angle: (M,) [deg].
        gradient: slope of the straight line through the origin that belongs to it [deg/(m/s²)].
    """

    label: str
    ay: FloatArray
    angle: FloatArray
    gradient: float


@dataclass(frozen=True, eq=False)
class Points:
    """Medians in the handling diagram.

    Args:
        kind: ``real`` or ``simulated``.
        ay: (M,) [m/s²].
        angle: (M,) [deg].
    """

    kind: str
    ay: FloatArray
    angle: FloatArray


@dataclass(frozen=True, eq=False)
class Distribution:
    """Counts in bins.

    Args:
        kind: ``real`` or ``simulated``.
        edges: (B + 1,).
        counts: (B,).
    """

    kind: str
    edges: FloatArray
    counts: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Amplitude density of a channel.

    Args:
        kind: ``real`` or ``simulated``.
        frequency: (F,) [Hz].
        density: (F,) [unit/√Hz].
    """

    kind: str
    frequency: FloatArray
    density: FloatArray


def recording_traces(traces: Sequence[Trace]) -> MatplotlibFigure:
    """A row a quantity, stretches side by side on one time axis with gaps between them."""
    quantities = list(traces[0].values)
    total = sum(float(trace.time[-1] - trace.time[0]) for trace in traces)
    with paper_style():
        figure = new_figure(DOUBLE_COLUMN, 0.6 + 0.85 * len(quantities))
        rows = figure.subplots(len(quantities), 1, sharex=True)
        offset = 0.0
        for trace in traces:
            at = offset + trace.time - trace.time[0]
            for axes, quantity in zip(rows, quantities, strict=True):
                shown = decimated(at, trace.values[quantity], max(round(POINTS * (at[-1] - at[0]) / total), 60))
                axes.plot(*shown, color=SOURCES["simulated"][0], linewidth=0.9)
            rows[0].annotate(
                trace.label,
                (at[0], 1.0),
                xycoords=("data", "axes fraction"),
                xytext=(1, 3 + 8 * (traces.index(trace) % 2 if len(traces) > 4 else 0)),
                textcoords="offset points",
                fontsize=6.5,
            )
            offset = float(at[-1]) + GAP_SHARE * total
            if trace is not traces[-1]:
                for axes in rows:
                    axes.axvline(offset - 0.5 * GAP_SHARE * total, color="#b5b9be", linewidth=0.8)
        for axes, quantity in zip(rows, quantities, strict=True):
            axes.set_ylabel(quantity)
            axes.set_xlim(-0.005 * total, offset)
            axes.margins(y=0.08)
            if axes.get_ylim()[0] < 0 < axes.get_ylim()[1]:
                axes.axhline(0.0, color="#888888", linewidth=0.5)
        rows[-1].set_xlabel("time [s]" if len(traces) == 1 else "time, stretches end to end [s]")
        figure.align_ylabels()
    return figure


def handling_figure(
    edges: tuple[FloatArray, FloatArray], counts: NDArray[np.int64], curves: Sequence[Curve], medians: Sequence[Points]
) -> MatplotlibFigure:
    """Understeer angle over centripetal acceleration: all samples in grey, medians of steady turns, the plant's own characteristic.

    Args:
        edges: of the bins, (A + 1,) [m/s²] and (B + 1,) [deg].
        counts: all samples, (A, B).
        curves: at most four.
        medians: of quasi-steady turns.
    """
    from matplotlib.colors import LinearSegmentedColormap, LogNorm

    with paper_style():
        figure = new_figure(DOUBLE_COLUMN, 3.6)
        axes = figure.add_subplot()
        greys = LinearSegmentedColormap.from_list("greys", ["#ececec", "#7d7d7d"], N=GREYS)
        shown = np.ma.masked_equal(counts.T, 0)
        mesh = axes.pcolormesh(*edges, shown, cmap=greys, norm=LogNorm(1, max(int(counts.max()), 10)), rasterized=True, zorder=1)
        for (colour, dash), curve in zip(_CURVES, curves, strict=False):
            axes.plot(curve.ay, curve.angle, color=colour, linestyle=dash, linewidth=1.5, label=f"plant, {curve.label}", zorder=4)
        for (colour, _), curve in zip(_CURVES, curves, strict=False):
            if curve.gradient not in [other.gradient for other in curves[: list(curves).index(curve)]]:
                ends = np.array([-6.0, 6.0])
                label = f"linear single track, {curve.label.split(',')[0]}: {curve.gradient:.3f}°/(m/s²)".replace("-", "\N{MINUS SIGN}")
                axes.plot(ends, curve.gradient * ends, color=colour, linewidth=0.7, linestyle=(0, (6, 2)), label=label, zorder=3)
        for points in medians:
            filled = SOURCES[points.kind][0] if points.kind == "real" else "white"
            marker = "D" if points.kind == "real" else "o"
            label = f"median of steady turns, {points.kind}"
            looks: dict[str, Any] = {"markeredgecolor": "black", "markerfacecolor": filled, "markeredgewidth": 0.7, "markersize": 3.6}
            axes.plot(points.ay, points.angle, linestyle="none", marker=marker, label=label, zorder=5, **looks)
        axes.set_xlim(*_reach(edges[0], counts.sum(axis=1), [curve.ay for curve in curves]))
        shown_curves = [np.clip(curve.angle, -FARTHEST_ANGLE, FARTHEST_ANGLE) for curve in curves]
        axes.set_ylim(*_reach(edges[1], counts.sum(axis=0), shown_curves, share=0.001))
        axes.set_xlabel("speed × yaw rate [m/s²], positive in a left turn")
        axes.set_ylabel("steer \N{MINUS SIGN} arctan(L·yaw rate/speed) [deg]")
        bar = figure.colorbar(mesh, ax=axes, pad=0.01, aspect=30)
        bar.set_label("samples a bin")
        bar.outline.set_visible(False)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper left", ncols=2, columnspacing=1.4, handlelength=2.8)
    return figure


MOST_SIDESLIP = 20.0
"""Beyond it a distribution of the sideslip angle is not drawn [deg]: cars that spin would press all others into a line."""


def beyond(distributions: Sequence[Distribution], limit: float) -> float:
    """Share of all samples in bins beyond ±limit [%]."""
    total = sum(int(own.counts.sum()) for own in distributions)
    outside = sum(int(own.counts[(own.edges[1:] <= -limit) | (own.edges[:-1] >= limit)].sum()) for own in distributions)
    return 100.0 * outside / max(total, 1)


def distribution_figure(
    sideslip: Sequence[Distribution],
    ay: Sequence[Distribution],
    *,
    sideslip_limit: float | None = None,
    ay_limit: float | None = None,
    limit_label: str = "",
) -> MatplotlibFigure:
    """Shares of samples in bins, logarithmic: sideslip left, lateral acceleration right.

    Args:
        sideslip: in degrees.
        ay: in m/s².
        sideslip_limit: marked at either side [deg].
        ay_limit: likewise [m/s²].
        limit_label: what the marks are.
    """
    from matplotlib.ticker import FuncFormatter

    with paper_style():
        figure = new_figure(DOUBLE_COLUMN, 2.7)
        left, right = figure.subplots(1, 2, sharey=True)
        lowest = 1.0
        for axes, distributions, limit in ((left, sideslip, sideslip_limit), (right, ay, ay_limit)):
            reach = 1.0
            for own in distributions:
                shares, (colour, dash) = 100.0 * own.counts / max(int(own.counts.sum()), 1), SOURCES[own.kind]
                filled = own.kind == "simulated"
                axes.stairs(shares, own.edges, color=colour, fill=filled, alpha=0.25 if filled else 1.0, linewidth=0)
                axes.stairs(shares, own.edges, color=colour, linestyle=dash, linewidth=1.2, label=own.kind)
                occupied = np.flatnonzero(own.counts)
                if len(occupied):
                    reach = max(reach, abs(own.edges[occupied[0]]), abs(own.edges[occupied[-1] + 1]))
                    lowest = min(lowest, float(shares[shares > 0].min()))
            if limit is not None:
                for side in (-1, 1):
                    label = limit_label if side > 0 else None
                    axes.axvline(side * limit, color="black", linestyle="dotted", linewidth=1.0, label=label)
            axes.set_yscale("log")
            shown = min(reach, MOST_SIDESLIP) if distributions is sideslip else reach
            axes.set_xlim(-1.03 * shown, 1.03 * shown)
            if shown < reach:
                axes.set_title(f"not shown: {beyond(distributions, shown):.2g} % of samples beyond ±{shown:g}°", fontsize="small")
        left.set_ylim(bottom=0.6 * lowest, top=100.0)
        left.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        left.set_ylabel("share of samples [%]")
        left.set_xlabel("sideslip angle, bins of 1° [deg]")
        right.set_xlabel("lateral acceleration, bins of 1 m/s² [m/s²]")
        handles, labels = right.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=len(labels), columnspacing=1.4)
    return figure


def spectra_figure(spectra: Mapping[str, Sequence[Spectrum]], marked_hz: float) -> MatplotlibFigure:
    """Amplitude densities, one panel a channel.

    Args:
        spectra: channel with unit -> its spectra.
        marked_hz: frequency above which it is read as noise [Hz].
    """
    columns = 3
    with paper_style():
        figure = new_figure(DOUBLE_COLUMN, 0.4 + 1.75 * -(-len(spectra) // columns))
        grid = figure.subplots(-(-len(spectra) // columns), columns, sharex=True, squeeze=False)
        for axes, (quantity, own) in zip(grid.flat, spectra.items(), strict=False):
            for spectrum in own:
                colour, dash = SOURCES[spectrum.kind]
                style: Any = "solid" if dash == "solid" else (0, (3, 1))
                axes.loglog(spectrum.frequency, spectrum.density, color=colour, linestyle=style, linewidth=0.9, label=spectrum.kind)
            axes.axvline(marked_hz, color="black", linestyle="dotted", linewidth=0.8)
            axes.set_title(quantity, loc="left", fontsize=7.5, pad=2.5)
        for axes in grid.flat[len(spectra) :]:
            axes.set_visible(False)
        for axes in grid[-1]:
            axes.set_xlabel("frequency [Hz]")
        figure.legend(*grid[0][0].get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return figure


def _reach(edges: FloatArray, counts: NDArray[np.int64], curves: Sequence[FloatArray], share: float = 0.0) -> tuple[float, float]:
    """Limits of an axis that show the curves and all but a share of the samples at either end, the same to both sides of zero."""
    total, reach = int(counts.sum()), 1.0
    if total:
        inside = np.flatnonzero((np.cumsum(counts) > share * total) & (np.cumsum(counts[::-1])[::-1] > share * total))
        reach = max(abs(float(edges[inside[0]])), abs(float(edges[inside[-1] + 1])))
    reach = max([reach, *(float(np.abs(curve).max()) for curve in curves)])
    return -1.04 * reach, 1.04 * reach
