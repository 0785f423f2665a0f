"""Print what the F1TENTH bag does not document, identified from the bag itself and from the publishers' CSV files.

    VEHEST_DATA=FOLDER python docs/identify_f1tenth.py

conf/dataset/f1tenth_bag.yaml declares the constants, docs/sources/rosbag.md explains them, tests/sources/test_sources_rosbag.py compares.
Of the declarations only names and layouts of topics are used here, so that nothing is confirmed by itself. Uncertainties are standard
deviations over 200 resamples of the drive in blocks of half a second.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from identification import Array, accelerations, block_regression, data_folder, smooth, squared_scatter
from numpy.typing import NDArray
from scipy import signal

from vehest.data.errors import VehestError
from vehest.data.recording import Recording
from vehest.sources.base import open_source
from vehest.sources.clocks import uniform_times
from vehest.sources.limited import Reading
from vehest.sources.pose import PoseOptions, ground_plane
from vehest.sources.rosbag import POSE_FIELDS
from vehest.sources.rosbag.topics import read_bag

ROOT = Path(__file__).resolve().parents[1]
BAG = "iros_hoons_12_final"
CSV_FILES = ("iros_hoons_1_with_friction", "hoons_all_test", "xray_duck_all_test")
START = 1.0  # s, as declared
RATE = 100.0
WHEELBASE = 0.33  # m, the publishers'
MOVING = 0.5  # m/s, below which the CSV files hold nothing
GENTLE = 4.0  # m/s² of lateral acceleration, up to which a tyre's slip is taken as proportional to it
CUTOFF = 8.0  # Hz


@dataclass(frozen=True)
class Drive:
    """One drive on a clock of 100 Hz; accelerations and currents as their files count them, angles in rad.

    Args:
        vx, vy, yaw_rate: from motion capture [m/s, rad/s].
        ax, ay, gyro: from the IMU [m/s², rad/s].
        motor, current: of the motor's controller [electrical rpm, or m/s in the CSV files; A].
        steer: servo value, or steering angle in the CSV files.
    """

    name: str
    vx: Array
    vy: Array
    yaw_rate: Array
    ax: Array
    ay: Array
    gyro: Array
    motor: Array
    current: Array
    steer: Array


def main() -> None:
    """Print every figure."""
    folder = data_folder() / "f1tenth"
    try:
        identify(folder, print)
    except VehestError as error:
        sys.exit(str(error))


def identify(folder: Path, say: Callable[[str], None] = lambda line: None) -> dict[str, float]:
    """Identify every constant.

    Args:
        folder: with the bag and the CSV files.
        say: is given each line.

    Returns:
        the constants by name; names that end in ``_sd`` are their uncertainties.
    """
    declared = yaml.safe_load((ROOT / "conf" / "dataset" / "f1tenth_bag.yaml").read_text(encoding="utf-8"))
    bag = _read(folder, declared)
    runs = list(_csv_runs(folder))
    say(f"# {BAG}.zip (real data), bag's clock from its first message; CSV files: {len(runs)} runs (real data)")
    found = _clocks(bag, say)
    drive = _drive(bag)
    found |= _rigid_body(drive, say)
    turned = _turned(drive, found["body_yaw"])
    found |= _imu(drive, turned, bag, say)
    found |= _steering(turned, runs, say)
    found |= _motor(turned, runs, say)
    found |= _publishers_filter(runs, say)
    found |= _same_drive(drive, runs, say)
    found |= _residuals(declared, folder, runs, say)
    return found


def _read(folder: Path, declared: dict[str, Any]) -> Reading:
    topics = declared["topics"]
    fields = {
        "imu": ("linear_acceleration.x", "linear_acceleration.y", "linear_acceleration.z", "angular_velocity.z"),
        "vesc": ("state.speed", "state.avg_iq"),
        "servo": ("data",),
        "body": tuple(f"pose.{part}" for part in POSE_FIELDS),
    }
    wanted = [(topics[name]["topic"], topics[name]["type"], paths) for name, paths in fields.items()]
    return read_bag(folder / f"{BAG}.zip", "read_topics", topics=wanted, layouts=declared["messages"])


def _seconds(bag: Reading, topic: str, clock: str = "stamped") -> Array:
    """Stamps of a topic's messages after the start of the bag [s]; ``clock`` is stamped or received."""
    return np.asarray((bag.arrays[f"{topic}@{clock}"] - bag.summary["start"]) * 1e-9)


def _clocks(bag: Reading, say: Callable[[str], None]) -> dict[str, float]:
    say("\n## Whose time stamps, and which clock")
    found = {}
    for topic, rate in (("/imu", 400.0), ("/vesc/core", 100.0), ("/optitrack/rigid_body_0", 100.0)):
        stamps, received = _seconds(bag, topic), _seconds(bag, topic, "received")
        late = (bag.arrays[f"{topic}@received"] - bag.arrays[f"{topic}@stamped"]) * 1e-6
        kept = stamps >= START
        steps = 1e3 * np.diff(stamps[kept])
        _, rate_hz, jitter = uniform_times(stamps[kept], rate, topic)
        *_, received_jitter = uniform_times(received[received >= START], rate, topic)
        say(
            f"{topic}: {len(stamps)} messages, {rate_hz:.4f} Hz; header to reception {np.median(late):.2f} ms, "
            f"at most {late.max():.1f}; intervals of headers {steps.min():.3f} to {steps.max():.2f} ms; "
            f"about an even clock headers {1e3 * jitter:.2f}, receptions {1e3 * received_jitter:.2f} ms (RMS)"
        )
        found[f"rate {topic}"] = rate_hz
    stamps = _seconds(bag, "/optitrack/rigid_body_0")
    kept = stamps >= START
    stamps = stamps[kept]
    even, *_ = uniform_times(stamps, 100.0, "pose")
    place = np.stack([bag.arrays[f"/optitrack/rigid_body_0.pose.position.{axis}"][kept] for axis in "xy"], axis=1)
    fast = np.flatnonzero(np.hypot(*np.gradient(place, even, axis=0).T) > 1.0)
    for name, times in (("header", stamps), ("even", even)):
        squares = [squared_scatter(times, place, middle) for middle in fast[(fast > 8) & (fast < len(stamps) - 8)]]
        found[f"pose_roughness_{name}"] = float(np.sqrt(np.mean(squares)))
    scatter = {name: 1e3 * found[f"pose_roughness_{name}"] for name in ("header", "even")}
    say(
        f"poses above 1 m/s scatter about cubics through 9 of them by {scatter['header']:.3f} mm with the headers' times, "
        f"by {scatter['even']:.3f} mm with an even clock: they were taken evenly and stamped late"
    )
    return found


def _drive(bag: Reading) -> Drive:
    """The bag on a clock of 100 Hz, before anything is identified."""

    def even(topic: str, rate: float) -> tuple[Array, NDArray[np.bool_]]:
        stamps = _seconds(bag, topic)
        kept = stamps >= START
        return uniform_times(stamps[kept], rate, topic)[0], kept

    imu_times, imu_kept = even("/imu", 400.0)
    vesc_times, vesc_kept = even("/vesc/core", 100.0)
    body_times, body_kept = even("/optitrack/rigid_body_0", 100.0)
    servo_times = _seconds(bag, "/vesc/servo_position_command", "received")
    poses = np.stack([bag.arrays[f"/optitrack/rigid_body_0.pose.{part}"][body_kept] for part in POSE_FIELDS], axis=1)
    plane, yaw = ground_plane(poses[:, :3], poses[:, 3:], "z", "pose")
    begin, end = max(imu_times[0], vesc_times[0], body_times[0]), min(imu_times[-1], vesc_times[-1], body_times[-1], servo_times[-1])
    grid = np.arange(np.ceil(begin * RATE), np.floor(end * RATE) + 1) / RATE
    motion = PoseOptions().references(plane, yaw, float(np.diff(body_times).mean()), at=(body_times, grid))
    return Drive(
        "bag",
        *(motion[name] for name in ("vx_ref", "vy_ref", "yaw_rate_ref")),
        *(
            np.interp(grid, imu_times, bag.arrays[f"/imu.{name}"][imu_kept])
            for name in ("linear_acceleration.x", "linear_acceleration.y", "angular_velocity.z")
        ),
        *(np.interp(grid, vesc_times, bag.arrays[f"/vesc/core.{name}"][vesc_kept]) for name in ("state.speed", "state.avg_iq")),
        np.interp(grid, servo_times, bag.arrays["/vesc/servo_position_command.data"]),
    )


def _turned(drive: Drive, yaw: float) -> Drive:
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return replace(drive, vx=cosine * drive.vx + sine * drive.vy, vy=-sine * drive.vx + cosine * drive.vy)


def _csv_runs(folder: Path) -> Iterator[Drive]:
    for stem in CSV_FILES:
        table = pd.read_csv(folder / f"{stem}.csv")
        for number, rows in table.groupby("run_id", sort=False):
            names = ("v_x", "v_y", "r", "ax_imu", "ay_imu", "r_imu", "omega_wheels", "Iq", "delta")
            yield Drive(f"{stem} {number}", *(rows[name].to_numpy(dtype=np.float64) for name in names))


def _rigid_body(drive: Drive, say: Callable[[str], None]) -> dict[str, float]:
    """vy/vx = yaw + lever·r/vx - compliance·vx·r: where the rear axle stands still sideways, but for its tyres' slip."""
    say("\n## Rigid body")
    gentle = (drive.vx > MOVING) & (np.abs(drive.vx * drive.yaw_rate) < GENTLE)
    columns = [np.ones_like(drive.vx), drive.yaw_rate / np.maximum(drive.vx, 0.1), drive.vx * drive.yaw_rate]
    (yaw, lever, slip), spread = block_regression(columns, drive.vy / np.maximum(drive.vx, 0.1), gentle)
    straight = gentle & (np.abs(drive.yaw_rate) < 0.3)
    sideslip = np.degrees(np.arctan2(drive.vy, drive.vx)[straight].mean())
    say(
        f"x axis to the car's forward axis: {yaw:.4f} ± {spread[0]:.4f} rad ({np.degrees(yaw):.2f}°) counter-clockwise; "
        f"mean sideslip where |r| < 0.3 rad/s: {sideslip:.2f}° ({straight.sum()} samples)"
    )
    say(f"rear axle to origin: {lever:.3f} ± {spread[1]:.3f} m forward (slip {slip:.4f} ± {spread[2]:.4f} rad per m/s²)")
    return {"body_yaw": yaw, "body_yaw_sd": spread[0], "rear_axle_to_body": lever, "rear_axle_to_body_sd": spread[1]}


def _imu(unturned: Drive, drive: Drive, bag: Reading, say: Callable[[str], None]) -> dict[str, float]:
    say(f"\n## IMU against motion capture (both below {CUTOFF:g} Hz)")
    lateral, forward, turning, _ = _planar_accelerations(drive)
    one = np.ones_like(lateral)
    inner = np.zeros(len(one), dtype=bool)
    inner[100:-100] = True
    found = {}
    for name, measured, columns in (
        ("gyro_z", _smooth(drive.gyro), [_smooth(drive.yaw_rate), one]),
        ("acc_y", _smooth(drive.ay), [lateral, forward, turning, one]),
        ("acc_x", _smooth(drive.ax), [forward, lateral, _smooth(drive.yaw_rate**2), one]),
    ):
        factors, spread = block_regression(columns, measured, inner)
        correlation = np.corrcoef(measured[inner], columns[0][inner])[0, 1]
        found[name] = factors[0]
        rest = (
            ""
            if name == "gyro_z"
            else f", the other axis' {factors[1]:+.3f} ± {spread[1]:.3f}, lever {factors[2]:+.3f} ± {spread[2]:.3f} m"
        )
        say(f"{name}: {factors[0]:+.3f} ± {spread[0]:.3f} times the car's, correlation {correlation:+.3f}{rest}, offset {factors[-1]:+.4f}")
    crossed, crossed_sd = block_regression(_planar_accelerations(unturned), _smooth(drive.ay), inner)
    say(f"acc_y before the rigid body is turned: the other axis' {crossed[1]:+.3f} ± {crossed_sd[1]:.3f}")
    acc_z = bag.arrays["/imu.linear_acceleration.z"]
    still = np.abs(drive.motor) < 1.0
    still &= signal.convolve(np.abs(drive.motor), np.ones(101), mode="same") < 1.0
    say(
        f"acc_z {acc_z.mean():+.3f} m/s² on average: z is up; standing for {still.sum() / RATE:.1f} s: "
        f"acc_x {drive.ax[still].mean():+.3f}, acc_y {drive.ay[still].mean():+.3f} m/s², gyro_z {drive.gyro[still].mean():+.4f} rad/s"
    )
    delays = np.arange(-0.03, 0.0301, 0.0005)
    gyro = _smooth(drive.gyro)
    time = np.arange(len(gyro)) / RATE
    found["acc_z"] = float(acc_z.mean())
    pairs = (("gyro_z", gyro, _smooth(drive.yaw_rate)), ("acc_y", np.sign(found["acc_y"]) * _smooth(drive.ay), lateral))
    for name, late, reference in pairs:
        errors = [np.var((late - np.interp(time - delay, time, reference))[100:-100]) for delay in delays]
        found[f"delay_{name}"] = float(delays[np.argmin(errors)])
        best, none = np.sqrt(min(errors)), np.sqrt(errors[len(delays) // 2])
        unit = "rad/s" if name == "gyro_z" else "m/s²"
        late_ms = 1e3 * found[f"delay_{name}"]
        say(f"{name} is {late_ms:+.1f} ms later than motion capture (RMS {best:.4f} {unit}, without a shift {none:.4f})")
    return found


def _planar_accelerations(drive: Drive) -> list[Array]:
    """Lateral, longitudinal and yaw acceleration from motion capture, and a constant."""
    planar = accelerations(drive.vx, drive.vy, drive.yaw_rate, RATE)
    return [*(_smooth(one) for one in (*planar, np.gradient(drive.yaw_rate) * RATE)), np.ones_like(drive.vx)]


def _steering(drive: Drive, runs: list[Drive], say: Callable[[str], None]) -> dict[str, float]:
    say("\n## Steering")
    low, high = drive.steer.min(), drive.steer.max()
    neutral, share = _most_frequent(drive.steer)
    ends = np.concatenate([run.steer for run in runs])
    gain = float(ends.max() / (neutral - low))
    say(
        f"servo {low:.10f} to {high:.10f}, {share:.0%} of the time at {neutral:.6f}; CSV delta {ends.min():.10f} to {ends.max():.10f} rad: "
        f"{gain:.9f} rad a unit about {neutral:g}; 0.531/0.35 = {0.531 / 0.35:.9f}"
    )
    turning = (drive.vx > MOVING) & (np.abs(drive.vx * drive.yaw_rate) > 0.3)
    agreement = np.corrcoef(neutral - drive.steer[turning], drive.yaw_rate[turning])[0, 1]
    csv_turning = [np.corrcoef(run.steer, run.yaw_rate)[0, 1] for run in runs]
    say(
        f"servo below neutral turns left: correlation of neutral - servo with yaw rate {agreement:+.2f}; of the CSV runs' delta with r "
        f"{min(csv_turning):+.2f} to {max(csv_turning):+.2f}"
    )
    found = {"servo_neutral": neutral, "servo_gain": gain, "servo_agreement": float(agreement)}
    full = (np.abs(drive.steer - neutral) > 0.345) & (drive.vx > MOVING) & (np.abs(drive.vx * drive.yaw_rate) < 2.0)
    full &= signal.convolve(full.astype(float), np.ones(31), mode="same") > 30.5
    kinematic = np.abs(np.arctan(WHEELBASE * drive.yaw_rate[full] / drive.vx[full]))
    found["kinematic_lock"] = float(kinematic.mean())
    say(
        f"at full lock and |ay| < 2 m/s² atan(L·r/vx) is {kinematic.mean():.3f} rad (standard deviation {kinematic.std():.3f}, "
        f"{full.sum()} samples), {kinematic.mean() / 0.531:.2f} of the 0.531 rad that the publishers' scale gives"
    )
    return found


def _motor(drive: Drive, runs: list[Drive], say: Callable[[str], None]) -> dict[str, float]:
    say("\n## Motor")
    found = {}
    (gain, lag, front), spread = _motor_regression(drive, drive.vx > MOVING)
    found |= {"erpm_per_mps": gain, "erpm_per_mps_sd": spread[0]}
    say(
        f"speed = {gain:.0f} ± {spread[0]:.0f} electrical rpm for 1 m/s ({1 / gain:.4e} m/s each), "
        f"{1e3 * lag / gain:+.0f} ms times dvx/dt, "
        f"and {front / gain:.2f} ± {spread[2] / gain:.2f} of what the front wheels go farther in turns (both axles alike: 0.5)"
    )
    same = replace(drive, motor=drive.motor / gain)
    tyre_a = _joined([run for run in runs if run.name.startswith("hoons_all_test")])
    for one in (same, replace(tyre_a, name="hoons_all_test")):
        gentle = (one.vx > MOVING) & (np.abs(one.vx * one.yaw_rate) < GENTLE) & (np.abs(one.vy) < 0.15 * one.vx)
        factors, spread = _motor_regression(one, gentle, current=True)
        straight = gentle & (np.abs(one.yaw_rate) < 0.5)
        acceleration = signal.savgol_filter(one.vx, 21, 2, deriv=1, delta=1.0 / RATE)
        drag, drag_spread = block_regression([one.current, np.ones_like(one.vx), one.vx], acceleration, straight)
        found[f"motor_scale {one.name}"], found[f"acceleration_per_ampere {one.name}"] = factors[0], drag[0]
        say(
            f"{one.name}: motor speed {factors[0]:.3f} ± {spread[0]:.3f} times vx at no current, "
            f"{drag[0]:.3f} ± {drag_spread[0]:.3f} m/s² an ampere ({gentle.sum()} samples with |ay| < {GENTLE:g} m/s² and little sideslip)"
        )
    say(
        f"current: bag {drive.current.min():.2f} to {drive.current.max():.2f} A, CSV {min(run.current.min() for run in runs):.1f} to "
        f"{max(run.current.max() for run in runs):.1f} A"
    )
    return found


def _motor_regression(drive: Drive, chosen: NDArray[np.bool_], current: bool = False) -> tuple[list[float], list[float]]:
    acceleration = signal.savgol_filter(drive.vx, 21, 2, deriv=1, delta=1.0 / RATE)
    lock = np.arctan(WHEELBASE * drive.yaw_rate / np.maximum(drive.vx, 0.1))
    columns = [drive.vx, acceleration, drive.vx * (1.0 / np.cos(lock) - 1.0)]
    return block_regression([*columns, drive.current] if current else columns, drive.motor, chosen)


def _joined(runs: list[Drive]) -> Drive:
    names = ("vx", "vy", "yaw_rate", "ax", "ay", "gyro", "motor", "current", "steer")
    return Drive("joined", *(np.concatenate([getattr(run, name) for run in runs]) for name in names))


def _publishers_filter(runs: list[Drive], say: Callable[[str], None]) -> dict[str, float]:
    """A Savitzky-Golay derivative leaves notches in the spectrum where its window spans whole waves; they tell the window."""
    say("\n## The publishers' Savitzky-Golay window")
    spectra = [signal.welch(run.yaw_rate, RATE, nperseg=512) for run in runs if len(run.yaw_rate) > 1024]
    frequency, power = spectra[0][0], np.median([spectrum for _, spectrum in spectra], axis=0)
    scores = {}
    for window in range(5, 31, 2):
        response = np.abs(signal.freqz(signal.savgol_coeffs(window, 2, deriv=1), worN=2 * np.pi * frequency / RATE)[1])
        band = (frequency > 5) & (frequency < 45)
        scores[window] = float(np.corrcoef(np.log(response[band] + 1e-4), np.log(power[band]))[0, 1])
    best, second = sorted(scores, key=lambda window: -scores[window])[:2]
    say(
        f"spectrum of r in the CSV files between 5 and 45 Hz against a filter of second order: {best} samples "
        f"(correlation of the logarithms {scores[best]:.2f}; next {second} with {scores[second]:.2f}; 9: {scores[9]:.2f})"
    )
    return {"publishers_window": float(best)}


def _same_drive(drive: Drive, runs: list[Drive], say: Callable[[str], None]) -> dict[str, float]:
    """Slides the liveliest seconds of the bag along every run."""
    say("\n## Is the bag's drive one of the CSV runs?")
    n = min(len(run.gyro) for run in runs)
    first = int(np.argmax(np.lib.stride_tricks.sliding_window_view(drive.gyro, n).std(axis=1)))
    piece = drive.gyro[first : first + n]
    best = (np.inf, "")
    for run in runs:
        squares = np.convolve(np.square(run.gyro), np.ones(n), mode="valid") - 2 * np.correlate(run.gyro, piece) + np.square(piece).sum()
        best = min(best, (float(np.sqrt(squares.min() / n)), run.name))
    own = np.sqrt(np.mean(np.square(piece - drive.yaw_rate[first : first + n])))
    say(
        f"the {n / RATE:.2f} s in which its yaw rate changes most (RMS {np.sqrt(np.mean(piece**2)):.2f} rad/s) differ by "
        f"{best[0]:.2f} rad/s RMS from the nearest stretch of all {len(runs)} runs ({best[1]}), "
        f"by {own:.2f} rad/s from the bag's own motion capture: "
        f"it is {'none' if best[0] > 2 * own else 'one'} of them"
    )
    return {"nearest_run_rms": best[0], "own_rms": float(own)}


def residual_rms(vx: Array, vy: Array, ay: Array, yaw_rate: Array, moving: NDArray[np.bool_], cutoff: float) -> tuple[float, float, float]:
    """d(vy)/dt - (ay - vx·r) below a frequency: RMS, mean, and standard deviation over that of ay.

    Args:
        vx, vy: reference [m/s], shape (T,).
        ay: measured [m/s²].
        yaw_rate: measured [rad/s].
        moving: samples that count.
        cutoff: of a second-order Butterworth filter run both ways [Hz].
    """
    derivative = signal.savgol_filter(vy, 9, 2, deriv=1, delta=1.0 / RATE)
    residual = _smooth(derivative - (ay - vx * yaw_rate), cutoff)
    counted = moving.copy()
    counted[:20] = counted[-20:] = False
    rest = residual[counted]
    return float(np.sqrt(np.mean(rest**2))), float(rest.mean()), float(rest.std() / _smooth(ay, cutoff)[counted].std())


def residuals_of(vx: Array, vy: Array, ay: Array, yaw_rate: Array) -> list[tuple[float, float, float]]:
    """Residuals below 5, 10 and 20 Hz where the car moves, and below 10 Hz where it does so gently."""
    moving = vx > MOVING
    gentle = moving & (np.abs(_smooth(vx * yaw_rate)) < GENTLE)
    residuals = [residual_rms(vx, vy, ay, yaw_rate, moving, cutoff) for cutoff in (5.0, 10.0, 20.0)]
    return [*residuals, residual_rms(vx, vy, ay, yaw_rate, gentle, 10.0)]


def residuals_of_recording(recording: Recording) -> list[tuple[float, float, float]]:
    """The same of a recording's reference and IMU."""
    return residuals_of(*(recording[name] for name in ("vx_ref", "vy_ref", "ay", "yaw_rate")))


def _residuals(declared: dict[str, Any], folder: Path, runs: list[Drive], say: Callable[[str], None]) -> dict[str, float]:
    say("\n## Residual of d(vy)/dt - (ay - vx·r) where vx > 0.5 m/s [m/s²], as vehest ingests the bag and as the CSV files are")
    here = declared | {"path": str(folder)}
    (bag,) = open_source(here).recordings()
    (wide,) = open_source(here | {"pose": declared["pose"] | {"window": 15}}).recordings()
    topics = declared["topics"]
    (averaged,) = open_source(here | {"topics": topics | {"imu": topics["imu"] | {"average": 0.01}}}).recordings()
    (held,) = open_source(here | {"topics": topics | {"servo": topics["servo"] | {"interpolation": "hold"}}}).recordings()
    variants = {"bag": bag, "bag, window of 15 samples": wide, "bag, IMU averaged over 10 ms": averaged}
    say(f"| drive | samples | RMS to 5 Hz | to 10 Hz | to 20 Hz | mean | to 10 Hz where abs(vx·r) < {GENTLE:g} | deviation, of ay's |")
    say("| :-- | --: | --: | --: | --: | --: | --: | --: |")
    rows = [(name, int((one["vx_ref"] > MOVING).sum()), residuals_of_recording(one)) for name, one in variants.items()]
    rows += [(run.name, int((run.vx > MOVING).sum()), residuals_of(run.vx, run.vy, run.ay, run.gyro)) for run in runs]
    found = {}
    for name, samples, ((low, mean, _), (middle, _, share), (high, _, _), (gentle, _, _)) in rows:
        say(f"| {name} | {samples} | {low:.2f} | {middle:.2f} | {high:.2f} | {mean:+.2f} | {gentle:.2f} | {share:.2f} |")
        found |= {f"residual {name}": middle, f"gentle_residual {name}": gentle, f"residual_share {name}": share}
    moving = bag["vx_ref"] > MOVING
    for name in ("vx_ref", "vy_ref", "yaw_rate_ref"):
        say(f"{name} with a window of 15 samples differs from that of 9 by {np.std((wide[name] - bag[name])[moving]):.4f} (RMS)")
    away = np.sqrt(np.mean(np.square(held["steer"] - bag["steer"])))
    say(f"holding the servo's command instead of drawing lines between commands changes steer by {away:.4f} rad (RMS)")
    return found


def _smooth(samples: Array, cutoff: float = CUTOFF) -> Array:
    return smooth(samples, cutoff, RATE)


def _most_frequent(samples: Array) -> tuple[float, float]:
    values, counts = np.unique(np.round(samples, 9), return_counts=True)
    return float(values[np.argmax(counts)]), float(counts.max() / len(samples))


if __name__ == "__main__":
    main()
