"""Print what the RoboRacer files do not document, identified from the files themselves.

    VEHEST_DATA=FOLDER python docs/identify_roboracer.py

conf/dataset/roboracer.yaml declares the constants, docs/sources/roboracer.md explains them. Nothing but names of columns is taken from the
declarations. Factors are those of the training file's four runs together; the validation file's are printed beside them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
import pandas as pd
from identification import Figures, accelerations, data_folder, explained, factors_of, joined, show, smooth

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


def main() -> None:
    """Print every figure."""
    for stem in FILES:
        table = pd.read_csv(data_folder() / "roboracer" / f"{stem}.csv")
        corrupt = np.flatnonzero(table["velocity_vehicle_x"] > 100.0)
        same = np.allclose(table["velocity_vehicle_x"][corrupt], table["Speed"][corrupt])
        print(f"\n{stem}: {len(table)} data rows; corrupt are {(corrupt + 1).tolist()}; velocity_vehicle_x is Speed there: {same}")
        runs = list(_runs(table.drop(index=corrupt)))
        for number, run in enumerate(runs):
            stamps, ranges = run["t"].to_numpy(), ", ".join(f"{begin:.2f} to {end:.2f}" for begin, end in _lost_ranges(run))
            print(
                f"run {number}: {len(run)} rows, {stamps[0]:.2f} to {stamps[-1]:.2f} s; {int(run['lost'].sum())} poses beyond "
                f"{IMPOSSIBLE:g} m/s²; pose lost at [s]: {ranges or 'none'}"
            )
        show(f"The publishers' reference, rows faster than {MOVING:g} m/s", _publishers_reference(runs))
        show("Motor and steering angle", _motor(runs) | _steering(runs))
        show(f"Inertial unit, all below {CUTOFF:g} Hz", _inertial_unit(runs))


def _runs(table: pd.DataFrame) -> Iterator[pd.DataFrame]:
    """Runs with their motion from poses; rows count in which the car moves and the pose is to be trusted."""
    edges = [0, *(np.flatnonzero(np.diff(table["t"]) < 0) + 1).tolist(), len(table)]
    for start, stop in pairwise(edges):
        rows = table.iloc[start:stop].reset_index(drop=True).rename(columns={"yaw_rate": "gyro"})
        place = rows[["pose_x", "pose_y"]].to_numpy(np.float64)
        motion = PoseOptions(window=5).motion(place, np.unwrap(rows["yaw"].to_numpy(np.float64)), 1.0 / RATE)
        vx, vy, yaw_rate = motion.vx, motion.vy, motion.yaw_rate
        lost = np.zeros(len(rows), dtype=np.bool_)
        lost[1:-1] = np.linalg.norm(np.diff(place, n=2, axis=0), axis=1) * RATE**2 > IMPOSSIBLE
        kept = (vx > MOVING) & ~(np.convolve(lost.astype(float), np.ones(2 * NEAR + 1), mode="same") > 0.5)
        kept[:NEAR] = kept[-NEAR:] = False
        lateral, forward = accelerations(vx, vy, yaw_rate, RATE)
        slow = {"turning": yaw_rate, "lateral": lateral, "forward": forward}
        slow |= {"lever": np.gradient(yaw_rate) * RATE, "lever_x": -(yaw_rate**2)}
        slow |= {"gyro": rows["gyro"] * np.pi / 180.0, "accx": rows["accx"] * factor_to_si("g", "m/s²")}
        slow |= {"accy": rows["accy"] * factor_to_si("g", "m/s²")}
        rows = rows.assign(**{name: smooth(samples, CUTOFF, RATE) for name, samples in slow.items()}, one=1.0)
        yield rows.assign(vx=vx, vy=vy, yaw_rate=yaw_rate, centripetal=vx * yaw_rate, thrust=np.gradient(vx) * RATE, lost=lost, kept=kept)


def _lost_ranges(run: pd.DataFrame) -> list[tuple[float, float]]:
    """Where the pose's speed from row to row is not the motor's, with a margin; ranges that meet are one."""
    stamps, motor = run["t"].to_numpy(np.float64), run["Speed"].to_numpy(np.float64) / ERPM
    speed = np.hypot(np.diff(run["pose_x"]), np.diff(run["pose_y"])) * RATE
    ranges: list[tuple[float, float]] = []
    for row in np.flatnonzero(np.abs(speed - np.abs(0.5 * (motor[1:] + motor[:-1]))) > LOST):
        begin, end = stamps[row] - MARGIN, stamps[row + 1] + MARGIN
        if ranges and begin <= ranges[-1][1]:
            begin = ranges.pop()[0]
        ranges.append((begin, end))
    return ranges


def _publishers_reference(runs: Sequence[pd.DataFrame]) -> Figures:
    """Columns velocity_vehicle_* against poses differentiated without delay."""
    found: Figures = {}
    columns = {"velocity_vehicle_x": ("vx",), "velocity_vehicle_y": ("vy", "centripetal"), "angular_velocity_from_yaw": ("yaw_rate",)}
    for name, by in columns.items():
        found |= explained(runs, RATE, name, by, np.arange(-0.02, 0.0801, 0.0025))
    vy, theirs, yaw_rate = (joined(runs, name, RATE) for name in ("vy", "velocity_vehicle_y", "yaw_rate"))
    found |= {"velocity_vehicle_y less vy, RMS": float(np.sqrt(np.mean((theirs - vy) ** 2))), "vy varies by": float(vy.std())}
    for name, own in (("poses", vy), ("columns", theirs)):
        found[f"correlation with yaw rate of vy of the {name}"] = float(np.corrcoef(own, yaw_rate)[0, 1])
    return found


def _motor(runs: Sequence[pd.DataFrame]) -> Figures:
    """Electrical rpm for 1 m/s, where the car neither accelerates nor turns much."""
    speed, motor, thrust, yaw_rate = (joined(runs, name, RATE) for name in ("vx", "Speed", "thrust", "yaw_rate"))
    calm = (np.abs(thrust) < 1.0) & (np.abs(yaw_rate) < 1.0)
    gain = float(motor[calm] @ speed[calm] / (speed[calm] @ speed[calm]))
    left = motor / gain - speed
    about = {"vx less the car's": float(left.mean()), "vx less the car's_sd": float(left.std())}
    return {"electrical rpm for 1 m/s": gain, "calm rows": int(calm.sum())} | about


def _steering(runs: Sequence[pd.DataFrame]) -> Figures:
    vx, yaw_rate, angle = (joined(runs, name, RATE) for name in ("vx", "yaw_rate", "steering_angle"))
    gentle = np.abs(vx * yaw_rate) < 2.0
    found = factors_of({"steering_angle for a curvature of 1/m [rad]": yaw_rate / vx}, angle, gentle)
    correlation = float(np.corrcoef(angle[gentle], (yaw_rate / vx)[gentle])[0, 1])
    return found | {"correlation": correlation, "least [rad]": angle[gentle].min(), "largest [rad]": angle[gentle].max()}


def _inertial_unit(runs: Sequence[pd.DataFrame]) -> Figures:
    """Factor, lever and delay of gyro and accelerometer against the poses."""
    found: Figures = {}
    for name, by in (("gyro", ("turning",)), ("accy", ("lateral", "forward", "lever")), ("accx", ("forward", "lateral", "lever_x"))):
        found |= explained(runs, RATE, name, (*by, "one"), np.arange(-0.06, 0.0801, 0.005))
    return found


if __name__ == "__main__":
    main()
