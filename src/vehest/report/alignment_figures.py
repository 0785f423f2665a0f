"""What an alignment was estimated from: cross-correlation, residuals before and after, steering."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy import signal

from vehest.alignment.align import Alignment, Residual, Steering
from vehest.alignment.imu import Correlation
from vehest.constants import FloatArray
from vehest.report.figures import decimated
from vehest.report.style import (
    DOUBLE_COLUMN,
    LINEAR_BLUES,
    LUENBERGER_GREY,
    NONLINEAR_ORANGES,
    REFERENCE,
    MatplotlibFigure,
    fixed,
    new_figure,
    significant,
    with_unit,
)

POINTS = 2500
SCATTER_POINTS = 1500
OVERVIEW_HEIGHT, STEERING_HEIGHT = 1.9, 2.0  # of the height of a residual
SYMBOLS = {"ax": "$a_x$", "ay": "$a_y$", "yaw_rate": "yaw rate"}

LABELS = {"before": "before", "after": "after", "rest": "and without tilt"}

_BEFORE, _AFTER, _REST = LUENBERGER_GREY, LINEAR_BLUES[1], NONLINEAR_ORANGES[0]


def alignment_figure(alignment: Alignment) -> MatplotlibFigure:
    """Cross-correlation and spectra of the residuals side by side, residuals over time below, and the steering relation."""
    residuals, steering = alignment.residuals, alignment.steering
    heights = [*([OVERVIEW_HEIGHT] if residuals else []), *([1.0] * len(residuals)), *([STEERING_HEIGHT] if steering else [])]
    with new_figure(DOUBLE_COLUMN, 0.3 + 1.25 * sum(heights)) as figure:
        grid = figure.add_gridspec(len(heights), 2, height_ratios=heights)
        shared = None
        if residuals:
            _draw_correlation(figure.add_subplot(grid[0, 0]), alignment)
            _draw_spectra(figure.add_subplot(grid[0, 1]), alignment)
        for row, residual in enumerate(residuals, start=1):
            axes = figure.add_subplot(grid[row, :], sharex=shared)
            shared = shared or axes
            _draw_residual(axes, residual, last=row == len(residuals))
        if steering:
            _draw_steering(figure.add_subplot(grid[-1, :]), steering, alignment)
        figure.align_ylabels()
    return figure


def _draw_correlation(axes: Any, alignment: Alignment) -> None:
    correlation = alignment.correlation
    assert isinstance(correlation, Correlation)
    axes.plot(1e3 * correlation.lag, correlation.value, color=_BEFORE, label=f"{correlation.signal}s")
    axes.plot(1e3 * correlation.peak, correlation.highest, marker="o", linestyle="none", color=_BEFORE, label="peak")
    delays = [parameter for parameter in alignment.parameters if parameter.name == "delay"]
    for delay in delays:
        axes.axvspan(1e3 * delay.low, 1e3 * delay.high, color=_AFTER, alpha=0.18, linewidth=0)
        axes.axvline(1e3 * delay.value, color=_AFTER, label=f"estimate {fixed(1e3 * delay.value, 1)} ms")
    axes.set_xlabel("lag of the sensor [ms]")
    axes.set_ylabel("cross-correlation")
    axes.margins(x=0.0)
    _legend_above(axes)


def _draw_spectra(axes: Any, alignment: Alignment) -> None:
    """Amplitude densities of the residuals of ax and ay together."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    plane = [residual for residual in alignment.residuals if residual.channel != "yaw_rate"]
    highest = 2.0 * alignment.settings.cutoff_hz
    drawn = []
    looks = [("before", _BEFORE), ("after", _AFTER), *([("rest", _REST)] if plane[0].rest is not None else [])]
    for name, colour in looks:
        densities = [_density(residual.time_before, getattr(residual, name)) for residual in plane]
        frequency, density = densities[0][0], np.sqrt(sum(power for _, power in densities))
        inside = (frequency > 0) & (frequency <= highest)
        axes.loglog(frequency[inside], density[inside], color=colour, label=LABELS[name])
        drawn.append(density[inside])
    axes.axvline(alignment.settings.cutoff_hz, color=REFERENCE.colour, linewidth=0.6, linestyle="dotted")
    axes.text(alignment.settings.cutoff_hz, 0.03, "cut-off ", transform=axes.get_xaxis_transform(), ha="right", fontsize=6.5)
    axes.set_ylim(
        bottom=0.7 * float(np.concatenate(drawn).min()),
        top=max(float(np.concatenate(drawn).max()) * 1.4, 10.0 * float(np.concatenate(drawn).min())),
    )
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel("residual of $a_x$, $a_y$ [m/s²/√Hz]")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    _legend_above(axes)


def _density(time: FloatArray, samples: FloatArray) -> tuple[FloatArray, FloatArray]:
    rate_hz = 1.0 / float(time[1] - time[0])
    length = min(len(samples), 2 ** math.ceil(math.log2(20.0 * rate_hz)))
    return signal.welch(samples, fs=rate_hz, nperseg=length, detrend=False)


def _draw_residual(axes: Any, residual: Residual, *, last: bool) -> None:
    lines = [
        ("before", residual.time_before, residual.before, residual.rms["before"], _BEFORE),
        ("after", residual.time_after, residual.after, residual.rms["after"], _AFTER),
    ]
    if residual.rest is not None:
        lines.append(("rest", residual.time_after, residual.rest, residual.rms["rest"], _REST))
    for name, time, values, size, colour in lines:
        label = f"{LABELS[name]}: {significant(size)} {residual.unit} rms"
        axes.plot(*decimated(time, values, POINTS), color=colour, linewidth=0.7, label=label)
    axes.axhline(0.0, color=REFERENCE.colour, linewidth=0.5)
    axes.set_ylabel(with_unit(SYMBOLS[residual.channel], residual.unit))
    axes.margins(x=0.005)
    _legend_above(axes)
    axes.tick_params(labelbottom=last)
    if last:
        axes.set_xlabel("time [s]")


def _draw_steering(axes: Any, steering: Steering, alignment: Alignment) -> None:
    thin = slice(None, None, max(len(steering.expected) // SCATTER_POINTS, 1))
    ratio, offset = alignment["steering_ratio"], alignment["steering_offset"]
    expected, measured = np.degrees(steering.expected), np.degrees(steering.measured)
    axes.plot(expected[thin], measured[thin], linestyle="none", marker=".", markersize=1.5, color=_BEFORE, label="calm driving")
    ends = np.array([expected.min(), expected.max()])
    axes.plot(ends, ratio.value * ends + math.degrees(offset.value), color=_AFTER, label=f"ratio {significant(ratio.value)}")
    axes.set_xlabel("road-wheel angle by curvature and $a_y$ [deg]")
    axes.set_ylabel(f"{steering.channel} [deg]")
    axes.legend(loc="upper left")


def _legend_above(axes: Any) -> None:
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, borderaxespad=0.1, columnspacing=1.2, handlelength=1.6)
