"""A recording and estimates of it on one page: β and v, channels, the course, the error."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.runs import true_runs
from vehest.data.time_series import TimeSeries
from vehest.estimators.registry import estimator_class, estimator_names
from vehest.evaluation.metrics import (
    Scored,
    accuracy,
    is_fast_enough,
    min_sideslip_speed,
    moves_forward,
    score_whole,
    with_vy_ref,
)
from vehest.report.comparison_figures import Cloud, draw_cloud
from vehest.report.document import png_of
from vehest.report.explorer import in_display_unit, reckoned_course
from vehest.report.figures import (
    MAX_POINTS,
    MIN_UNIX_SECONDS,
    Band,
    Traces,
    decimated,
    draw_quantity,
    legend_above,
)
from vehest.report.style import (
    DOUBLE_COLUMN,
    REFERENCE,
    REFERENCE_GREY,
    lines_of,
    paper_style,
    significant,
)

CHANNEL_LABELS = {
    "vx": "speed u",
    "yaw_rate": "yaw rate",
    "ay": "$a_y$",
    "ax": "$a_x$",
    "steer": "steering",
    "handwheel": "handwheel",
}
"""Measured channels that are drawn, in this order, with their labels."""
# code of health, except valid -> its name and colour
HEALTH = {1: ("degraded", "#e69f00"), 2: ("invalid", "#6b1414")}
VALID_COLOUR = "#dfe4e8"  # colour of valid samples in the panel of health
CHANNEL_COLOUR = "#33373b"  # colour of measured channels
# colours of the course with β to the right, none, and to the left
COURSE_COLOURS = ("#0072b2", "#b9bec4", "#d55e00")
# kind of panel -> its height, in
HEIGHTS = {"sideslip": 1.75, "health": 0.13, "vy": 1.15, "channel": 0.62, "course": 2.45}

DASHES = ("solid", "dashed", "dotted", "dashdot")  # dashes of estimates by the same estimator
NOTEBOOK_DPI = 110  # resolution of the figure in a notebook
MIN_AXIS = 0.1  # deg, smallest half width of the axes of estimate over reference
Draw = Callable[[Axes], None]  # draws a panel into axes


class DriveFigure(Figure):
    """A figure that a notebook shows without pyplot."""

    def _repr_png_(self) -> bytes:
        """The figure as PNG, for a notebook."""
        return png_of(self, NOTEBOOK_DPI)


@dataclass(frozen=True, eq=False)
class Drive:
    """Signals of a drive on one clock, (T,) each."""

    title: str  # title of the figure
    time: FloatArray  # [s]
    time_label: str  # label of the time axis
    recording: Recording | None  # recording with the measured channels; None: none
    reference: Traces | None  # reference v and β; None: none
    estimates: Sequence[Traces]  # estimated v and β
    band: Band | None  # 90 % band of the first estimate
    health: FloatArray | None  # health code of the first estimate, (T,)

    @property
    def has_motion(self) -> bool:
        """Whether there is any v and β to draw."""
        return bool(self.estimates) or self.reference is not None


def drive_figure(
    recording: Recording | None,
    estimates: Sequence[Estimate] = (),
    start: float | None = None,
    stop: float | None = None,
) -> Figure:
    """Draw a drive on one page for print, in colours that colour-blind readers distinguish.

    Sideslip with the 90 % band and the health of the first estimate; lateral velocity; the measured
    channels; the course, integrated from u, v and yaw rate, in colours of β; estimate over
    reference. What is not there is left out. β is drawn where the car moves forward at the speed
    from which on it is scored (`min_sideslip_speed`).

    Parameters
    ----------
    recording : Recording, optional
        The drive; its reference is drawn where it has ``vy_ref`` or ``sideslip_ref``.
    estimates : sequence of Estimate
        Of this recording.
    start, stop : float, optional
        Range that is drawn [s]; by default all of it.

    Returns
    -------
    Figure
        As wide as both columns of a journal; a notebook shows it by itself.

    Raises
    ------
    DataError
        There is nothing to draw, or the range contains no samples.
    """
    drive = _drive_of(recording, estimates, start, stop)
    panels = _time_panels(drive)
    if not panels:
        raise DataError(
            "there is nothing to draw: no estimate, no reference "
            f"and none of {', '.join(CHANNEL_LABELS)}"
        )
    below = _panels_below(drive, estimates)
    heights = [HEIGHTS[height] for height, _ in panels] + [HEIGHTS["course"]] * bool(below)
    with paper_style():
        figure = DriveFigure(figsize=(DOUBLE_COLUMN, sum(heights) + 0.7), layout="constrained")
        grid = figure.add_gridspec(len(heights), max(len(below), 1), height_ratios=heights)
        timed: list[Axes] = []
        for row, (_, draw) in enumerate(panels):
            timed.append(figure.add_subplot(grid[row, :], sharex=timed[0] if timed else None))
            draw(timed[-1])
            timed[-1].tick_params(labelbottom=row == len(panels) - 1)
        timed[0].set_xlim(drive.time[0], drive.time[-1])
        timed[-1].set_xlabel(drive.time_label)
        figure.align_ylabels(timed)
        for column, draw in enumerate(below):
            draw(figure.add_subplot(grid[-1, column]))
        if drive.has_motion:
            legend_above(figure, timed[0])
        timed[0].set_title(drive.title, loc="left", fontweight="bold")
    return figure


def _drive_of(
    recording: Recording | None,
    estimates: Sequence[Estimate],
    start: float | None,
    stop: float | None,
) -> Drive:
    """Signals of a drive on the clock of the recording, or of the first estimate without one;
    raises `DataError` where the range has no samples.
    """
    clock: TimeSeries = recording if recording is not None else estimates[0]
    first = -math.inf if start is None else start
    end = math.inf if stop is None else stop
    if recording is not None:
        recording = with_vy_ref(recording.cut(first, end))
        clock = recording
    time = clock.time[(clock.time >= first) & (clock.time < end)]
    if not len(time):
        raise DataError(f"{clock!r} has no samples between {first:g} s and {end:g} s")
    names = [estimate.estimator for estimate in estimates]
    lines = lines_of(dict.fromkeys((name, "") for name in names))
    traces = []
    reference = _reference_of(recording)
    min_speed = _min_speed(recording)
    for place, estimate in enumerate(estimates):
        name = names[place]
        count = names[:place].count(name)  # earlier estimates of the same estimator
        line = lines[name, ""]
        traces.append(
            Traces(
                f"{_title_of(name)} ({count + 1})" if count else _title_of(name),
                replace(line, dash=DASHES[count % len(DASHES)]) if count else line,
                _at(time, estimate, "vy"),
                _drawn_sideslip(time, estimate, min_speed, reference),
            )
        )
    band = health = None
    if estimates:
        channels = estimates[0].channels
        if {"band_vy", "band_sideslip"} <= channels.keys():
            half_vy = _at(time, estimates[0], "band_vy")
            half_sideslip = np.degrees(_at(time, estimates[0], "band_sideslip"))
            band = Band(traces[0], half_vy, half_sideslip)
        if "health" in channels:
            health = estimates[0].held_at(time, "health")
    title = recording.id if recording is not None else estimates[0].recording_id
    time_label = "time [s]"
    if time[0] >= MIN_UNIX_SECONDS:
        time = time - time[0]
        time_label = "time after the start [s]"
    return Drive(title, time, time_label, recording, reference, traces, band, health)


def _min_speed(recording: Recording | None) -> float:
    """Speed from which on sideslip is drawn [m/s]."""
    return min_sideslip_speed(None if recording is None else recording.car.wheelbase)


def _drawn_sideslip(
    time: FloatArray, estimate: Estimate, min_speed: float, reference: Traces | None
) -> FloatArray:
    """Estimated β at some times, (K,) [deg]; NaN where it is not drawn.

    Where the reference has v, that decides, as in scores, else the measured u.
    """
    is_forward = moves_forward(estimate["vy"], estimate["sideslip"], min_speed)
    is_drawn = np.interp(time, estimate.time, is_forward.astype(np.float64)) == 1.0
    if reference is not None:
        is_drawn = np.where(np.isfinite(reference.vy), np.isfinite(reference.sideslip), is_drawn)
    return np.where(is_drawn, np.degrees(_at(time, estimate, "sideslip")), np.nan)


def _at(time: FloatArray, estimate: Estimate, name: str) -> FloatArray:
    """A quantity at other times, on straight lines between its samples; NaN outside."""
    return np.interp(time, estimate.time, estimate[name], left=np.nan, right=np.nan)


def _title_of(estimator: str) -> str:
    """Title of an estimator that vehest has; of another tool's, its name."""
    return estimator_class(estimator).title if estimator in estimator_names() else estimator


def _reference_of(recording: Recording | None) -> Traces | None:
    """Reference v and β, which is NaN where the car is too slow for a score, or reverses."""
    if recording is None or not {"vx", "vy_ref"} <= recording.channels.keys():
        return None
    vx = recording["vx"]
    vy = recording["vy_ref"]
    is_drawn = is_fast_enough(vx, vy, _min_speed(recording)) & (vx >= 0.0)
    sideslip = np.where(is_drawn, np.degrees(np.arctan2(vy, vx)), np.nan)
    return Traces("reference", REFERENCE, vy, sideslip)


def _time_panels(drive: Drive) -> list[tuple[str, Draw]]:
    """Key of the height in `HEIGHTS` and drawing function of each panel over time, from top to
    bottom.
    """
    panels: list[tuple[str, Draw]] = []
    if drive.has_motion:
        panels.append(("sideslip", partial(_draw_motion, drive, "sideslip")))
        if drive.health is not None:
            panels.append(("health", partial(_draw_health, drive.time, drive.health)))
        panels.append(("vy", partial(_draw_motion, drive, "vy")))
    if drive.recording is not None:
        names = [name for name in CHANNEL_LABELS if name in drive.recording]
        panels += [("channel", partial(_draw_channel, drive, name)) for name in names]
    return panels


def _draw_motion(drive: Drive, quantity: Literal["sideslip", "vy"], axes: Axes) -> None:
    """Panel of β or v: reference, estimates and band; beside β, how long health was not valid."""
    if quantity == "sideslip" and drive.health is not None:
        for status, (name, colour) in reversed(HEALTH.items()):
            share = float(np.mean(drive.health == status))
            if share > 0:
                label = f"{name}, {100 * share:.2g} % of the time"
                axes.fill_between([], [], color=colour, label=label)  # for the legend alone
    draw_quantity(axes, drive.time, quantity, drive.reference, drive.estimates, drive.band)
    axes.set_ylabel({"sideslip": "sideslip β\n[deg]", "vy": "v [m/s]"}[quantity])


def _draw_health(time: FloatArray, health: FloatArray, axes: Axes) -> None:
    """Narrow panel that shows over time whether the first estimate is valid, degraded or
    invalid.
    """
    step = float(time[1] - time[0]) if len(time) > 1 else 1.0
    axes.set_facecolor(VALID_COLOUR)
    for status, (_, colour) in HEALTH.items():
        runs = true_runs(health == status)
        bars = [(time[first], (end - first) * step) for first, end in runs.tolist()]
        axes.broken_barh(bars, (0.0, 1.0), facecolors=colour, linewidth=0.3, edgecolor=colour)
    axes.set_ylim(0.0, 1.0)
    axes.set_yticks([])
    axes.grid(visible=False)
    axes.set_ylabel("health", rotation=0, ha="right", va="center")


def _draw_channel(drive: Drive, name: str, axes: Axes) -> None:
    """Panel of a measured channel in its display unit."""
    assert drive.recording is not None
    values, unit = in_display_unit(name, drive.recording[name])
    axes.plot(*decimated(drive.time, values, MAX_POINTS), color=CHANNEL_COLOUR, linewidth=0.8)
    axes.set_ylabel(f"{CHANNEL_LABELS[name]}\n[{unit}]")


def _panels_below(drive: Drive, estimates: Sequence[Estimate]) -> list[Draw]:
    """Drawing functions of the course and of estimate over reference, as far as they can be
    drawn.
    """
    recording = drive.recording
    if recording is None:
        return []
    panels: list[Draw] = []
    motion = [*drive.estimates, *([drive.reference] if drive.reference else [])]
    motion = [traces for traces in motion if np.isfinite(traces.sideslip).any()]
    if motion and {"vx", "yaw_rate"} <= recording.channels.keys():
        panels.append(partial(_draw_course, recording, motion[0]))
    if drive.reference is not None and drive.estimates:
        with suppress(DataError):  # too short, or gaps in the reference: not scored
            scored = [score_whole(estimate, recording) for estimate in estimates]
            panels.append(partial(_draw_errors, drive.estimates, scored))
    return panels


def _draw_course(recording: Recording, motion: Traces, axes: Axes) -> None:
    """Panel of the course in the plane, coloured by β [deg], with its start."""
    step = 1.0 / recording.rate_hz
    x, y = reckoned_course(recording["vx"], motion.vy, recording["yaw_rate"], step)
    stride = max(len(x) // MAX_POINTS, 1)
    points = np.stack([x, y], axis=1)[::stride]
    scale = LinearSegmentedColormap.from_list("sideslip", COURSE_COLOURS)
    colours = scale.with_extremes(bad=COURSE_COLOURS[1])
    limit = float(np.nanquantile(np.abs(motion.sideslip), 0.995)) or 1.0
    course = LineCollection(
        list(np.stack([points[:-1], points[1:]], axis=1)),
        array=motion.sideslip[::stride][:-1],
        cmap=colours,
        norm=Normalize(-limit, limit),
        linewidth=1.6,
        capstyle="round",
    )
    axes.add_collection(course)
    start = points[np.isfinite(points).all(axis=1)][0]
    axes.plot(*start, "k^", markersize=5.0)
    background = {"facecolor": "white", "alpha": 0.8, "linewidth": 0.0, "pad": 0.6}
    axes.annotate("start", start, (5, 5), textcoords="offset points", bbox=background)
    axes.set_aspect("equal", adjustable="datalim")
    axes.autoscale()
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.set_title("course integrated from u, v and yaw rate", loc="left")
    bar = axes.figure.colorbar(course, ax=axes, extend="both", shrink=0.85)
    bar.ax.set_title("β [deg]", fontsize=7.0)


def _draw_errors(estimates: Sequence[Traces], scored: Sequence[Scored], axes: Axes) -> None:
    """Panel of estimated over reference β [deg], with the RMSE of each estimate in the legend."""
    for traces, part in zip(reversed(estimates), reversed(scored), strict=True):
        chosen = part.is_sideslip_drawn
        draw_cloud(
            axes,
            Cloud(
                f"RMSE {significant(accuracy([part])['rmse_sideslip'])}°",
                traces.line.colour,
                np.degrees(part.sideslip_ref)[chosen],
                np.degrees(part.sideslip)[chosen],
            ),
            marker_size=2.5,
        )
    axes.axline((0.0, 0.0), slope=1.0, color=REFERENCE_GREY, linewidth=0.9)
    limit = max(np.abs([axes.get_xlim(), axes.get_ylim()]).max(), MIN_AXIS)
    axes.set(xlim=(-limit, limit), ylim=(-limit, limit), box_aspect=1.0)
    axes.set_xlabel("reference β [deg]")
    axes.set_ylabel("estimated β [deg]")
    axes.set_title("estimate over reference", loc="left")
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(handles[::-1], labels[::-1], loc="upper left", markerscale=3)
