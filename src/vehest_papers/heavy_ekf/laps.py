"""Figures 6 and 10: sideslip angle over three laps and over a fast lap."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.report.document import Figure
from vehest.report.figures import decimated
from vehest.report.style import DOUBLE_COLUMN, new_figure
from vehest_papers.heavy_ekf.subjects import LINES, MEASURED, moving
from vehest_papers.kit.legends import legend_above

POINTS = 800  # a line across the page
STRAIGHT_SECONDS = 25.0
HANDLING_SECONDS = 60.0
STRAIGHT = "#b3122a"
HANDLING = "#5b8c00"
FIGURE_6 = (
    "Three laps (Figure 6 of the paper), SIMULATED. a: track, with the calmest 25 s (red) and "
    "the 60 s with the largest lateral acceleration (green). b: sideslip angle. c, d: both "
    "segments."
)


def busiest(drive: Recording, seconds: float, *, calmest: bool = False) -> tuple[float, float]:
    """The stretch of this length with the largest mean |a_y| (or the smallest, driven), [s]."""
    length = round(seconds * drive.rate_hz)
    size = np.where(drive["vx"] > 5.0, np.abs(drive["ay"]), np.inf if calmest else 0.0)
    mean = np.convolve(size, np.full(length, 1.0 / length), "valid")
    first = float(drive.time[int(np.argmin(mean) if calmest else np.argmax(mean))])
    return first, first + seconds


def figure_6(drive: Recording, estimates: Mapping[str, Estimate], minimum_speed: float) -> Figure:
    """The track, β over the three laps, and details on a straight and in the handling section."""
    straight = busiest(drive, STRAIGHT_SECONDS, calmest=True)
    handling = busiest(drive, HANDLING_SECONDS)
    x, y = _track(drive)
    with new_figure(DOUBLE_COLUMN, 5.6) as figure:
        grid = figure.add_gridspec(3, 2, height_ratios=(1.1, 1.2, 1.2))
        track = figure.add_subplot(grid[0, 0])
        course = figure.add_subplot(grid[1, :])
        bends = figure.add_subplot(grid[2, :])
        calm = figure.add_subplot(grid[0, 1])
        track.plot(x, y, color="#888888", linewidth=0.8)
        for (start, stop), colour in ((straight, STRAIGHT), (handling, HANDLING)):
            first, last = drive.index_range(start, stop)
            track.plot(x[first:last], y[first:last], color=colour, linewidth=2.0)
        track.plot(x[0], y[0], "o", color="black")
        track.set_aspect("equal", adjustable="datalim")
        track.set_xlabel("x [m]")
        track.set_ylabel("y [m]")
        track.set_title("a", loc="left", fontweight="bold")
        _sideslip(course, drive, estimates, minimum_speed, None)
        _sideslip(calm, drive, estimates, minimum_speed, straight)
        _sideslip(bends, drive, estimates, minimum_speed, handling)
        for axes, letter, colour in (
            (course, "b", "black"),
            (calm, "c", STRAIGHT),
            (bends, "d", HANDLING),
        ):
            axes.set_title(letter, loc="left", fontweight="bold", color=colour)
        legend_above(figure, course)
    return Figure("figure_6", FIGURE_6, figure)


def sideslip_figure(
    drive: Recording,
    estimates: Mapping[str, Estimate],
    minimum_speed: float,
    name: str,
    caption: str,
) -> Figure:
    """β measured and estimated over a whole drive, and the errors: Figure 10."""
    with new_figure(DOUBLE_COLUMN, 3.4) as figure:
        top, below = figure.subplots(2, 1, sharex=True, height_ratios=(1.6, 1))
        _sideslip(top, drive, estimates, minimum_speed, None)
        is_drawn = moving(drive, minimum_speed)
        for label, estimate in estimates.items():
            line = LINES[label]
            error = np.degrees(estimate["sideslip"] - drive["sideslip_ref"]) * is_drawn
            below.plot(*decimated(drive.time, error, POINTS), color=line.colour, linewidth=0.8)
        top.set_xlabel("")
        below.axhline(0.0, color=MEASURED.colour, linewidth=0.6)
        below.set_ylabel("error of β [deg]")
        below.set_xlabel("time [s]")
        figure.align_ylabels()
        legend_above(figure, top)
    return Figure(name, caption, figure)


def _sideslip(
    axes: Any,
    drive: Recording,
    estimates: Mapping[str, Estimate],
    minimum_speed: float,
    stretch: tuple[float, float] | None,
) -> None:
    first, last = drive.index_range(*stretch) if stretch else (0, len(drive))
    is_drawn = moving(drive, minimum_speed)[first:last]
    time = drive.time[first:last]
    measured = np.degrees(drive["sideslip_ref"][first:last]) * is_drawn
    axes.plot(*decimated(time, measured, POINTS), color="#8a8a8a", linewidth=0.8, label="measured")
    for label, estimate in estimates.items():
        line = LINES[label]
        values = np.degrees(estimate["sideslip"][first:last]) * is_drawn
        axes.plot(
            *decimated(time, values, POINTS),
            color=line.colour,
            linestyle=line.dash,
            linewidth=0.9,
            label=label,
        )
    low, high = np.nanquantile(measured, [0.001, 0.999])
    room = 0.35 * (high - low) + 0.2
    axes.set_ylim(low - room, high + room)
    axes.set_ylabel("β [deg]")
    axes.set_xlabel("time [s]")
    axes.margins(x=0.0)


def _track(drive: Recording) -> tuple[FloatArray, FloatArray]:
    """Where the car went, by dead reckoning [m]."""
    step = 1.0 / drive.rate_hz
    yaw = np.cumsum(drive["yaw_rate_ref"]) * step
    vx = drive["vx_ref"]
    vy = drive["vy_ref"]
    return np.cumsum(vx * np.cos(yaw) - vy * np.sin(yaw)) * step, np.cumsum(
        vx * np.sin(yaw) + vy * np.cos(yaw)
    ) * step
