"""Print what the RoboRacer files do not document, identified from the files themselves.

    VEHEST_DATA=FOLDER python docs/identify_roboracer.py

conf/dataset/roboracer.yaml declares the constants, docs/sources/roboracer.md explains them. Nothing but names of columns is taken from the
declarations. Factors are those of the training file's four runs together; the validation file's are printed beside them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pandas as pd
from identification import Array, Mask, accelerations, best_delay, data_folder, late, regression, smooth

from vehest.data.units import factor_to_si
from vehest.sources.pose import PoseOptions

RATE = 20.0
FILES = ("ftg_stanley_total_training", "ftg_stanley_total_validation")
IMPOSSIBLE = 20.0  # m/s², of a car on rubber tyres; what a pose does beyond it the car did not
LOST = 1.0  # m/s, by which the pose's speed from row to row may differ from the motor's
ERPM = 4320.0  # electrical rpm for 1 m/s, as found below
MARGIN = 0.35  # s, left out before and after a lost pose
MOVING = 0.5  # m/s
CUTOFF = 3.0  # Hz
NEAR = 5  # rows about a lost pose that its filter and the tracker's return reach


@dataclass(frozen=True)
class Run:
    """One run: its table, and its motion from poses."""

    name: str
    table: pd.DataFrame
    vx: Array
    vy: Array
    yaw_rate: Array
    lost: Mask

    @property
    def sound(self) -> Mask:
        """Rows in which the car moves and the pose is to be trusted."""
        near = np.convolve(self.lost.astype(float), np.ones(2 * NEAR + 1), mode="same") > 0.5
        moving: Mask = (self.vx > MOVING) & ~near
        moving[:NEAR] = moving[-NEAR:] = False
        return moving


def main() -> None:
    """Print every figure."""
    runs = []
    for stem in FILES:
        table = pd.read_csv(data_folder() / "roboracer" / f"{stem}.csv")
        corrupt = np.flatnonzero(table["velocity_vehicle_x"] > 100.0) + 1
        restarts = np.flatnonzero(np.diff(table["t"]) < 0) + 2
        rows = f"time goes backwards at data rows {restarts.tolist()}; speeds above 100 m/s in {corrupt.tolist()}"
        print(f"{stem}: {len(table)} data rows; {rows}")
        print(f"  there velocity_vehicle_x is Speed: {np.allclose(table['velocity_vehicle_x'][corrupt - 1], table['Speed'][corrupt - 1])}")
        runs.append(list(_runs(stem, table.drop(index=corrupt - 1))))
    for run in (*runs[0], *runs[1]):
        stamps = run.table["t"].to_numpy()
        ranges = [f"{begin:.2f} to {end:.2f}" for begin, end in _lost_ranges(run.table)]
        print(
            f"{run.name}: {len(stamps)} rows, {stamps[0]:.2f} to {stamps[-1]:.2f} s; "
            f"{int(run.lost.sum())} poses beyond {IMPOSSIBLE:g} m/s²; "
            f"pose lost {', '.join(ranges) or 'nowhere'}{' s' if ranges else ''}"
        )
    for name, chosen in zip(("training", "validation"), runs, strict=True):
        print(f"\n## {name}: {sum(int(run.sound.sum()) for run in chosen)} sound rows faster than {MOVING:g} m/s")
        _publishers_reference(chosen)
        _motor(chosen)
        _inertial_unit(chosen)
        _steering(chosen)


def _runs(stem: str, table: pd.DataFrame) -> Iterator[Run]:
    edges = [0, *(np.flatnonzero(np.diff(table["t"]) < 0) + 1).tolist(), len(table)]
    for number, (start, stop) in enumerate(pairwise(edges)):
        rows = table.iloc[start:stop].reset_index(drop=True)
        place = rows[["pose_x", "pose_y"]].to_numpy(np.float64)
        motion = PoseOptions(window=5).motion(place, np.unwrap(rows["yaw"].to_numpy(np.float64)), 1.0 / RATE)
        lost = np.zeros(len(rows), dtype=np.bool_)
        lost[1:-1] = np.linalg.norm(np.diff(place, n=2, axis=0), axis=1) * RATE**2 > IMPOSSIBLE
        yield Run(f"{stem}_run_{number}", rows, motion.vx, motion.vy, motion.yaw_rate, lost)


def _lost_ranges(table: pd.DataFrame) -> list[tuple[float, float]]:
    """Where the pose's speed from row to row is not the motor's, with a margin; ranges that meet are one."""
    stamps, motor = table["t"].to_numpy(np.float64), table["Speed"].to_numpy(np.float64) / ERPM
    speed = np.hypot(np.diff(table["pose_x"]), np.diff(table["pose_y"])) * RATE
    ranges: list[tuple[float, float]] = []
    for row in np.flatnonzero(np.abs(speed - np.abs(0.5 * (motor[1:] + motor[:-1]))) > LOST):
        begin, end = stamps[row] - MARGIN, stamps[row + 1] + MARGIN
        if ranges and begin <= ranges[-1][1]:
            begin = ranges.pop()[0]
        ranges.append((begin, end))
    return ranges


def _publishers_reference(runs: list[Run]) -> None:
    """Columns velocity_vehicle_* against poses differentiated without delay."""
    for column, own in (("velocity_vehicle_x", "vx"), ("velocity_vehicle_y", "vy"), ("angular_velocity_from_yaw", "yaw_rate")):

        def columns_of(delay: float, name: str = own) -> list[Array]:
            columns = [_joined(runs, lambda run: late(getattr(run, name), delay, RATE))]
            return columns if name != "vy" else [*columns, _joined(runs, lambda run: late(run.vx * run.yaw_rate, delay, RATE))]

        measured = _joined(runs, lambda run, name=column: run.table[name].to_numpy(np.float64))
        rest, delay, columns = best_delay(np.arange(-0.02, 0.0801, 0.0025), columns_of, measured)
        factors, _ = regression(columns, measured)
        more = "" if own != "vy" else f" and {1e3 * factors[1]:+.0f} ms times vx·r"
        print(f"{column}: {factors[0]:.3f} times that of the poses{more}, {1e3 * delay:.0f} ms late (rest {rest:.3f})")
    bias = _joined(runs, lambda run: run.table["velocity_vehicle_y"].to_numpy(np.float64) - run.vy)
    spread = _joined(runs, lambda run: run.vy)
    print(
        f"velocity_vehicle_y less that of the poses: RMS {np.sqrt(np.mean(bias**2)):.3f} m/s, of {np.std(spread):.3f} m/s that it varies by"
    )
    for name, v in (("poses", spread), ("columns", spread + bias)):
        print(f"v_y of the {name} correlates with the yaw rate by {np.corrcoef(v, _joined(runs, lambda run: run.yaw_rate))[0, 1]:.2f}")


def _motor(runs: list[Run]) -> None:
    """Electrical rpm for 1 m/s, where the car neither accelerates nor turns much."""
    calm = [run.sound & (np.abs(np.gradient(run.vx) * RATE) < 1.0) & (np.abs(run.yaw_rate) < 1.0) for run in runs]
    speed = np.concatenate([run.vx[rows] for run, rows in zip(runs, calm, strict=True)])
    motor = np.concatenate([run.table["Speed"].to_numpy(np.float64)[rows] for run, rows in zip(runs, calm, strict=True)])
    gain = float(motor @ speed / (speed @ speed))
    calm_rows = f"{len(speed)} calm rows (median ratio {np.median(motor / speed):.0f})"
    print(f"Speed: {gain:.0f} electrical rpm for 1 m/s in {calm_rows}, {1 / gain:.4e} m/s each")
    everywhere = _joined(runs, lambda run: run.table["Speed"].to_numpy(np.float64)) / gain - _joined(runs, lambda run: run.vx)
    print(
        f"  speed of the motor less the car's, all sound rows: mean {everywhere.mean():+.3f}, standard deviation {everywhere.std():.3f} m/s"
    )


def _inertial_unit(runs: list[Run]) -> None:
    """Factor, lever and delay of gyro and accelerometer against the poses, all below the cut-off."""
    gravity = factor_to_si("g", "m/s²")

    def kinematic(run: Run, delay: float) -> list[Array]:
        lateral, forward = accelerations(run.vx, run.vy, run.yaw_rate, RATE)
        turning = (np.gradient(run.yaw_rate) * RATE, run.yaw_rate**2)
        return [late(smooth(one, CUTOFF, RATE), delay, RATE) for one in (run.yaw_rate, lateral, forward, *turning)]

    for name, column, scale, chosen in (
        ("yaw_rate", "yaw_rate", np.pi / 180.0, (0,)),
        ("accy", "accy", gravity, (1, 2, 3)),
        ("accx", "accx", gravity, (2, 1, 4)),
    ):

        def columns_of(delay: float, chosen: tuple[int, ...] = chosen) -> list[Array]:
            columns = [_joined(runs, lambda run, which=index: kinematic(run, delay)[which]) for index in chosen]
            return [*columns, np.ones_like(columns[0])]

        measured = _joined(runs, lambda run, which=column, unit=scale: unit * smooth(run.table[which].to_numpy(np.float64), CUTOFF, RATE))
        rest, delay, columns = best_delay(np.arange(-0.06, 0.0801, 0.005), columns_of, measured)
        factors, correlation = regression(columns, measured)[0], np.corrcoef(columns[0], measured)[0, 1]
        axes = (
            ""
            if name == "yaw_rate"
            else f", the other axis' {factors[1]:+.2f}, lever {factors[2] if name == 'accy' else -factors[2]:+.2f} m"
        )
        what = f"{factors[0]:+.3f} times the car's{axes}, offset {factors[-1]:+.3f}"
        print(f"{name}: {what}, {1e3 * delay:+.0f} ms late, correlation {correlation:.2f}, rest {rest:.3f}")


def _steering(runs: list[Run]) -> None:
    gentle = [run.sound & (np.abs(run.vx * run.yaw_rate) < 2.0) for run in runs]
    angle = np.concatenate([run.table["steering_angle"].to_numpy(np.float64)[rows] for run, rows in zip(runs, gentle, strict=True)])
    curvature = np.concatenate([(run.yaw_rate / run.vx)[rows] for run, rows in zip(runs, gentle, strict=True)])
    slope = float(angle @ curvature / (curvature @ curvature))
    correlation = np.corrcoef(angle, curvature)[0, 1]
    what = f"{slope:.2f} rad for a curvature of 1/m where |vx·r| < 2 m/s² ({len(angle)} rows, correlation {correlation:.2f})"
    print(f"steering_angle: {what}, {angle.min():.3f} to {angle.max():.3f} rad")


def _joined(runs: list[Run], of: Callable[[Run], Array]) -> Array:
    """What a function makes of each run, sound rows of all."""
    return np.concatenate([of(run)[run.sound] for run in runs])


if __name__ == "__main__":
    main()
