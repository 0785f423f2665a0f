"""Print what the F1TENTH bag does not document, identified from the bag itself and from the publishers' CSV files.

    VEHEST_DATA=FOLDER python docs/identify_f1tenth.py

conf/dataset/f1tenth_bag.yaml declares the constants, docs/sources/rosbag.md explains them, tests/sources/test_sources_rosbag.py compares.
Of the declarations only names and layouts of topics are used here, so that nothing is confirmed by itself. Uncertainties are standard
deviations over 200 resamples of the drive in blocks of half a second.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from identification import Array, Figures, Mask, accelerations, data_folder, factors_of, scatter, show, smooth
from scipy import signal

from vehest.sources.base import open_source
from vehest.sources.clocks import uniform_times
from vehest.sources.limited import Reading
from vehest.sources.pose import PoseOptions, ground_plane
from vehest.sources.rosbag import POSE_FIELDS
from vehest.sources.rosbag.topics import read_bag

ROOT = Path(__file__).resolve().parents[1]
BAG = "iros_hoons_12_final"
CSV_FILES = ("iros_hoons_1_with_friction", "hoons_all_test", "xray_duck_all_test")
FIELDS = {
    "imu": ("linear_acceleration.x", "linear_acceleration.y", "linear_acceleration.z", "angular_velocity.z"),
    "vesc": ("state.speed", "state.avg_iq"),
    "servo": ("data",),
    "body": tuple(f"pose.{part}" for part in POSE_FIELDS),
}
IMU, MOTOR, BODY, SERVO = "/imu", "/vesc/core", "/optitrack/rigid_body_0", "/vesc/servo_position_command"
RATES = {IMU: 400.0, MOTOR: 100.0, BODY: 100.0}
# columns of a drive: velocities from motion capture [m/s, rad/s]; IMU [m/s², rad/s]; motor's speed [electrical rpm, in the CSV files m/s]
# and current [A]; servo's value, in the CSV files steering angle [rad]
COLUMNS = ("vx", "vy", "yaw_rate", "ax", "ay", "gyro", "motor", "current", "steer")
IN_CSV = ("v_x", "v_y", "r", "ax_imu", "ay_imu", "r_imu", "omega_wheels", "Iq", "delta")
START = 1.0  # s, as declared
RATE = 100.0
WHEELBASE = 0.33  # m, the publishers'
MOVING = 0.5  # m/s, below which the CSV files hold nothing
GENTLE = 4.0  # m/s² of lateral acceleration, up to which a tyre's slip is taken as proportional to it
CUTOFF = 8.0  # Hz


def identify(folder: Path) -> Figures:
    """Every constant by name; names that end in ``_sd`` are uncertainties."""
    return {name: value for part in parts_of(folder).values() for name, value in part.items()}


def parts_of(folder: Path) -> dict[str, Figures]:
    """The same by title, of the bag and the CSV files in a folder."""
    declared = yaml.safe_load((ROOT / "conf" / "dataset" / "f1tenth_bag.yaml").read_text(encoding="utf-8"))
    wanted = [(declared["topics"][name]["topic"], declared["topics"][name]["type"], paths) for name, paths in FIELDS.items()]
    bag = read_bag(folder / f"{BAG}.zip", "read_topics", topics=wanted, layouts=declared["messages"])
    tables = {stem: pd.read_csv(folder / f"{stem}.csv") for stem in CSV_FILES}
    parts = {f"{stem} {number}": part for stem, table in tables.items() for number, part in table.groupby("run_id", sort=False)}
    new_names = dict(zip(IN_CSV, COLUMNS, strict=True))
    runs = {name: part.rename(columns=new_names)[[*COLUMNS]].reset_index(drop=True).astype(float) for name, part in parts.items()}
    drive = _drive(bag)
    body = _rigid_body(drive)
    turned = _turned(drive, body["body_yaw"])
    return {
        "Whose time stamps, and which clock": _clocks(bag),
        "Rigid body": body,
        f"IMU against motion capture, both below {CUTOFF:g} Hz": _imu(drive, turned, bag.arrays[f"{IMU}.linear_acceleration.z"]),
        "Steering": _steering(turned, pd.concat(runs.values())),
        "Motor": _motor(turned, pd.concat([run for name, run in runs.items() if name.startswith("hoons_all_test")])),
        "The publishers' Savitzky-Golay window": _publishers_filter(runs),
        "Is the bag's drive one of the CSV runs? [rad/s, RMS]": _same_drive(drive, runs),
        f"d(vy)/dt - (ay - vx·r) where vx > {MOVING:g} m/s [m/s², RMS below 10 Hz]": _residuals(declared | {"path": str(folder)}, runs),
    }


def _seconds(bag: Reading, topic: str, clock: str = "stamped") -> Array:
    """Stamps of a topic's messages after the start of the bag [s]; ``clock`` is stamped or received."""
    return np.asarray((bag.arrays[f"{topic}@{clock}"] - bag.summary["start"]) * 1e-9)


def _clocks(bag: Reading) -> Figures:
    found: Figures = {}
    for topic, rate in RATES.items():
        stamps, received = _seconds(bag, topic), _seconds(bag, topic, "received")
        steps = 1e3 * np.diff(stamps[stamps >= START])
        _, found[f"rate {topic}"], jitter = uniform_times(stamps[stamps >= START], rate, topic)
        *_, received_jitter = uniform_times(received[received >= START], rate, topic)
        late = received - stamps
        own = {"header to reception": np.median(late), "at most": late.max(), "headers about an even clock": jitter}
        own = {name: 1e3 * float(value) for name, value in (own | {"receptions about an even clock": received_jitter}).items()}
        own |= {"shortest interval of headers": steps.min(), "longest interval of headers": steps.max()}
        found |= {f"{topic} {name} [ms]": value for name, value in own.items()}
    stamps = _seconds(bag, BODY)
    kept = stamps >= START
    stamps, (even, *_) = stamps[kept], uniform_times(stamps[kept], RATES[BODY], BODY)
    place = np.stack([bag.arrays[f"{BODY}.pose.position.{axis}"][kept] for axis in "xy"], axis=1)
    fast = np.flatnonzero(np.hypot(*np.gradient(place, even, axis=0).T) > 1.0)
    for name, times in (("header", stamps), ("even", even)):
        apart = scatter(times, place, fast[(fast > 8) & (fast < len(stamps) - 8)])
        found[f"pose_roughness_{name}"] = float(np.sqrt(np.mean(np.square(apart)) / 2.0))  # of an axis [m]
    return found


def _drive(bag: Reading) -> pd.DataFrame:
    """The bag on a clock of 100 Hz, before anything is identified."""
    times, kept = {}, {}
    for topic, rate in RATES.items():
        stamps = _seconds(bag, topic)
        kept[topic] = stamps >= START
        times[topic] = uniform_times(stamps[kept[topic]], rate, topic)[0]
    servo_times = _seconds(bag, SERVO, "received")
    poses = np.stack([bag.arrays[f"{BODY}.pose.{part}"][kept[BODY]] for part in POSE_FIELDS], axis=1)
    plane, yaw = ground_plane(poses[:, :3], poses[:, 3:], "z", "pose")
    begin, end = max(own[0] for own in times.values()), min(own[-1] for own in (*times.values(), servo_times))
    grid = np.arange(np.ceil(begin * RATE), np.floor(end * RATE) + 1) / RATE
    motion = PoseOptions().references(plane, yaw, float(np.diff(times[BODY]).mean()), at=(times[BODY], grid))
    found = {name: motion[f"{name}_ref"] for name in COLUMNS[:3]}
    for topic, names in ((IMU, ("linear_acceleration.x", "linear_acceleration.y", "angular_velocity.z")), (MOTOR, FIELDS["vesc"])):
        for name in names:
            found[name] = np.interp(grid, times[topic], bag.arrays[f"{topic}.{name}"][kept[topic]])
    found["servo"] = np.interp(grid, servo_times, bag.arrays[f"{SERVO}.data"])
    return pd.DataFrame(dict(zip(COLUMNS, found.values(), strict=True)))


def _turned(drive: pd.DataFrame, yaw: float) -> pd.DataFrame:
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return drive.assign(vx=cosine * drive.vx + sine * drive.vy, vy=-sine * drive.vx + cosine * drive.vy)


def _rigid_body(drive: pd.DataFrame) -> Figures:
    """vy/vx = yaw + lever·r/vx - compliance·vx·r: where the rear axle stands still sideways, but for its tyres' slip."""
    vx, yaw_rate = (drive[name].to_numpy() for name in ("vx", "yaw_rate"))
    gentle, divisor = (vx > MOVING) & (np.abs(vx * yaw_rate) < GENTLE), np.maximum(vx, 0.1)
    columns = {"body_yaw": np.ones_like(vx), "rear_axle_to_body": yaw_rate / divisor, "slip [rad s²/m]": vx * yaw_rate}
    straight = drive[gentle & (np.abs(yaw_rate) < 0.3)]
    found = factors_of(columns, drive.vy.to_numpy() / divisor, gentle)
    return found | {"mean sideslip where |r| < 0.3 rad/s [deg]": float(np.degrees(np.arctan2(straight.vy, straight.vx).mean()))}


def _imu(unturned: pd.DataFrame, drive: pd.DataFrame, acc_z: Array) -> Figures:
    lateral, forward, turning = _planar_accelerations(drive)
    gyro, ay, ax, yaw_rate = (_smooth(drive[name]) for name in ("gyro", "ay", "ax", "yaw_rate"))
    one, inner = np.ones_like(lateral), slice(100, -100)
    found = factors_of({"gyro_z": yaw_rate, "gyro_z offset": one}, gyro, inner)
    columns = (lateral, forward, turning, one), (forward, lateral, _smooth(drive.yaw_rate**2), one)
    for name, measured, own in (("acc_y", ay, columns[0]), ("acc_x", ax, columns[1])):
        names = (name, f"{name} the other axis'", f"{name} lever [m]", f"{name} offset")
        found |= factors_of(dict(zip(names, own, strict=True)), measured, inner)
        found[f"{name} correlation"] = float(np.corrcoef(measured[inner], own[0][inner])[0, 1])
    crossed = factors_of(dict(zip(("own", "other", "lever", "offset"), (*_planar_accelerations(unturned), one), strict=True)), ay, inner)
    found |= {f"acc_y the other axis' before the turn{end}": crossed[f"other{end}"] for end in ("", "_sd")}
    motor = np.abs(drive.motor)
    still = (motor < 1.0) & (signal.convolve(motor, np.ones(101), mode="same") < 1.0)
    found |= {f"standing: {name}": float(drive[name][still].mean()) for name in ("ax", "ay", "gyro")}
    found |= {"standing [s]": still.sum() / RATE, "acc_z": float(acc_z.mean())}
    time = np.arange(len(gyro)) / RATE
    for name, own, reference in (("gyro_z", gyro, yaw_rate), ("acc_y", np.sign(found["acc_y"]) * ay, lateral)):

        def rest(delay: float, own: Array = own, reference: Array = reference) -> float:
            return float(np.std((own - np.interp(time - delay, time, reference))[inner]))

        delays = np.arange(-0.03, 0.0301, 0.0005)
        best = min((rest(delay), delay) for delay in delays)
        found |= {f"{name} late [ms]": 1e3 * best[1], f"{name} rest": best[0], f"{name} rest without a shift": rest(0.0)}
    return found


def _planar_accelerations(drive: pd.DataFrame) -> tuple[Array, Array, Array]:
    """Lateral, longitudinal and yaw acceleration from motion capture."""
    vx, vy, yaw_rate = (drive[name].to_numpy() for name in COLUMNS[:3])
    lateral, forward = accelerations(vx, vy, yaw_rate, RATE)
    return _smooth(lateral), _smooth(forward), _smooth(np.gradient(yaw_rate) * RATE)


def _steering(drive: pd.DataFrame, csv: pd.DataFrame) -> Figures:
    values, counts = np.unique(np.round(drive.steer, 9), return_counts=True)
    neutral = float(values[np.argmax(counts)])
    turning, away = (drive.vx > MOVING) & (np.abs(drive.vx * drive.yaw_rate) > 0.3), neutral - drive.steer
    full = (np.abs(away) > 0.345) & (drive.vx > MOVING) & (np.abs(drive.vx * drive.yaw_rate) < 2.0)
    full &= signal.convolve(full.astype(float), np.ones(31), mode="same") > 30.5
    lock = np.abs(np.arctan(WHEELBASE * drive.yaw_rate[full] / drive.vx[full]))
    return {
        "servo, least": drive.steer.min(),
        "servo, largest": drive.steer.max(),
        "servo_neutral": neutral,
        "CSV delta, least [rad]": csv.steer.min(),
        "CSV delta, largest [rad]": csv.steer.max(),
        "servo_gain": float(csv.steer.max() / (neutral - drive.steer.min())),
        "servo_agreement": float(np.corrcoef(away[turning], drive.yaw_rate[turning])[0, 1]),
        "at full lock atan(L·r/vx) [rad]": float(lock.mean()),
        "at full lock over 0.531 rad": float(lock.mean()) / 0.531,
    }


def _motor(drive: pd.DataFrame, csv: pd.DataFrame) -> Figures:
    def regressed(one: pd.DataFrame, name: str, chosen: Mask, *, current: bool) -> Figures:
        lock = np.arctan(WHEELBASE * one.yaw_rate / np.maximum(one.vx, 0.1))
        columns = {
            name: one.vx,
            f"{name}, times dvx/dt": _change(one.vx),
            f"{name}, times the front's": one.vx * (1.0 / np.cos(lock) - 1.0),
        }
        return factors_of(columns | ({f"{name}, times the current": one.current} if current else {}), one.motor.to_numpy(), chosen)

    found = regressed(drive, "erpm_per_mps", (drive.vx > MOVING).to_numpy(), current=False)
    for name, one in (("bag", drive.assign(motor=drive.motor / found["erpm_per_mps"])), ("hoons_all_test", csv)):
        gentle = ((one.vx > MOVING) & (np.abs(one.vx * one.yaw_rate) < GENTLE) & (np.abs(one.vy) < 0.15 * one.vx)).to_numpy()
        found |= regressed(one, f"{name}: motor over vx at no current", gentle, current=True)
        columns = {f"{name}: m/s² an ampere": one.current, f"{name}: constant drag": np.ones(len(one)), f"{name}: drag by vx": one.vx}
        found |= factors_of(columns, _change(one.vx), gentle & (np.abs(one.yaw_rate) < 0.5).to_numpy())
        found |= {f"{name}: least current [A]": one.current.min(), f"{name}: largest current [A]": one.current.max()}
    return found


def _change(vx: pd.Series) -> Array:
    return np.asarray(signal.savgol_filter(vx, 21, 2, deriv=1, delta=1.0 / RATE))


def _publishers_filter(runs: Mapping[str, pd.DataFrame]) -> Figures:
    """A Savitzky-Golay derivative leaves notches in the spectrum where its window spans whole waves; correlations of logarithms tell it."""
    spectra = [signal.welch(run.yaw_rate.to_numpy(), RATE, nperseg=512) for run in runs.values() if len(run) > 1024]
    frequency, power = spectra[0][0], np.median([spectrum for _, spectrum in spectra], axis=0)
    band, scores = (frequency > 5) & (frequency < 45), {}
    for window in range(5, 31, 2):
        response = np.abs(signal.freqz(signal.savgol_coeffs(window, 2, deriv=1), worN=2 * np.pi * frequency / RATE)[1])
        scores[window] = float(np.corrcoef(np.log(response[band] + 1e-4), np.log(power[band]))[0, 1])
    return {f"{window} samples": scores[window] for window in sorted(scores, key=lambda window: -scores[window])[:2]}


def _same_drive(drive: pd.DataFrame, runs: Mapping[str, pd.DataFrame]) -> Figures:
    """Slides the liveliest seconds of the bag along every run."""
    gyro, n = drive.gyro.to_numpy(), min(len(run) for run in runs.values())
    first = int(np.argmax(np.lib.stride_tricks.sliding_window_view(gyro, n).std(axis=1)))
    piece = gyro[first : first + n]
    nearest = []
    for run in runs.values():
        squares = np.convolve(np.square(run.gyro), np.ones(n), mode="valid") - 2 * np.correlate(run.gyro, piece) + np.square(piece).sum()
        nearest.append(float(np.sqrt(squares.min() / n)))
    own = float(np.sqrt(np.mean(np.square(piece - drive.yaw_rate[first : first + n]))))
    return {"seconds": n / RATE, "to the nearest stretch of all runs": min(nearest), "to the bag's own motion capture": own}


def _residuals(declared: dict[str, Any], runs: Mapping[str, pd.DataFrame]) -> Figures:
    """As vehest ingests the bag, and of the CSV files; also where abs(vx·r) is below 4 m/s², and by the deviation of ay."""
    topics, channels = declared["topics"], ("vx_ref", "vy_ref", "ay", "yaw_rate")
    changes = {"bag": {}, "bag, window of 15 samples": {"pose": declared["pose"] | {"window": 15}}}
    changes["bag, IMU averaged over 10 ms"] = {"topics": topics | {"imu": topics["imu"] | {"average": 0.01}}}
    recordings = {name: next(iter(open_source(declared | own).recordings())) for name, own in changes.items()}
    drives = {name: [one[channel] for channel in channels] for name, one in recordings.items()}
    drives |= {name: [run[channel].to_numpy() for channel in ("vx", "vy", "ay", "gyro")] for name, run in runs.items()}
    found: Figures = {}
    for name, (vx, vy, ay, yaw_rate) in drives.items():
        rest = _smooth(signal.savgol_filter(vy, 9, 2, deriv=1, delta=1.0 / RATE) - (ay - vx * yaw_rate), 10.0)
        moving = vx > MOVING
        moving[:20] = moving[-20:] = False
        gentle = moving & (np.abs(_smooth(vx * yaw_rate)) < GENTLE)
        found |= {name: float(np.sqrt(np.mean(rest[moving] ** 2))), f"{name}, gentle": float(np.sqrt(np.mean(rest[gentle] ** 2)))}
        share = rest[moving].std() / _smooth(ay, 10.0)[moving].std()
        found |= {f"{name}, mean": float(rest[moving].mean()), f"{name}, of ay": float(share)}
    one, wide = recordings["bag"], recordings["bag, window of 15 samples"]
    for name in ("vx_ref", "vy_ref", "yaw_rate_ref"):
        found[f"{name} changes with a window of 15 samples"] = float(np.std((wide[name] - one[name])[one["vx_ref"] > MOVING]))
    return found


def _smooth(samples: Any, cutoff: float = CUTOFF) -> Array:
    return smooth(samples, cutoff, RATE)


if __name__ == "__main__":
    for title, figures in parts_of(data_folder() / "f1tenth").items():
        show(title, figures)
