"""Print what the DART files do not document, identified from the files themselves.

    VEHEST_DATA=FOLDER python docs/identify_dart.py

conf/dataset/dart.yaml declares the constants, docs/sources/dart.md explains them. Of the declarations only the files and rows that count
are used here. ± is one standard deviation over 200 resamples of the drives in blocks of five seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
import pandas as pd
import yaml
from identification import Array, Figures, Mask, accelerations, data_folder, explained, factors_of, joined, rest_of, scatter, show, smooth

from vehest.sources.pose import PoseOptions
from vehest.sources.table_rows import dropped_rows_from_config, kept_rows

ROOT = Path(__file__).resolve().parents[1]
RATE = 100.0
WINDOW = 15
WHEELBASE = 0.175  # m, upstream's
MOVING = 0.3  # m/s
JUMP = 60.0  # m/s², beyond what a pose's noise of 0.2 mm makes
CUTOFF = 3.0  # Hz, of what sensors at 10 Hz can show
KNOTS = np.linspace(-1.0, 1.0, 9)
DELAYS = np.arange(-0.05, 0.1501, 0.0025)
GYRO, ENCODER, ACC_X, ACC_Y = "W (IMU)", "vel encoder", "acc x (IMU)", "acc y (IMU)"


def main() -> None:
    """Print every figure."""
    declared = yaml.safe_load((ROOT / "conf" / "dataset" / "dart.yaml").read_text(encoding="utf-8"))
    dropped = dropped_rows_from_config(declared["drop_rows"], "dart")
    drives = []
    for file in sorted((data_folder() / "dart").glob("*/*.csv")):
        table = pd.read_csv(file)
        excluded = any(fnmatchcase(file.stem, pattern) for pattern in declared["exclude"])
        show(("left out " if excluded else "") + f"{file.parent.name}/{file.stem}", _described(table))
        if not excluded:
            kept = kept_rows(len(table), dropped.get(file.stem, ()), file)
            drives.append(_drive(table[kept].reset_index(drop=True)))
            if not kept.all():
                show(f"of which {int(kept.sum())} rows count", _described(drives[-1]))
    show("All that count", {"files": len(drives), "seconds": sum(map(len, drives)) / RATE})
    show("Clocks", _clocks(drives))
    show("Rigid body", _rigid_body(drives))
    show("Gyro and encoder, late where they are new in a row; held for 50 ms more on average", _gyro_and_encoder(drives))
    show(f"Accelerometer, poses below {CUTOFF:g} Hz", _accelerometer(drives))
    show("Steering: corners of the curve at a command that stood for 0.8 s where |vx·r| < 1 m/s² [rad], and delay", _steering(drives))


def _described(table: pd.DataFrame) -> Figures:
    stamps, place = table["vicon time"].to_numpy(np.float64), table[["vicon x", "vicon y"]].to_numpy(np.float64)
    seconds = float(stamps[-1] - stamps[0])
    return {
        "rows": len(table),
        "missing": round(seconds * RATE) + 1 - len(table),
        "jumps of the pose": int((np.linalg.norm(np.diff(place, n=2, axis=0), axis=1) * RATE**2 > JUMP).sum()),
        "sensors [Hz]": (np.diff(table["elapsed time sensors"]) != 0).sum() / seconds,
        "speed, 99 % [m/s]": float(np.quantile(np.linalg.norm(place[10:] - place[:-10], axis=1) * RATE / 10.0, 0.99)),
        "encoder, 99 % [m/s]": float(np.quantile(table[ENCODER], 0.99)),
    }


def _drive(table: pd.DataFrame) -> pd.DataFrame:
    """A file with its motion from poses in the rigid body's axes; rows count in which sensors are new and the car moves."""
    place, yaw = table[["vicon x", "vicon y"]].to_numpy(np.float64), np.unwrap(table["vicon yaw"].to_numpy(np.float64))
    vx, vy, yaw_rate = vars(PoseOptions(window=WINDOW).motion(place, yaw, 1.0 / RATE)).values()
    elapsed = table["elapsed time sensors"].to_numpy()
    new = np.flatnonzero(np.diff(elapsed, prepend=elapsed[0]) != 0)
    kept = np.zeros(len(table), dtype=np.bool_)
    kept[new[5:-5]] = (vx > MOVING)[new[5:-5]]
    lateral, forward = accelerations(vx, vy, yaw_rate, RATE)
    slow = {"lateral": lateral, "forward": forward, "yaw acceleration": np.gradient(yaw_rate) * RATE, "square of the yaw rate": yaw_rate**2}
    found = table.assign(vx=vx, vy=vy, yaw_rate=yaw_rate, one=1.0, kept=kept, new=np.isin(np.arange(len(table)), new))
    return found.assign(**{name: smooth(samples, CUTOFF, RATE) for name, samples in slow.items()})


def _gentle(drives: Sequence[pd.DataFrame], limit: float) -> Mask:
    return np.asarray(np.abs(joined(drives, "vx", RATE) * joined(drives, "yaw_rate", RATE)) < limit)


def _clocks(drives: Sequence[pd.DataFrame]) -> Figures:
    found: Figures = {}
    for name in (GYRO, ACC_X, ACC_Y, ENCODER, "throttle", "steering"):
        changed = [np.diff(drive[name], prepend=drive[name][0]) != 0 for drive in drives]
        rates = [rows.mean() * RATE for rows in changed]
        together = [(rows & drive["new"]).sum() for rows, drive in zip(changed, drives, strict=True)]
        found |= {f"{name} changes a second, least": min(rates), f"{name} changes a second, most": max(rates)}
        found[f"{name} share of it where 'elapsed time sensors' does"] = sum(together) / sum(rows.sum() for rows in changed)
    apart: dict[str, list[Array]] = {"stamps": [], "an even clock": []}
    for drive in drives:
        stamps, place = drive["vicon time"].to_numpy(np.float64), drive[["vicon x", "vicon y"]].to_numpy(np.float64)
        fast = np.flatnonzero(drive["vx"] > MOVING)
        fast = fast[(fast > 8) & (fast < len(stamps) - 8)][::20]
        apart["stamps"].append(scatter(stamps - stamps[0], place, fast))
        apart["an even clock"].append(scatter(np.arange(len(stamps)) / RATE, place, fast))
    medians = {name: 1e3 * float(np.median(np.concatenate(own))) for name, own in apart.items()}
    return found | {f"poses scatter about cubics by {name} [mm]": value for name, value in medians.items()}


def _rigid_body(drives: Sequence[pd.DataFrame]) -> Figures:
    """vy/vx = yaw + lever·r/vx - slip·vx·r, as of a rear axle that does not slide; the sideways lever by the encoder."""
    gentle = _gentle(drives, 2.0)
    vx, vy, yaw_rate, encoder = (joined(drives, name, RATE)[gentle] for name in ("vx", "vy", "yaw_rate", ENCODER))
    columns = {"yaw of the body [rad]": np.ones_like(vx), "rear axle to origin [m]": yaw_rate / vx, "slip [rad s²/m]": vx * yaw_rate}
    found = factors_of(columns, vy / vx, _trimmed(list(columns.values()), vy / vx))
    found |= factors_of({"encoder by vx": vx, "encoder by yaw rate [m]": yaw_rate}, encoder, _trimmed([vx, yaw_rate], encoder))
    return found | {"origin left of the axis [m]": found["encoder by yaw rate [m]"] / found["encoder by vx"]}


def _gyro_and_encoder(drives: Sequence[pd.DataFrame]) -> Figures:
    found: Figures = {}
    for name, of, limit in ((GYRO, "yaw_rate", np.inf), (ENCODER, "vx", 2.0)):
        chosen, measured, true = _gentle(drives, limit), joined(drives, name, RATE), joined(drives, of, RATE, 0.05)
        chosen[chosen] = _trimmed([true[chosen], np.ones(chosen.sum())], measured[chosen])
        found |= explained(drives, RATE, name, (of, "one"), DELAYS, chosen)
        varied = [[drive] for drive in drives if np.std(drive.loc[drive["kept"], of]) > 0.3]
        each = [explained(one, RATE, name, (of, "one"), DELAYS[::2])[f"{name} late [ms]"] for one in varied]
        by_file = {"least": min(each), "most": max(each), "median": float(np.median(each))}
        found |= {f"{name} late by file, {what} [ms]": value for what, value in by_file.items()}
    return found


def _accelerometer(drives: Sequence[pd.DataFrame]) -> Figures:
    found: Figures = {}
    for name, by in ((ACC_X, ("forward", "lateral", "square of the yaw rate")), (ACC_Y, ("lateral", "forward", "yaw acceleration"))):
        found |= explained(drives, RATE, name, (*by, "one"), DELAYS[::2])
    for name in (ACC_X, ACC_Y, GYRO):
        still = [(np.convolve(drive["vx"] > 0.02, np.ones(101), mode="same") < 0.5) & drive["new"] for drive in drives]
        resting = np.concatenate([drive.loc[rows, name] for drive, rows in zip(drives, still, strict=True)])
        found |= {f"{name} at rest": resting.mean(), f"{name} at rest_sd": resting.std()}
    return found


def _steering(drives: Sequence[pd.DataFrame]) -> Figures:
    """Angle of a kinematic single track, atan(L·r/vx), for each command that has stood for a while at little lateral acceleration."""
    parts = []
    for drive in drives:
        steady = (drive["steering"].rolling(80).max() - drive["steering"].rolling(80).min()) < 0.02
        parts.append(drive[steady & (drive["vx"] > MOVING) & (np.abs(drive["vx"] * drive["yaw_rate"]) < 1.0)][::10])
    rows = pd.concat(parts)
    command, angle = rows["steering"].to_numpy(np.float64), np.arctan(WHEELBASE * rows["yaw_rate"] / rows["vx"]).to_numpy()
    corners = {f"corner at {knot:+.2f}": np.interp(command, KNOTS, own) for knot, own in zip(KNOTS, np.eye(len(KNOTS)), strict=True)}
    found = factors_of(corners, angle)
    curve = [found[name] for name in corners]
    found |= {"rest": (angle - np.interp(command, KNOTS, curve)).std(), "rest by one factor": rest_of([command], angle).std()}
    delays = []
    for drive in drives:
        vx, yaw_rate = drive["vx"].to_numpy(), drive["yaw_rate"].to_numpy()
        made, wanted = np.arctan(WHEELBASE * yaw_rate / np.maximum(vx, MOVING)), np.interp(drive["steering"], KNOTS, curve)
        if np.quantile(np.abs(wanted[10:] - wanted[:-10]), 0.9) < 0.02:  # slow steering tells no delay
            continue
        gentle = (vx > MOVING) & (np.abs(vx * yaw_rate) < 3.0)
        delays.append(min((float(np.std((made - np.roll(wanted, shift))[gentle][100:-100])), shift) for shift in range(60))[1] * 1e3 / RATE)
    about = {"least": min(delays), "most": max(delays), "median": float(np.median(delays)), "files": len(delays)}
    return found | {f"turns after a command, {name} [ms]": value for name, value in about.items()} | {"rows": len(command)}


def _trimmed(columns: Sequence[Array], measured: Array) -> Mask:
    """Samples within four standard deviations of a regression, by the median absolute residual: without spinning wheels and slides."""
    rows, kept = np.stack(columns, axis=1), np.ones(len(measured), dtype=np.bool_)
    for _ in range(10):
        rest = np.abs(measured - rows @ np.linalg.lstsq(rows[kept], measured[kept], rcond=None)[0])
        kept = rest < 4.0 * 1.4826 * np.median(rest[kept])
    return kept


if __name__ == "__main__":
    main()
