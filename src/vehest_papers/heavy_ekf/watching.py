"""Where the parameters can move at all, and what tells of bad input."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pandas as pd

from vehest.alignment.checks import checks_of_recording
from vehest.constants import FloatArray
from vehest.data.derived import SpeedFromWheels
from vehest.data.recording import Recording
from vehest.estimators.rational_ekf import RationalFilter
from vehest.report.document import Block, Column, Figure, Table
from vehest.report.figures import decimated
from vehest.report.style import DOUBLE_COLUMN, MISSING, fixed, listed, new_figure
from vehest_papers.heavy_ekf.laps import POINTS
from vehest_papers.heavy_ekf.subjects import CORNERING, LINES, Filter, corners
from vehest_papers.kit.legends import legend_above
from vehest_papers.kit.observability import Observability, observability_along

WINDOW_SECONDS = 1.0
SIZES = (0.02, 0.1, 0.1, 0.3)  # typical sideslip angle [rad], yaw rate [rad/s], and their rates
PARAMETER_SIZE = 0.1  # of the logarithm: 10 %
MONITOR_SECONDS = 10.0
MARGIN = 1.5  # over the largest mean of nis/dof in drives that are in order


def observability_of(own: RationalFilter, drive: Recording, minimum_speed: float) -> Observability:
    """Of the filter's states along its own estimates."""
    samples = drive.stack(own.channels)
    track = own.track()
    states = own.filter_samples(samples).mean
    inputs = np.stack([np.maximum(samples[:, 1], minimum_speed), samples[:, 3]], axis=1)
    return observability_along(
        track.transition,
        track.observation,
        states,
        inputs,
        sizes=np.array([*SIZES, *[PARAMETER_SIZE] * len(own.adapted)]),
        noise=np.array([own.values["yaw_rate"], own.values["ay"]]),
        steps=round(WINDOW_SECONDS * own.rate_hz),
    )


def observability_blocks(
    filters: Mapping[str, Filter], drive: Recording, minimum_speed: float, data: str
) -> list[Block]:
    """Smallest singular value along a drive, a line a filter, with the lateral acceleration; and in words."""
    found = {
        name: observability_of(own.fitted, drive, minimum_speed).smallest
        for name, own in filters.items()
    }
    cornering = corners(drive)
    with new_figure(DOUBLE_COLUMN, 3.4) as figure:
        top, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
        for name, values in found.items():
            time = drive.time[: len(values)]
            shown = np.maximum(values, 1e-6)
            top.semilogy(
                *decimated(time, shown, POINTS), color=LINES[name].colour, linewidth=0.8, label=name
            )
        top.axhline(1.0, color="#888888", linewidth=0.7)
        top.margins(x=0.0)
        top.set_ylabel("smallest singular value")
        below.plot(*decimated(drive.time, drive["ay"], POINTS), color="#444444", linewidth=0.7)
        below.set_ylabel("$a_y$ [m/s²]")
        below.set_xlabel("time [s]")
        below.margins(x=0.0)
        legend_above(figure, top)
    caption = (
        f"Where the states show in {WINDOW_SECONDS:g} s of measurements: smallest singular value of the local observability "
        f"matrix along '{drive.id}', {data}, about each filter's own estimates. Units: motion ({SIZES[0]:g} rad, {SIZES[1]:g} rad/s, "
        f"{SIZES[2]:g} rad/s, {SIZES[3]:g} rad/s²), {100 * PARAMETER_SIZE:.0f} % of each tyre parameter, and the filter's levels of noise. "
        "Below the grey line, one, a second of measurements determines the least observable combination worse than these sizes."
    )
    sentences = []
    for name, values in found.items():
        turning = cornering[: len(values)]
        middle = [
            float(np.median(values[where])) if where.any() else float("nan")
            for where in (turning, ~turning)
        ]
        share = 100.0 * float(np.mean(values >= 1.0))
        sentences.append(
            f"{name}: median {middle[0]:.2g} while cornering (|a_y| above {CORNERING:g} m/s²) and {middle[1]:.2g} otherwise; above one for "
            f"{fixed(share, 0)} % of the time"
        )
    return [
        Figure("observability", caption, figure),
        "Smallest singular value. " + ". ".join(sentences) + ".",
    ]


def faults(wheels: SpeedFromWheels) -> dict[str, Callable[[Recording], Recording]]:
    """What is done to a drive: name -> drive as it would be recorded."""

    def changed(**changes: Callable[[FloatArray], FloatArray]) -> Callable[[Recording], Recording]:
        return lambda drive: replace(
            drive,
            channels={
                **drive.channels,
                **{name: change(drive[name]) for name, change in changes.items()},
            },
        )

    def dropout(drive: Recording) -> Recording:
        silent = np.arange(len(drive)) % round(40 * drive.rate_hz) < round(4 * drive.rate_hz)
        return changed(wheel_speed_rl=lambda samples: np.where(silent, 0.0, samples))(drive)

    def mean_of_wheels(drive: Recording) -> Recording:
        return replace(drive, channels={**drive.channels, "vx": wheels.corrected(drive).mean(0)})

    def with_gap(drive: Recording) -> Recording:
        where = slice(len(drive) // 3, len(drive) // 3 + round(10 * drive.rate_hz))
        channels = {name: samples.copy() for name, samples in drive.channels.items()}
        for name in ("yaw_rate", "ay"):
            channels[name][where] = np.nan
        return replace(drive, channels=channels, gappy=drive.gappy | {"yaw_rate", "ay"})

    def backwards(drive: Recording) -> Recording:
        turned = {name: samples[::-1].copy() for name, samples in drive.channels.items()}
        opposite = ("vx", "vx_ref", "vy_ref", "yaw_rate", "yaw_rate_ref")
        turned |= {name: -turned[name] for name in opposite if name in turned}
        turned |= {name: -turned[name] for name in turned if name.startswith("wheel_speed")}
        return replace(drive, channels=turned)

    def standing(drive: Recording) -> Recording:
        middle = slice(len(drive) // 2, len(drive) // 2 + round(30 * drive.rate_hz))
        still = {name: samples.copy() for name, samples in drive.channels.items()}
        for name in (
            "vx",
            "vx_ref",
            "vy_ref",
            "yaw_rate",
            "yaw_rate_ref",
            "ay",
            "ax",
            "sideslip_ref",
        ):
            if name in still:
                still[name][middle] -= (
                    still[name][middle]
                    if name.endswith("_ref") or name == "vx"
                    else still[name][middle].mean()
                )
        return replace(drive, channels=still)

    return {
        "nothing": lambda drive: drive,
        "a wheel drops out, speed from the mean of the four": lambda drive: mean_of_wheels(
            dropout(drive)
        ),
        "a wheel drops out, speed from those that are plausible": lambda drive: wheels(
            dropout(drive)
        ),
        "steering 5° off": changed(steer=lambda samples: samples + np.radians(5.0)),
        "yaw rate of the other sign": changed(yaw_rate=np.negative),
        "lateral acceleration saturated at 2 m/s²": changed(
            ay=lambda samples: np.clip(samples, -2.0, 2.0)
        ),
        "yaw rate and lateral acceleration missing for 10 s": with_gap,
        "30 s at a standstill, from one sample to the next": standing,
        "the drive backwards": backwards,
    }


def monitor(nis: FloatArray, dof: FloatArray, rate_hz: float) -> FloatArray:
    """Mean of nis over measured numbers in windows of 10 s that follow one another, NaN where nothing was measured."""
    length = round(MONITOR_SECONDS * rate_hz)
    count = len(nis) // length
    total, number = (
        values[: count * length].reshape(count, length).sum(1) for values in (nis, dof)
    )
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)


def bad_input_table(
    filters: Mapping[str, Filter],
    drive: Recording,
    sound: list[Recording],
    wheels: SpeedFromWheels,
    minimum_speed: float,
    data: str,
) -> list[Block]:
    """Effect of each fault on each filter, and which check detects it."""
    limits = {}
    for name, own in filters.items():
        means = [
            monitor(estimate["nis"], estimate["nis_dof"], other.rate_hz)
            for other in sound
            for estimate in [own.of(other)]
        ]
        limits[name] = MARGIN * float(np.nanmax(np.concatenate(means)))
    clean = {(finding.check, finding.channel) for finding in checks_of_recording(drive)}
    rows = []
    silent = []
    for fault, apply in faults(wheels).items():
        damaged = apply(drive)
        scored = (np.abs(damaged["vx_ref"]) >= minimum_speed) & (damaged["vx_ref"] > 0)
        found = [
            f"{finding.check}: {finding.channel}"
            for finding in checks_of_recording(damaged)
            if (finding.level != "note" or finding.check in ("nan", "reverse"))
            and (finding.check, finding.channel) not in clean
        ]
        row: dict[str, object] = {
            "fault": fault,
            "check": "; ".join(dict.fromkeys(found)) or MISSING,
        }
        alarmed = False
        for name, own in filters.items():
            estimate = own.of(damaged)
            error = np.degrees(estimate["sideslip"] - drive["sideslip_ref"])[scored]
            over = float(
                np.mean(monitor(estimate["nis"], estimate["nis_dof"], drive.rate_hz) > limits[name])
            )
            row[f"rmse_{name}"] = float(np.sqrt(np.mean(error**2))) if len(error) else float("nan")
            row[f"over_{name}"] = 100.0 * over
            alarmed |= over > 0.0
            row["finite"] = bool(row.get("finite", True)) and all(
                np.isfinite(values).all() for values in estimate.channels.values()
            )
        row["finite"] = "yes" if row["finite"] else "NO"
        if fault != "nothing" and not alarmed and not found:
            silent.append(fault)
        rows.append(row)
    columns = {"fault": Column("what is wrong"), "finite": Column("estimates finite")}
    columns |= {f"rmse_{name}": Column(f"RMSE(β) {name} [deg]", decimals=2) for name in filters}
    columns |= {
        f"over_{name}": Column(f"monitor {name}: windows beyond the limit [%]", decimals=0)
        for name in filters
    }
    columns["check"] = Column("`vehest data check` says, beyond what it says of the drive itself")
    listed_limits = listed([f"{name} {fixed(value, 1)}" for name, value in limits.items()])
    caption = (
        f"Bad input, on '{drive.id}', {data}. The monitor takes the mean of the normalised innovation squared over the measured numbers in "
        f"windows of {MONITOR_SECONDS:g} s, about one where filter and drive agree; its limit is {MARGIN:g} times the largest mean in the "
        f"validation drives: {listed_limits}. RMSE(β) against the true reference at {minimum_speed:g} m/s and more, forwards. Backwards, "
        "at a standstill and below that speed the filters take the car to roll without slip and measure nothing."
    )
    words = (
        "Neither the monitor nor the check detects: " + "; ".join(silent) + "." if silent else ""
    )
    return [Table("bad_input", caption, pd.DataFrame(rows), columns), *([words] if words else [])]
