"""Print what recordings do not document, identified from the recordings themselves.

    VEHEST_DATA=FOLDER python tools/identify.py CAR

with av21, dart, f1tenth (the bag, beside the publishers' CSV files) or roboracer. conf/dataset declares the constants, the car's page in
docs/sources explains them. Of the declarations only files, rows that count and layouts of topics are used, so that nothing is confirmed by
itself. ± is one standard deviation over 200 resamples of the drives in blocks of 50 samples.

A drive is a table whose index is an even time [s]; its column ``kept`` says which rows count.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from numpy.typing import NDArray
from scipy import signal

from vehest.data.units import factor_to_si
from vehest.sources.base import open_source
from vehest.sources.clocks import uniform_times
from vehest.sources.pose import PoseOptions, ground_plane
from vehest.sources.rosbag import POSE_FIELDS
from vehest.sources.rosbag.topics import read_bag
from vehest.sources.table_rows import dropped_rows_from_config, remaining_rows

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Figures = dict[str, float]  # by name; those that end in ``_sd`` are standard deviations
Parts = Iterator[tuple[str, Figures]]  # each with its title

BLOCK = 50  # samples that are resampled together
ACROSS = ("lateral", "forward", "lever ahead", "one")
ALONG = ("forward", "lateral", "lever along", "one")


def declared(dataset: str) -> dict[str, Any]:
    """Content of a file in conf/dataset."""
    file = Path(__file__).resolve().parents[1] / "conf" / "dataset" / f"{dataset}.yaml"
    return dict(yaml.safe_load(file.read_text(encoding="utf-8")))


def factors_of(columns: Mapping[str, Any], measured: Any, chosen: Any = slice(None)) -> Figures:
    """Factors of least squares by the columns' names, and their standard deviations."""
    rows = np.stack(list(columns.values()), axis=1)[chosen]
    values = np.asarray(measured)[chosen]
    blocks = len(rows) // BLOCK
    generator = np.random.default_rng(0)
    drawn = []
    for _ in range(200):
        picked = (generator.integers(0, blocks, blocks)[:, None] * BLOCK + np.arange(BLOCK)).ravel()
        drawn.append(np.linalg.lstsq(rows[picked], values[picked], rcond=None)[0])
    found = dict(zip(columns, np.linalg.lstsq(rows, values, rcond=None)[0].tolist(), strict=True))
    return found | {
        f"{name}_sd": sd for name, sd in zip(columns, np.std(drawn, axis=0).tolist(), strict=True)
    }


def rest_of(columns: Iterable[Array], measured: Array) -> float:
    """Standard deviation of what least squares leaves of a signal."""
    rows = np.stack(list(columns), axis=1)
    return float((measured - rows @ np.linalg.lstsq(rows, measured, rcond=None)[0]).std())


def trimmed(columns: Iterable[Array], measured: Array) -> Mask:
    """Samples within four standard deviations of a regression, by the median absolute residual: without spinning wheels and slides."""
    rows = np.stack(list(columns), axis=1)
    kept = np.ones(len(measured), dtype=np.bool_)
    for _ in range(10):
        rest = np.abs(measured - rows @ np.linalg.lstsq(rows[kept], measured[kept], rcond=None)[0])
        kept = rest < 4.0 * 1.4826 * np.median(rest[kept])
    return kept


def joined(drives: Sequence[pd.DataFrame], name: str, delay: float = 0.0) -> Array:
    """A signal of all drives as it was some time earlier, rows that count."""
    return np.concatenate(
        [np.interp(own.index - delay, own.index, own[name])[own["kept"]] for own in drives]
    )


def explained(
    drives: Sequence[pd.DataFrame],
    name: str,
    by: Sequence[str],
    delays: Iterable[float] = (0.0,),
    chosen: Any = slice(None),
) -> Figures:
    """A sensor's signal by others that are some time older: factors, delay, residual, and correlation with the first of them."""
    measured = joined(drives, name)[chosen]
    scored = [
        (rest_of([joined(drives, other, delay)[chosen] for other in by], measured), delay)
        for delay in delays
    ]
    rest, delay = min(scored)
    columns = {f"{name} by {other}": joined(drives, other, delay)[chosen] for other in by}
    correlation = float(np.corrcoef(columns[f"{name} by {by[0]}"], measured)[0, 1])
    about = {
        "late [ms]": 1e3 * delay,
        "rest": rest,
        "correlation": correlation,
        "rows": len(measured),
    }
    return factors_of(columns, measured) | {
        f"{name} {what}": float(value) for what, value in about.items()
    }


def low_pass(samples: Any, cutoff: float, rate: float) -> Array:
    """A second-order Butterworth filter, run both ways."""
    return np.asarray(signal.sosfiltfilt(signal.butter(2, cutoff, fs=rate, output="sos"), samples))


def with_accelerations(drive: pd.DataFrame, cutoff: float, *sensors: str) -> pd.DataFrame:
    """What an inertial unit should read by vx, vy and yaw_rate, and sensors, below a frequency [Hz]."""
    rate = (len(drive) - 1) / (drive.index[-1] - drive.index[0])
    vx, vy, yaw_rate = (drive[name].to_numpy() for name in ("vx", "vy", "yaw_rate"))
    found = {
        "lateral": np.gradient(vy) * rate + vx * yaw_rate,
        "forward": np.gradient(vx) * rate - vy * yaw_rate,
    }
    found |= {
        "lever ahead": np.gradient(yaw_rate) * rate,
        "lever along": -(yaw_rate**2),
        "turning": yaw_rate,
    }
    found |= {name: drive[name] for name in sensors}
    return drive.assign(
        **{name: low_pass(samples, cutoff, rate) for name, samples in found.items()}, one=1.0
    )


def with_motion(
    table: pd.DataFrame, place: Sequence[str], yaw: str, window: int, rate: float
) -> pd.DataFrame:
    """A table on an even clock, with velocities from poses in the rigid body's axes."""
    table = table.set_index(np.arange(len(table)) / rate)
    poses = table[[*place]].to_numpy(np.float64), np.unwrap(table[yaw].to_numpy(np.float64))
    motion = PoseOptions(window=window).references(*poses, 1.0 / rate)
    return table.assign(**{name: motion[f"{name}_ref"] for name in ("vx", "vy", "yaw_rate")})


def rigid_body(vx: Array, vy: Array, yaw_rate: Array, *, trim: bool) -> Figures:
    """vy/vx = yaw + lever·r/vx + slip·vx·r: where the rear axle stands still sideways, but for its tyres' slip."""
    columns = {
        "body_yaw": np.ones_like(vx),
        "rear_axle_to_body": yaw_rate / vx,
        "slip [rad s²/m]": vx * yaw_rate,
    }
    return factors_of(columns, vy / vx, trimmed(columns.values(), vy / vx) if trim else slice(None))


def scatter(times: Array, place: Array, middles: Iterable[int]) -> Array:
    """Distance by which nine poses about each of some rows scatter about the cubic through them."""
    found = []
    for middle in middles:
        near = slice(middle - 4, middle + 5)
        basis = np.vander((times[near] - times[middle]) / 0.04, 4)
        rest = place[near] - basis @ np.linalg.lstsq(basis, place[near], rcond=None)[0]
        found.append(np.sqrt(np.square(rest).sum() / (9 - 4)))
    return np.array(found)


def av21(folder: Path) -> Parts:
    """Wheel radii, delay of the wheels, and how much sideslip there is to estimate, above 5 m/s."""
    ratios = []
    for file in (folder / f"{stem}.csv" for stem in ("LVMS_23_01_04_B", "Putnam_park2023_run4_2")):
        table = pd.read_csv(file).set_index("# time(s)")
        wheels = (
            table[[f"wheel_{name}(kmph)" for name in ("fl", "fr", "rl", "rr")]].mean(axis=1) / 3.6
        )
        table = pd.DataFrame(
            {
                "wheels": wheels,
                "vx": table["vx(m/s)"],
                "vy": table["vy(m/s)"],
                "r": table["omega(rad/s)"],
            }
        )
        moving = table[table["vx"] > 5.0]
        angle = np.degrees(np.arctan2(moving["vy"], moving["vx"]))
        straight = np.abs(moving["r"]) < 0.01
        ratios.append(float((moving["wheels"] / moving["vx"]).median()))
        found = explained(
            [table.assign(kept=table["vx"] > 5.0)], "wheels", ("vx",), np.arange(-0.2, 0.21, 0.02)
        )
        found |= {"seconds": table.index[-1] - table.index[0], "wheels over vx, median": ratios[-1]}
        found["correlation of vy and r"] = np.corrcoef(moving["vy"], moving["r"])[0, 1]
        found["|sideslip| for 99 % of the time [deg]"] = float(np.quantile(np.abs(angle), 0.99))
        found["mean sideslip where |r| < 0.01 rad/s [deg]"] = angle[straight].mean()
        yield file.stem, found
    both = float(
        np.mean(ratios)
    )  # of a nominal radius of 0.3 m, by which speeds at the rim become rotational speeds
    yield (
        "Both",
        {
            "wheel radius [m]": 0.3 / both,
            **{f"error of file {at} [%]": 100 * (one / both - 1) for at, one in enumerate(ratios)},
        },
    )


def dart(folder: Path) -> Parts:
    """Poses at 100 Hz with sensors at 10 Hz, in the rows from which ``elapsed time sensors`` has changed."""
    given = declared("dart")
    drives = []
    found: Figures
    dropped = dropped_rows_from_config(given["drop_rows"], "dart")
    place = ["vicon x", "vicon y"]
    encoder = "vel encoder"
    accelerometer = ("acc x (IMU)", "acc y (IMU)")
    for file in sorted(folder.glob("*/*.csv")):
        table = pd.read_csv(file)
        excluded = any(fnmatchcase(file.stem, pattern) for pattern in given["exclude"])
        rows = remaining_rows(len(table), () if excluded else dropped.get(file.stem, ()), file)
        seconds = float(np.ptp(table["vicon time"]))
        poses = table[place].to_numpy(np.float64)
        title = ("left out " if excluded else "") + f"{file.parent.name}/{file.stem}"
        found = {
            "rows": len(table),
            "that count": int(rows.sum()),
            "missing": round(seconds * 100.0) + 1 - len(table),
        }
        jumps = np.linalg.norm(np.diff(poses, n=2, axis=0), axis=1) * 100.0**2 > 60.0  # m/s²
        found |= {
            "jumps of the pose": int(jumps.sum()),
            "sensors [Hz]": (np.diff(table["elapsed time sensors"]) != 0).sum() / seconds,
        }
        found["speed, 99 % [m/s]"] = float(
            np.quantile(np.linalg.norm(poses[10:] - poses[:-10], axis=1) * 10.0, 0.99)
        )
        found["encoder, 99 % [m/s]"] = float(np.quantile(table[encoder], 0.99))
        yield title, found
        if not excluded:
            drive = with_accelerations(with_motion(table[rows], place, "vicon yaw", 15, 100.0), 3.0)
            new = np.flatnonzero(
                np.diff(
                    drive["elapsed time sensors"], prepend=drive["elapsed time sensors"].iloc[0]
                )
                != 0
            )
            inner = np.isin(np.arange(len(drive)), new[5:-5])
            drives.append(
                drive.assign(
                    kept=inner & (drive["vx"] > 0.3), new=np.isin(np.arange(len(drive)), new)
                )
            )
    yield "All that count", {"files": len(drives), "seconds": sum(map(len, drives)) / 100.0}

    found = {}
    for name in ("W (IMU)", *accelerometer, encoder, "throttle", "steering"):
        changed = [drive[name].diff().fillna(0.0) != 0.0 for drive in drives]
        together = sum(
            (rows & drive["new"]).sum() for rows, drive in zip(changed, drives, strict=True)
        )
        found[f"{name}: share of its changes where 'elapsed time sensors' changes"] = (
            together / sum(rows.sum() for rows in changed)
        )
    for clock in ("stamps", "an even clock"):
        apart = []
        for drive in drives:
            times = (
                drive["vicon time"].to_numpy() - drive["vicon time"].iloc[0]
                if clock == "stamps"
                else drive.index.to_numpy()
            )
            fast = np.flatnonzero(drive["vx"] > 0.3)
            apart.append(
                scatter(
                    times, drive[place].to_numpy(), fast[(fast > 8) & (fast < len(times) - 8)][::20]
                )
            )
        found[f"poses scatter about cubics by {clock} [mm]"] = 1e3 * float(
            np.median(np.concatenate(apart))
        )
    yield "Clocks", found

    gentle = np.abs(joined(drives, "vx") * joined(drives, "yaw_rate")) < 2.0
    vx, vy, yaw_rate, wheels = (
        joined(drives, name)[gentle] for name in ("vx", "vy", "yaw_rate", encoder)
    )
    found = rigid_body(vx, vy, yaw_rate, trim=True)
    by = factors_of(
        {"encoder by vx": vx, "encoder by yaw rate [m]": yaw_rate},
        wheels,
        trimmed([vx, yaw_rate], wheels),
    )
    yield (
        "Rigid body",
        found
        | by
        | {"origin left of the axis [m]": by["encoder by yaw rate [m]"] / by["encoder by vx"]},
    )

    delays = np.arange(-0.05, 0.1501, 0.0025)
    found = {}
    for name, of, chosen in (
        ("W (IMU)", "yaw_rate", np.ones_like(gentle)),
        (encoder, "vx", gentle.copy()),
    ):
        chosen[chosen] = trimmed(
            [joined(drives, of, 0.05)[chosen], np.ones(chosen.sum())], joined(drives, name)[chosen]
        )
        found |= explained(drives, name, (of, "one"), delays, chosen)
    varied = [[drive] for drive in drives if np.std(drive.loc[drive["kept"], "yaw_rate"]) > 0.3]
    each = [
        explained(one, "W (IMU)", ("yaw_rate", "one"), delays[::2])["W (IMU) late [ms]"]
        for one in varied
    ]
    found |= spread("W (IMU) late by file, [ms]", each)
    yield (
        "Gyro and encoder, late where they are new in a row; held for 50 ms more on average",
        found,
    )

    found = explained(drives, accelerometer[0], ALONG, delays[::2]) | explained(
        drives, accelerometer[1], ACROSS, delays[::2]
    )
    for name in accelerometer:
        still = [
            drive["new"] & (np.convolve(drive["vx"] > 0.02, np.ones(101), mode="same") < 0.5)
            for drive in drives
        ]
        found[f"{name} at rest"] = pd.concat(
            [drive.loc[rows, name] for drive, rows in zip(drives, still, strict=True)]
        ).mean()
    yield "Accelerometer, poses below 3 Hz", found
    yield (
        "Steering: corners of the curve at a command that stood for 0.8 s where |vx·r| < 1 m/s² [rad], and delay",
        _dart_steering(drives),
    )


def spread(name: str, values: Sequence[float]) -> Figures:
    """Least, most, median and number."""
    return {
        f"{name} {what}": float(of(values))
        for what, of in (("least", min), ("most", max), ("median", np.median), ("files", len))
    }


def _dart_steering(drives: Sequence[pd.DataFrame]) -> Figures:
    """Angle of a kinematic single track, atan(L·r/vx), for each command that has stood for a while at little lateral acceleration."""
    knots = np.linspace(-1.0, 1.0, 9)
    parts = []
    delays = []
    drives = [
        drive.assign(angle=np.arctan(0.175 * drive["yaw_rate"] / np.maximum(drive["vx"], 0.3)))
        for drive in drives
    ]
    drives = [
        drive.assign(across=np.abs(drive["vx"] * drive["yaw_rate"]), moving=drive["vx"] > 0.3)
        for drive in drives
    ]
    for drive in drives:
        steady = (drive["steering"].rolling(80).max() - drive["steering"].rolling(80).min()) < 0.02
        parts.append(drive[steady & drive["moving"] & (drive["across"] < 1.0)][::10])
    command, angle = (pd.concat(parts)[name].to_numpy(np.float64) for name in ("steering", "angle"))
    corners = {
        f"corner at {knot:+.2f}": np.interp(command, knots, own)
        for knot, own in zip(knots, np.eye(len(knots)), strict=True)
    }
    found = factors_of(corners, angle)
    curve = [found[name] for name in corners]
    for drive in drives:
        wanted = np.interp(drive["steering"].to_numpy(), knots, curve)
        gentle = drive["moving"] & (drive["across"] < 3.0)
        if (
            np.quantile(np.abs(wanted[10:] - wanted[:-10]), 0.9) >= 0.02
        ):  # slow steering has no delay to find
            rests = [
                np.std((drive["angle"] - np.roll(wanted, shift))[gentle][100:-100])
                for shift in range(60)
            ]
            delays.append(10.0 * int(np.argmin(rests)))
    found |= {
        "rest": (angle - np.interp(command, knots, curve)).std(),
        "rest by one factor": rest_of([command], angle),
    }
    return found | spread("turns after a command, [ms]", delays)


def roboracer(folder: Path) -> Parts:
    """Factors of the training file's four runs together, then of the validation file's, above 0.5 m/s."""
    for stem in ("ftg_stanley_total_training", "ftg_stanley_total_validation"):
        table = pd.read_csv(folder / f"{stem}.csv")
        corrupt = np.flatnonzero(table["velocity_vehicle_x"] > 100.0)
        same = np.allclose(table["velocity_vehicle_x"][corrupt], table["Speed"][corrupt])
        print(
            f"\n{stem}: {len(table)} data rows; corrupt are {(corrupt + 1).tolist()}; velocity_vehicle_x is Speed there: {same}"
        )
        table = table.drop(index=list(corrupt))
        edges = [0, *(np.flatnonzero(np.diff(table["t"]) < 0) + 1).tolist(), len(table)]
        runs = [_roboracer_run(table.iloc[start:stop]) for start, stop in pairwise(edges)]
        vx, vy, yaw_rate, theirs = (
            joined(runs, name) for name in ("vx", "vy", "yaw_rate", "velocity_vehicle_y")
        )
        found = explained(
            runs, "velocity_vehicle_y", ("vy", "vx·r"), np.arange(-0.02, 0.0801, 0.0025)
        )
        found |= {
            "velocity_vehicle_y less vy, RMS": np.sqrt(np.mean((theirs - vy) ** 2)),
            "vy varies by": vy.std(),
        }
        for name, own in (("poses", vy), ("columns", theirs)):
            found[f"correlation with yaw rate of vy of the {name}"] = np.corrcoef(own, yaw_rate)[
                0, 1
            ]
        yield "The publishers' reference", found
        motor = joined(runs, "Speed")
        angle = joined(runs, "steering_angle")
        calm = (np.abs(joined(runs, "change of vx")) < 1.0) & (np.abs(yaw_rate) < 1.0)
        gain = float(motor[calm] @ vx[calm] / (vx[calm] @ vx[calm]))
        about = {"rpm for 1 m/s": gain, "vx less the car's, deviation": (motor / gain - vx).std()}
        yield (
            "Motor and steering angle",
            about
            | {"with yaw rate": np.corrcoef(angle, yaw_rate)[0, 1], "largest [rad]": angle.max()},
        )
        found = {}
        for name, by in (("gyro", ("turning", "one")), ("accy", ACROSS), ("accx", ALONG)):
            found |= explained(runs, name, by, np.arange(-0.06, 0.0801, 0.005))
        yield "Inertial unit, all below 3 Hz", found


def _roboracer_run(table: pd.DataFrame) -> pd.DataFrame:
    """A run with its motion from poses; rows count in which the car moves and the pose is not lost within 5 rows. Prints where it is."""
    place = ["pose_x", "pose_y"]
    rate = 20.0
    run = with_motion(table.rename(columns={"yaw_rate": "gyro"}), place, "yaw", 5, rate)
    run = run.assign(
        gyro=np.radians(run["gyro"]),
        **{name: run[name] * factor_to_si("g", "m/s²") for name in ("accx", "accy")},
    )
    run = with_accelerations(run, 3.0, "gyro", "accx", "accy")
    run = run.assign(
        **{"vx·r": run["vx"] * run["yaw_rate"], "change of vx": np.gradient(run["vx"]) * rate}
    )
    lost = np.zeros(len(run), dtype=np.bool_)
    lost[1:-1] = (
        np.linalg.norm(np.diff(run[place], n=2, axis=0), axis=1) * rate**2 > 20.0
    )  # m/s², of a car on rubber tyres
    kept = (run["vx"] > 0.5) & ~(np.convolve(lost.astype(float), np.ones(11), mode="same") > 0.5)
    kept[:5] = kept[-5:] = False
    ranges: list[
        tuple[float, float]
    ] = []  # where the pose's speed from row to row is not the motor's, ±0.35 s
    speed = np.linalg.norm(np.diff(run[place], axis=0), axis=1) * rate
    motor = run["Speed"] / 4320.0
    stamps = run["t"].to_numpy()
    for row in np.flatnonzero(np.abs(speed - np.abs(motor.rolling(2).mean()[1:])) > 1.0):
        begin = stamps[row] - 0.35
        end = stamps[row + 1] + 0.35
        if ranges and begin <= ranges[-1][1]:
            begin = ranges.pop()[0]
        ranges.append((begin, end))
    shown = ", ".join(f"{begin:.2f} to {end:.2f}" for begin, end in ranges) or "none"
    print(
        f"{len(run)} rows, {stamps[0]:.2f} to {stamps[-1]:.2f} s; {lost.sum()} poses beyond 20 m/s²; pose lost at [s]: {shown}"
    )
    return run.assign(kept=kept)


IMU = "/imu"
MOTOR = "/vesc/core"
BODY = "/optitrack/rigid_body_0"
SERVO = "/vesc/servo_position_command"
RATES = {IMU: 400.0, MOTOR: 100.0, BODY: 100.0}
FIELDS = {
    IMU: {
        "ax": "linear_acceleration.x",
        "ay": "linear_acceleration.y",
        "az": "linear_acceleration.z",
        "gyro": "angular_velocity.z",
    },
    MOTOR: {"motor": "state.speed", "current": "state.avg_iq"},
    SERVO: {"steer": "data"},
    BODY: {part: f"pose.{part}" for part in POSE_FIELDS},
}
# columns of the publishers' CSV files; their motor's speed is in m/s instead of electrical rpm, their steering an angle [rad]
IN_CSV = {
    "v_x": "vx",
    "v_y": "vy",
    "r": "yaw_rate",
    "ax_imu": "ax",
    "ay_imu": "ay",
    "r_imu": "gyro",
}
IN_CSV |= {"omega_wheels": "motor", "Iq": "current", "delta": "steer"}
START = 1.0  # s, as declared
WHEELBASE = 0.33  # m, the publishers'
MOVING = 0.5  # m/s, below which the CSV files hold nothing
GENTLE = (
    4.0  # m/s² of lateral acceleration, up to which a tyre's slip is taken as proportional to it
)


def f1tenth(folder: Path) -> Parts:
    """The bag of a drive, and the publishers' CSV files of others."""
    given = declared("f1tenth_bag")
    types = {topic["topic"]: topic["type"] for topic in given["topics"].values()}
    wanted = [(topic, types[topic], tuple(fields.values())) for topic, fields in FIELDS.items()]
    bag = read_bag(
        folder / "iros_hoons_12_final.zip", "read_topics", topics=wanted, layouts=given["messages"]
    )
    tables = {
        name: pd.read_csv(folder / f"{name}.csv")
        for name in ("iros_hoons_1_with_friction", "hoons_all_test", "xray_duck_all_test")
    }
    parts = {
        f"{name} {number}": part
        for name, table in tables.items()
        for number, part in table.groupby("run_id", sort=False)
    }
    runs = {
        name: part.rename(columns=IN_CSV).astype(float).set_index(np.arange(len(part)) / 100.0)
        for name, part in parts.items()
    }

    found: Figures = {}
    times: dict[str, Array] = {}
    sensed: dict[str, Array] = {}
    for topic, rate in RATES.items():
        stamps, received = (
            (bag.arrays[f"{topic}@{clock}"] - bag.summary["start"]) * 1e-9
            for clock in ("stamped", "received")
        )
        later = stamps >= START
        times[topic], found[f"rate {topic}"], jitter = uniform_times(stamps[later], rate, topic)
        own = {
            "header to reception, at most": (received - stamps).max(),
            "shortest interval of headers": np.diff(stamps[later]).min(),
        }
        own |= {
            "headers about an even clock": jitter,
            "receptions": uniform_times(received[received >= START], rate, topic)[2],
        }
        found |= {f"{topic} {name} [ms]": 1e3 * float(value) for name, value in own.items()}
        sensed |= {
            name: bag.arrays[f"{topic}.{field}"][later] for name, field in FIELDS[topic].items()
        }
    poses = np.stack([sensed[part] for part in POSE_FIELDS], axis=1)
    even = times[BODY]
    fast = np.flatnonzero(np.hypot(*np.gradient(poses[:, :2], even, axis=0).T) > 1.0)
    stamps = (bag.arrays[f"{BODY}@stamped"] - bag.summary["start"]) * 1e-9
    for name, clock in (("header", stamps[stamps >= START]), ("even", even)):
        apart = scatter(clock, poses[:, :2], fast[(fast > 8) & (fast < len(clock) - 8)])
        found[f"pose_roughness_{name}"] = float(
            np.sqrt(np.mean(np.square(apart)) / 2.0)
        )  # of an axis [m]
    yield "Whose time stamps, and which clock", found

    times[SERVO] = (bag.arrays[f"{SERVO}@received"] - bag.summary["start"]) * 1e-9
    begin = max(own[0] for topic, own in times.items() if topic != SERVO)
    end = min(own[-1] for own in times.values())
    grid = np.arange(np.ceil(begin * 100.0), np.floor(end * 100.0) + 1) / 100.0
    motion = PoseOptions().references(
        *ground_plane(poses[:, :3], poses[:, 3:], "z", "pose"),
        float(np.diff(even).mean()),
        at=(even, grid),
    )
    columns = {name: motion[f"{name}_ref"] for name in ("vx", "vy", "yaw_rate")}
    columns |= {
        name: np.interp(grid, times[topic], sensed[name])
        for topic in (IMU, MOTOR)
        for name in FIELDS[topic]
    }
    columns["steer"] = np.interp(grid, times[SERVO], bag.arrays[f"{SERVO}.data"])
    before = pd.DataFrame(columns, index=grid)
    moving = before[(before.vx > MOVING) & (np.abs(before.vx * before.yaw_rate) < GENTLE)]
    found = rigid_body(*(moving[name].to_numpy() for name in ("vx", "vy", "yaw_rate")), trim=False)
    yield "Rigid body", found
    cosine = np.cos(found["body_yaw"])
    sine = np.sin(found["body_yaw"])
    drive = before.assign(
        vx=cosine * before.vx + sine * before.vy, vy=-sine * before.vx + cosine * before.vy
    )
    yield (
        "IMU against motion capture, all below 8 Hz",
        _imu(before, drive) | {"acc_z": float(sensed["az"].mean())},
    )
    yield "Steering", _servo(drive, pd.concat(runs.values()))
    yield (
        "Motor",
        _motor(
            drive,
            pd.concat([run for name, run in runs.items() if name.startswith("hoons_all_test")]),
        ),
    )
    yield "The publishers' Savitzky-Golay window", _publishers_filter(runs.values())
    yield "Is the bag's drive one of the CSV runs? [rad/s, RMS]", _same_drive(drive, runs.values())
    yield (
        "d(vy)/dt - (ay - vx·r) where vx > 0.5 m/s [m/s², RMS below 10 Hz]",
        _residuals(given | {"path": str(folder)}, runs),
    )


def _imu(before: pd.DataFrame, drive: pd.DataFrame) -> Figures:
    """``before`` is before the turn by the rigid body's yaw."""
    still = (np.abs(drive.motor) < 1.0) & (
        signal.convolve(np.abs(drive.motor), np.ones(101), mode="same") < 1.0
    )
    found = {
        f"standing: {name}": float(drive[name][still].mean()) for name in ("ax", "ay", "gyro")
    } | {"standing [s]": still.sum() / 100.0}
    inner = np.isin(np.arange(len(drive)), np.arange(len(drive))[100:-100])
    after, earlier = (
        [with_accelerations(one, 8.0, "gyro", "ax", "ay").assign(kept=inner)]
        for one in (drive, before)
    )
    delays = np.arange(-0.03, 0.0301, 0.0005)
    for name, by in (("gyro", ("turning", "one")), ("ay", ACROSS), ("ax", ALONG)):
        found |= explained(after, name, by)
        if name != "ax":
            late = explained(after, name, by, delays)
            found |= {
                f"{name} late, at best [ms]": late[f"{name} late [ms]"],
                f"{name} rest then": late[f"{name} rest"],
            }
    crossed = explained(earlier, "ay", ACROSS)
    return found | {
        f"ay by forward before the turn{end}": crossed[f"ay by forward{end}"] for end in ("", "_sd")
    }


def _servo(drive: pd.DataFrame, csv: pd.DataFrame) -> Figures:
    values, counts = np.unique(np.round(drive.steer, 9), return_counts=True)
    neutral = float(values[np.argmax(counts)])
    across = np.abs(drive.vx * drive.yaw_rate)
    away = neutral - drive.steer
    turning = (drive.vx > MOVING) & (across > 0.3)
    full = (np.abs(away) > 0.345) & (drive.vx > MOVING) & (across < 2.0)
    full &= signal.convolve(full.astype(float), np.ones(31), mode="same") > 30.5
    lock = np.abs(np.arctan(WHEELBASE * drive.yaw_rate[full] / drive.vx[full])).mean()
    return {
        "servo, least": drive.steer.min(),
        "servo, largest": drive.steer.max(),
        "servo_neutral": neutral,
        "CSV delta, least [rad]": csv.steer.min(),
        "CSV delta, largest [rad]": csv.steer.max(),
        "servo_gain": float(csv.steer.max() / (neutral - drive.steer.min())),
        "servo_agreement": float(np.corrcoef(away[turning], drive.yaw_rate[turning])[0, 1]),
        "at full lock atan(L·r/vx) [rad]": float(lock),
        "at full lock over 0.531 rad": float(lock) / 0.531,
    }


def _motor(drive: pd.DataFrame, csv: pd.DataFrame) -> Figures:
    """By vx, its derivative and the longer way of the front wheels in turns; then also by the current."""
    found: Figures = {}
    for name, one in (("erpm_per_mps", drive), ("bag", drive), ("CSV", csv)):
        first = name == "erpm_per_mps"
        lock = np.arctan(WHEELBASE * one.yaw_rate / np.maximum(one.vx, 0.1))
        change = signal.savgol_filter(one.vx, 21, 2, deriv=1, delta=0.01)
        key = name if first else f"{name}: motor over vx at no current"
        columns: dict[str, Any] = {
            key: one.vx,
            f"{key}, times dvx/dt": change,
            f"{key}, times the front's": one.vx * (1.0 / np.cos(lock) - 1.0),
        }
        gentle = (np.abs(one.vx * one.yaw_rate) < GENTLE) & (np.abs(one.vy) < 0.15 * one.vx)
        chosen = ((one.vx > MOVING) & (gentle | first)).to_numpy()
        columns |= {} if first else {f"{key}, times the current": one.current}
        found |= factors_of(
            columns, one.motor / (found["erpm_per_mps"] if name == "bag" else 1.0), chosen
        )
        drag = {
            f"{name}: m/s² an ampere": one.current,
            f"{name}: constant drag": np.ones(len(one)),
            f"{name}: drag by vx": one.vx,
        }
        found |= (
            {}
            if first
            else factors_of(drag, change, chosen & (np.abs(one.yaw_rate) < 0.5).to_numpy())
        )
    return found


def _publishers_filter(runs: Iterable[pd.DataFrame]) -> Figures:
    """A Savitzky-Golay derivative leaves notches in the spectrum where its window spans whole waves; correlations of logarithms tell it."""
    spectra = [
        signal.welch(run.yaw_rate.to_numpy(), 100.0, nperseg=512) for run in runs if len(run) > 1024
    ]
    frequency = spectra[0][0]
    power = np.median([spectrum for _, spectrum in spectra], axis=0)
    band = (frequency > 5) & (frequency < 45)
    scores = {}
    for window in range(5, 31, 2):
        response = np.abs(
            signal.freqz(
                signal.savgol_coeffs(window, 2, deriv=1), worN=2 * np.pi * frequency / 100.0
            )[1]
        )
        scores[window] = float(
            np.corrcoef(np.log(response[band] + 1e-4), np.log(power[band]))[0, 1]
        )
    return {
        f"{window} samples": scores[window]
        for window in sorted(scores, key=lambda window: -scores[window])[:2]
    }


def _same_drive(drive: pd.DataFrame, runs: Iterable[pd.DataFrame]) -> Figures:
    """Slides the liveliest seconds of the bag along every run."""
    gyro = drive.gyro.to_numpy()
    n = min(map(len, runs))
    first = int(np.argmax(np.lib.stride_tricks.sliding_window_view(gyro, n).std(axis=1)))
    piece = gyro[first : first + n]
    nearest = [
        np.square(np.lib.stride_tricks.sliding_window_view(run.gyro, n) - piece).mean(axis=1).min()
        ** 0.5
        for run in runs
    ]
    own = float(np.sqrt(np.mean(np.square(piece - drive.yaw_rate[first : first + n]))))
    return {
        "seconds": n / 100.0,
        "to the nearest stretch of all runs": min(nearest),
        "to the bag's own motion capture": own,
    }


def _residuals(given: dict[str, Any], runs: Mapping[str, pd.DataFrame]) -> Figures:
    """As vehest ingests the bag, and of the CSV files; also where abs(vx·r) is below 4 m/s², and by the deviation of ay."""
    topics = given["topics"]
    channels = ("vx_ref", "vy_ref", "ay", "yaw_rate")
    changes = {"bag": {}, "bag, window of 15 samples": {"pose": given["pose"] | {"window": 15}}}
    changes["bag, IMU averaged over 10 ms"] = {
        "topics": topics | {"imu": topics["imu"] | {"average": 0.01}}
    }
    recordings = {
        name: next(iter(open_source(given | own).recordings())) for name, own in changes.items()
    }
    drives = {name: [one[channel] for channel in channels] for name, one in recordings.items()}
    drives |= {
        name: [run[channel].to_numpy() for channel in ("vx", "vy", "ay", "gyro")]
        for name, run in runs.items()
    }
    found: Figures = {}
    for name, (vx, vy, ay, yaw_rate) in drives.items():
        rest = low_pass(
            signal.savgol_filter(vy, 9, 2, deriv=1, delta=0.01) - (ay - vx * yaw_rate), 10.0, 100.0
        )
        moving = vx > MOVING
        moving[:20] = moving[-20:] = False
        gentle = moving & (np.abs(low_pass(vx * yaw_rate, 8.0, 100.0)) < GENTLE)
        found |= {
            name: np.sqrt(np.mean(rest[moving] ** 2)),
            f"{name}, gentle": np.sqrt(np.mean(rest[gentle] ** 2)),
        }
        share = rest[moving].std() / low_pass(ay, 10.0, 100.0)[moving].std()
        found |= {f"{name}, mean": rest[moving].mean(), f"{name}, of ay": share}
    one = recordings["bag"]
    wide = recordings["bag, window of 15 samples"]
    for channel in ("vx_ref", "vy_ref", "yaw_rate_ref"):
        found[f"{channel} changes with a window of 15 samples"] = float(
            np.std((wide[channel] - one[channel])[one["vx_ref"] > MOVING])
        )
    return found


CARS = {made.__name__: made for made in (av21, dart, f1tenth, roboracer)}

if __name__ == "__main__":
    if "VEHEST_DATA" not in os.environ or len(sys.argv) != 2 or sys.argv[1] not in CARS:
        sys.exit(f"VEHEST_DATA=FOLDER python tools/identify.py {'|'.join(CARS)}")
    for title, figures in CARS[sys.argv[1]](Path(os.environ["VEHEST_DATA"]) / sys.argv[1]):
        print(f"\n## {title}")
        for name, value in figures.items():
            if not name.endswith("_sd"):
                print(
                    f"{name:56} {value:.10g}"
                    + (f" ± {figures[f'{name}_sd']:.2g}" if f"{name}_sd" in figures else "")
                )
