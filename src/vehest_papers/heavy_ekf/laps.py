"""Figures 5 to 7, 10 and 11: speeds of the wheels, and the sideslip angle over the laps and the fast lap."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data.derived import SpeedFromWheels
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.report.document import Figure
from vehest.report.figures import decimated
from vehest.report.style import DOUBLE_COLUMN, fixed, new_figure
from vehest_papers.heavy_ekf import paper
from vehest_papers.heavy_ekf.subjects import LINES, MEASURED, moving
from vehest_papers.kit.legends import legend_above

POINTS = 800  # a line across the page
STRAIGHT_SECONDS = 25.0
HANDLING_SECONDS = 60.0
WHEELS = {"fl": "front left", "fr": "front right", "rl": "rear left", "rr": "rear right"}
WHEEL_COLOURS = ("#0b4f9c", "#4aa5e0", "#b8480b", "#f59a23")
STRAIGHT = "#b3122a"
HANDLING = "#5b8c00"


def busiest(drive: Recording, seconds: float, *, calmest: bool = False) -> tuple[float, float]:
    """The stretch of this length with the largest mean |a_y| (or the smallest, driven), [s]."""
    length = round(seconds * drive.rate_hz)
    size = np.where(drive["vx"] > 5.0, np.abs(drive["ay"]), np.inf if calmest else 0.0)
    mean = np.convolve(size, np.full(length, 1.0 / length), "valid")
    first = float(drive.time[int(np.argmin(mean) if calmest else np.argmax(mean))])
    return first, first + seconds


def figure_5(drive: Recording, wheels: SpeedFromWheels, data: str) -> Figure:
    """Speeds of the four wheels before and after their correction, beside the true speed."""
    start, stop = busiest(drive, 30.0)
    shown = drive.cut(start, stop)
    raw = wheels.wheel_radius * shown.stack([f"wheel_speed_{wheel}" for wheel in WHEELS]).T
    corrected = wheels.corrected(shown)
    with new_figure(DOUBLE_COLUMN, 3.6) as figure:
        panels = figure.subplots(2, 1, sharex=True, sharey=True)
        for axes, speeds, title in zip(
            panels, (raw, corrected), ("as measured", "corrected, Eqs. 61 to 64"), strict=True
        ):
            for values, colour, name in zip(speeds, WHEEL_COLOURS, WHEELS.values(), strict=True):
                axes.plot(shown.time, values, color=colour, linewidth=0.9, label=name)
            axes.plot(
                shown.time,
                shown["vx_ref"],
                color=MEASURED.colour,
                linewidth=1.3,
                label="true speed $u$",
            )
            axes.set_title(title, loc="left")
            axes.set_ylabel("speed [m/s]")
            axes.margins(x=0.0)
        panels[1].set_xlabel("time [s]")
        legend_above(figure, panels[0], columns=5)
    spread = [float(np.sqrt(np.mean(np.var(speeds, axis=0)))) for speeds in (raw, corrected)]
    error = [
        float(np.sqrt(np.mean((speeds.mean(0) - shown["vx_ref"]) ** 2)))
        for speeds in (raw, corrected)
    ]
    caption = (
        f"Speeds of the four wheels before and after their correction (Figure 5 of the paper), {data}, '{drive.id}'. Correction takes the "
        f"wheels' spread from {fixed(spread[0], 3)} to {fixed(spread[1], 3)} m/s, and the RMSE of their mean from {fixed(error[0], 3)} to "
        f"{fixed(error[1], 3)} m/s in this stretch; rolling radius {wheels.wheel_radius:g} m, tracks {wheels.track_front:g} and "
        f"{wheels.track_rear:g} m."
    )
    return Figure("figure_5", caption, figure)


def figure_6(
    drive: Recording, estimates: Mapping[str, Estimate], minimum_speed: float, data: str
) -> Figure:
    """The track, β over the three laps, and details on a straight and in the handling section."""
    straight = busiest(drive, STRAIGHT_SECONDS, calmest=True)
    handling = busiest(drive, HANDLING_SECONDS)
    x, y = _track(drive)
    with new_figure(DOUBLE_COLUMN, 5.6) as figure:
        grid = figure.add_gridspec(3, 2, height_ratios=(1.1, 1.2, 1.2))
        track = figure.add_subplot(grid[0, 0])
        whole = figure.add_subplot(grid[1, :])
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
        _sideslip(whole, drive, estimates, minimum_speed, None)
        _sideslip(calm, drive, estimates, minimum_speed, straight)
        _sideslip(bends, drive, estimates, minimum_speed, handling)
        for axes, letter, colour in (
            (whole, "b", "black"),
            (calm, "c", STRAIGHT),
            (bends, "d", HANDLING),
        ):
            axes.set_title(letter, loc="left", fontweight="bold", color=colour)
        legend_above(figure, whole)
    caption = (
        f"Three laps (Figure 6 of the paper), {data}, '{drive.id}': a, the track, by dead reckoning from the reference's velocities and "
        f"yaw rate, which drifts, its start as a dot; b, sideslip angle, measured and estimated; c, detail on the calmest "
        f"{STRAIGHT_SECONDS:g} s (red in a); d, in the {HANDLING_SECONDS:g} s with the largest lateral acceleration (green in a). Slower "
        f"than {minimum_speed:g} m/s nothing is drawn."
    )
    return Figure("figure_6", caption, figure)


def speed_and_acceleration(drive: Recording, number: int, what: str, data: str) -> Figure:
    """Speed and lateral acceleration along a drive: Figures 7 and 11."""
    with new_figure(DOUBLE_COLUMN * 0.8, 2.9) as figure:
        panels = figure.subplots(2, 1, sharex=True)
        panels[0].plot(*decimated(drive.time, 3.6 * drive["vx"], POINTS), color="#0b4f9c")
        panels[1].plot(*decimated(drive.time, drive["ay"], POINTS), color="#b8480b", linewidth=0.8)
        for axes, label in zip(panels, ("speed [km/h]", "$a_y$ [m/s²]"), strict=True):
            axes.set_ylabel(label)
            axes.margins(x=0.0)
        panels[1].set_xlabel("time [s]")
    caption = (
        f"Vehicle speed and lateral acceleration during {what} (Figure {number} of the paper), {data}, '{drive.id}': mean speed "
        f"{fixed(3.6 * float(drive['vx'].mean()), 0)} km/h, largest {fixed(3.6 * float(drive['vx'].max()), 0)} km/h."
    )
    return Figure(f"figure_{number}", caption, figure)


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
        shown = moving(drive, minimum_speed)
        for label, estimate in estimates.items():
            line = LINES[label]
            error = np.degrees(estimate["sideslip"] - drive["sideslip_ref"]) * shown
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
    shown = moving(drive, minimum_speed)[first:last]
    time = drive.time[first:last]
    measured = np.degrees(drive["sideslip_ref"][first:last]) * shown
    axes.plot(*decimated(time, measured, POINTS), color="#8a8a8a", linewidth=0.8, label="measured")
    for label, estimate in estimates.items():
        line = LINES[label]
        values = np.degrees(estimate["sideslip"][first:last]) * shown
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


def drawn(estimates: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """Those of the paper's filters, the best last, which is drawn over the others."""
    return {name: estimates[name] for name in reversed(paper.ORDER)}
