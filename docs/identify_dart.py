"""Print what the DART files do not document, identified from the files themselves.

    VEHEST_DATA=FOLDER python docs/identify_dart.py

conf/dataset/dart.yaml declares the constants, docs/sources/dart.md explains them. Of the declarations only the files and rows that count
are used here. ± is one standard deviation over 200 resamples of the drives in blocks of five seconds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
import pandas as pd
import yaml
from identification import Array, Mask, accelerations, best_delay, block_regression, data_folder, late, regression, smooth, squared_scatter
from numpy.typing import NDArray

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


@dataclass(frozen=True)
class Drive:
    """One file: its table, its motion from poses in the rigid body's axes, and the rows in which sensors and commands are new."""

    name: str
    table: pd.DataFrame
    vx: Array
    vy: Array
    yaw_rate: Array
    new: NDArray[np.int64]

    def column(self, name: str) -> Array:
        """A column in the rows in which it is new."""
        return self.table[name].to_numpy(np.float64)[self.new]

    def late(self, samples: Array, delay: float) -> Array:
        """A signal of the poses at the rows in which sensors are new, as it was some time earlier."""
        return late(samples, delay, RATE)[self.new]

    @property
    def moving(self) -> Mask:
        """Samples of the sensors in which the car moves, the ends left out."""
        found: Mask = (self.vx > MOVING)[self.new]
        found[:5] = found[-5:] = False
        return found


def main() -> None:
    """Print every figure."""
    declared = yaml.safe_load((ROOT / "conf" / "dataset" / "dart.yaml").read_text(encoding="utf-8"))
    dropped = dropped_rows_from_config(declared["drop_rows"], "dart")
    drives = []
    for file in sorted((data_folder() / "dart").glob("*/*.csv")):
        table = pd.read_csv(file)
        excluded = any(fnmatchcase(file.stem, pattern) for pattern in declared["exclude"])
        print(("left out " if excluded else "") + f"{file.parent.name}/{file.stem}: {_described(table)}")
        if not excluded:
            kept = kept_rows(len(table), dropped.get(file.stem, ()), file)
            drives.append(_drive(file.stem, table[kept].reset_index(drop=True)))
            if not kept.all():
                print(f"  of which {int(kept.sum())} rows count: {_described(drives[-1].table)}")
    print(f"\n{len(drives)} files count, {sum(len(drive.table) for drive in drives) / RATE:.0f} s")
    _clocks(drives)
    _rigid_body(drives)
    _gyro_and_encoder(drives)
    _accelerometer(drives)
    _steering(drives)


def _described(table: pd.DataFrame) -> str:
    stamps = table["vicon time"].to_numpy(np.float64)
    place = table[["vicon x", "vicon y"]].to_numpy(np.float64)
    speed = np.linalg.norm(place[10:] - place[:-10], axis=1) * RATE / 10.0
    encoder = table["vel encoder"].to_numpy(np.float64)
    missing = round(float(stamps[-1] - stamps[0]) * RATE) + 1 - len(table)
    jumps = np.linalg.norm(np.diff(place, n=2, axis=0), axis=1) * RATE**2 > JUMP
    updates = (np.diff(table["elapsed time sensors"]) != 0).sum() / (stamps[-1] - stamps[0])
    return (
        f"{len(table)} rows, {missing} missing, {int(jumps.sum())} jumps of the pose, sensors {updates:.1f} Hz, "
        f"speed to {np.quantile(speed, 0.99):.2f} m/s, encoder to {np.quantile(encoder, 0.99):.2f} m/s"
    )


def _drive(name: str, table: pd.DataFrame) -> Drive:
    place = table[["vicon x", "vicon y"]].to_numpy(np.float64)
    motion = PoseOptions(window=WINDOW).motion(place, np.unwrap(table["vicon yaw"].to_numpy(np.float64)), 1.0 / RATE)
    new = np.flatnonzero(np.diff(table["elapsed time sensors"]) != 0) + 1
    return Drive(name, table, motion.vx, motion.vy, motion.yaw_rate, new)


def _clocks(drives: list[Drive]) -> None:
    print("\n## Clocks")
    names = ("W (IMU)", "acc x (IMU)", "acc y (IMU)", "vel encoder", "throttle", "steering")
    for name in names:
        changed = [np.flatnonzero(np.diff(drive.table[name]) != 0) + 1 for drive in drives]
        share = np.mean(np.concatenate([np.isin(rows, drive.new) for rows, drive in zip(changed, drives, strict=True)]))
        rates = [len(rows) / len(drive.table) * RATE for rows, drive in zip(changed, drives, strict=True)]
        print(f"{name} changes {min(rates):.1f} to {max(rates):.1f} times a second, {share:.1%} of it where 'elapsed time sensors' does")
    scatter: dict[str, list[float]] = {"stamps": [], "even": []}
    for drive in drives:
        stamps = drive.table["vicon time"].to_numpy(np.float64)
        place = drive.table[["vicon x", "vicon y"]].to_numpy(np.float64)
        fast = np.flatnonzero(drive.vx > MOVING)
        fast = fast[(fast > 8) & (fast < len(stamps) - 8)][::20]
        for name, times in (("stamps", stamps - stamps[0]), ("even", np.arange(len(stamps)) / RATE)):
            scatter[name] += [float(np.sqrt(squared_scatter(times, place, int(middle)).sum())) for middle in fast]
    by = {name: 1e3 * float(np.median(values)) for name, values in scatter.items()}
    print(f"poses scatter about cubics through 9 of them by {by['stamps']:.3f} mm by their stamps, {by['even']:.3f} mm by an even clock")


def _rigid_body(drives: list[Drive]) -> None:
    """vy/vx = yaw + lever·r/vx - slip·vx·r, as of a rear axle that does not slide; the sideways lever by the encoder."""
    print("\n## Rigid body")
    gentle = [drive.moving & (np.abs(drive.vx * drive.yaw_rate) < 2.0)[drive.new] for drive in drives]

    def joined(of: Callable[[Drive], Array]) -> Array:
        return np.concatenate([of(drive)[drive.new][rows] for drive, rows in zip(drives, gentle, strict=True)])

    columns = [
        joined(lambda one: np.ones(len(one.vx))),
        joined(lambda one: one.yaw_rate / one.vx),
        joined(lambda one: one.vx * one.yaw_rate),
    ]
    tangent = joined(lambda one: one.vy / one.vx)
    kept = _trimmed(columns, tangent)
    (yaw, lever, slip), spread = block_regression([column[kept] for column in columns], tangent[kept])
    print(f"body's x axis to the car's forward axis: {yaw:+.4f} ± {spread[0]:.4f} rad counter-clockwise (upstream corrects by 0.0077 rad)")
    print(
        f"rear axle to origin: {lever:.4f} ± {spread[1]:.4f} m forward (upstream: 0.115 m); "
        f"slip {slip:+.4f} rad per m/s², {kept.sum()} samples"
    )
    encoder = np.concatenate([drive.column("vel encoder")[rows] for drive, rows in zip(drives, gentle, strict=True)])
    columns = [joined(lambda one: one.vx), joined(lambda one: one.yaw_rate)]
    kept = _trimmed(columns, encoder)
    factors, spread = block_regression([column[kept] for column in columns], encoder[kept])
    sideways = factors[1] / factors[0]
    print(
        f"encoder: {factors[0]:.3f} ± {spread[0]:.3f} times (vx {sideways:+.4f} ± {spread[1]:.4f} m times r): that far left lies the origin"
    )


def _gyro_and_encoder(drives: list[Drive]) -> None:
    print("\n## Gyro and encoder")
    for name, of, limit in (("W (IMU)", lambda one: one.yaw_rate, np.inf), ("vel encoder", lambda one: one.vx, 2.0)):
        chosen = [drive.moving & (np.abs(drive.vx * drive.yaw_rate) < limit)[drive.new] for drive in drives]
        measured = np.concatenate([drive.column(name)[rows] for drive, rows in zip(drives, chosen, strict=True)])

        def regressors(delay: float, of: Callable[[Drive], Array] = of, chosen: list[Mask] = chosen) -> list[Array]:
            true = np.concatenate([drive.late(of(drive), delay)[rows] for drive, rows in zip(drives, chosen, strict=True)])
            return [true, np.ones_like(true)]

        kept = _trimmed(regressors(0.05), measured)
        measured = measured[kept]
        delays = np.arange(-0.05, 0.1501, 0.0025)
        rest, delay, columns = best_delay(delays, lambda delay, of=regressors, rows=kept: [one[rows] for one in of(delay)], measured)
        factors, spread = block_regression(columns, measured)
        print(
            f"{name}: {factors[0]:.3f} ± {spread[0]:.3f} times the poses', offset {factors[1]:+.4f}, rest {rest:.3f}, "
            f"{kept.sum()} samples; "
            f"new in a row {1e3 * delay:.1f} ms after it was so, {1e3 * delay + 50.0:.0f} ms on average while it is held"
        )
        each = [_delay_of(drive, name, of(drive)) for drive in drives if np.std(of(drive)[drive.new][drive.moving]) > 0.3]
        print(
            f"  by file, where it varies: {1e3 * min(each):.0f} to {1e3 * max(each):.0f} ms, "
            f"median {1e3 * np.median(each):.0f} ms ({len(each)} files)"
        )


def _delay_of(drive: Drive, name: str, true: Array) -> float:
    measured, rows = drive.column(name), drive.moving
    ones = np.ones(rows.sum())
    return best_delay(np.arange(-0.05, 0.1501, 0.005), lambda delay: [drive.late(true, delay)[rows], ones], measured[rows])[1]


def _accelerometer(drives: list[Drive]) -> None:
    print(f"\n## Accelerometer (poses below {CUTOFF:g} Hz)")
    motions = [_accelerations(drive) for drive in drives]
    for name, order in (("acc x (IMU)", (1, 0, 3)), ("acc y (IMU)", (0, 1, 2))):
        measured = np.concatenate([drive.column(name)[drive.moving] for drive in drives])

        def columns_of(delay: float, order: tuple[int, ...] = order) -> list[Array]:
            pairs = list(zip(drives, motions, strict=True))
            columns = [np.concatenate([drive.late(motion[index], delay)[drive.moving] for drive, motion in pairs]) for index in order]
            return [*columns, np.ones_like(columns[0])]

        rest, delay, columns = best_delay(np.arange(-0.05, 0.1501, 0.005), columns_of, measured)
        factors, spread = block_regression(columns, measured)
        axes = "forward, lateral, square of the yaw rate" if order[0] else "lateral, forward, yaw acceleration"
        what = ", ".join(f"{factor:+.3f} ± {sd:.3f}" for factor, sd in zip(factors, spread, strict=True))
        print(
            f"{name}: factors of the car's {axes} and 1: {what}; "
            f"best {1e3 * delay:.0f} ms late, rest {rest:.2f} of {measured.std():.2f} m/s²"
        )
    still = [(np.convolve(drive.vx > 0.02, np.ones(101), mode="same") < 0.5)[drive.new] for drive in drives]
    for name in ("acc x (IMU)", "acc y (IMU)", "W (IMU)"):
        resting = np.concatenate([drive.column(name)[rows] for drive, rows in zip(drives, still, strict=True)])
        print(f"{name} at rest: mean {resting.mean():+.4f}, standard deviation {resting.std():.4f} ({len(resting)} samples)")


def _accelerations(drive: Drive) -> list[Array]:
    planar = accelerations(drive.vx, drive.vy, drive.yaw_rate, RATE)
    return [smooth(one, CUTOFF, RATE) for one in (*planar, np.gradient(drive.yaw_rate) * RATE, drive.yaw_rate**2)]


def _steering(drives: list[Drive]) -> None:
    """Angle of a kinematic single track, atan(L·r/vx), for each command that has stood for a while at little lateral acceleration."""
    print("\n## Steering")
    commands, angles = [], []
    for drive in drives:
        command = drive.table["steering"]
        steady = (command.rolling(80).max() - command.rolling(80).min()).to_numpy() < 0.02
        rows = np.flatnonzero(steady & (drive.vx > MOVING) & (np.abs(drive.vx * drive.yaw_rate) < 1.0))[::10]
        commands.append(command.to_numpy(np.float64)[rows])
        angles.append(np.arctan(WHEELBASE * drive.yaw_rate[rows] / drive.vx[rows]))
    command, angle = np.concatenate(commands), np.concatenate(angles)
    hats = [np.interp(command, KNOTS, np.eye(len(KNOTS))[k]) for k in range(len(KNOTS))]
    factors, spread = block_regression(hats, angle)
    print(f"{len(command)} samples with |vx·r| < 1 m/s² and a command that stood for 0.8 s; corners of the curve through them:")
    for knot, factor, sd in zip(KNOTS, factors, spread, strict=True):
        print(f"  {knot:+.2f}: {factor:+.4f} ± {sd:.4f} rad")
    rest = angle - np.interp(command, KNOTS, factors)
    print(f"rest {rest.std():.4f} rad; by one factor alone {(angle - command * (angle @ command) / (command @ command)).std():.4f} rad")
    delays = []
    for drive in drives:
        made = np.arctan(WHEELBASE * drive.yaw_rate / np.maximum(drive.vx, MOVING))
        wanted = np.interp(drive.table["steering"].to_numpy(np.float64), KNOTS, factors)
        rows = drive.vx > MOVING
        if np.quantile(np.abs(wanted[10:] - wanted[:-10]), 0.9) < 0.02:  # who hardly ever steers quickly tells no delay
            continue
        gentle = rows & (np.abs(drive.vx * drive.yaw_rate) < 3.0)
        scored = [(float(np.std((made - np.roll(wanted, shift))[gentle][100:-100])), shift) for shift in range(60)]
        delays.append(min(scored)[1] * 1e3 / RATE)
    print(
        f"the car turns {np.median(delays):.0f} ms after a command stands in a row ({min(delays):.0f} to {max(delays):.0f} ms, "
        f"{len(delays)} files)"
    )


def _trimmed(columns: list[Array], measured: Array) -> Mask:
    """Samples within four standard deviations of a regression, by the median absolute residual: without spinning wheels and slides."""
    kept = np.ones(len(measured), dtype=np.bool_)
    for _ in range(10):
        factors, _ = regression([column[kept] for column in columns], measured[kept])
        rest = np.abs(measured - np.stack(columns, axis=1) @ factors)
        kept = rest < 4.0 * 1.4826 * np.median(rest[kept])
    return kept


if __name__ == "__main__":
    main()
