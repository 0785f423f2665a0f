"""The simulated tyre sets beside the recording that the learned-dynamics UKF trains on, iros_hoons_1.

    VEHEST_DATA=FOLDER python docs/compare_tyre_sets.py

prints what conf/vehicle/f1tenth.yaml and the sensors ``small_car`` take from that recording, then a Markdown table of quantiles. Of the
paper's other recordings, which are for tests, nothing is read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
import yaml
from scipy import signal

from vehest.data.recording import Recording
from vehest.run.config import compose_config
from vehest.sources.base import open_source

REAL = ("f1tenth", "iros_hoons_1_with_friction_run_*")
SIMULATED = (("sim_tyre_sets", "learn_a_*"), ("sim_tyre_sets", "test_a_*"), ("sim_tyre_sets", "test_d_*"))
SLOWEST = 0.5  # [m/s]; the real recordings are cut where the car is slower
CAR = yaml.safe_load((Path(__file__).parents[1] / "conf" / "vehicle" / "f1tenth.yaml").read_text(encoding="utf-8"))["parameters"]


def _slip(drive: Recording) -> np.ndarray:
    return np.asarray((drive["vx"] - drive["vx_ref"]) / drive["vx_ref"])


def _rear(drive: Recording) -> np.ndarray:
    return np.degrees(np.abs(np.arctan2(drive["vy_ref"] - CAR["cg_to_rear_axle"] * drive["yaw_rate_ref"], drive["vx_ref"])))


def _lacks(channel: str) -> Callable[[Recording], np.ndarray]:
    """What an inertial channel shows beside the reference's derivatives, either sign."""

    def lack(drive: Recording) -> np.ndarray:
        rate, turn, vx, vy = drive.rate_hz, drive["yaw_rate_ref"], drive["vx_ref"], drive["vy_ref"]
        true = {"ax": np.gradient(vx) * rate - vy * turn, "ay": np.gradient(vy) * rate + vx * turn, "yaw_rate": turn}
        return np.abs(drive[channel] - true[channel])

    return lack


def _derivative(samples: np.ndarray, rate_hz: float) -> np.ndarray:
    return np.asarray(signal.savgol_filter(samples, 15, 2, deriv=1, delta=1.0 / rate_hz))


def _ay(drive: Recording) -> np.ndarray:
    return np.asarray(_derivative(drive["vy_ref"], drive.rate_hz) + drive["vx_ref"] * drive["yaw_rate_ref"])


def identified() -> Iterator[str]:
    """Lines: motor, steering and vibration of the real car, with mass, wheel radius and wheelbase as given."""
    mass, radius, wheelbase = CAR["mass"], CAR["wheel_radius"], CAR["cg_to_front_axle"] + CAR["cg_to_rear_axle"]
    drives = _drives(*REAL)
    columns = []
    for drive in drives:
        vx, vy, turn, rate = drive["vx_ref"], drive["vy_ref"], drive["yaw_rate_ref"], drive.rate_hz
        ax = _derivative(vx, rate) - vy * turn
        scrub = -_ay(drive) * np.tan(drive["steer"]) * CAR["cg_to_rear_axle"] / wheelbase
        rows = np.stack([ax - scrub, drive["motor_current"], -_derivative(drive["vx"], rate), -np.ones_like(ax)])
        second = np.ones(100) / 100.0
        columns.append(np.stack([np.convolve(row, second, "valid") for row in rows]))
    left, *right = np.concatenate(columns, axis=1)
    per_ampere, inertia, friction = np.linalg.lstsq(np.stack(right, axis=1), left, rcond=None)[0]
    yield f"torque_constant {per_ampere * mass * radius:.4f} N m/A, or {per_ampere:.3f} m/s² per ampere"
    yield f"motor_inertia and wheels {inertia * mass * radius**2:.2e} kg m², or {inertia * mass:.2f} kg at the rim"
    yield f"coulomb_torque {friction * mass * radius:.2f} N m, or {friction:.2f} m/s²"
    steer_rate = np.concatenate([np.abs(np.gradient(drive["steer"])) * drive.rate_hz for drive in drives])
    largest = max(drive["steer"].max() for drive in drives)
    yield f"steering_rate: 99 % below {np.quantile(steer_rate, 0.99):.2f} rad/s; largest_steer {largest:.3f} rad"
    speed = np.concatenate([drive["motor_speed"] for drive in drives])
    for channel in ("yaw_rate", "ax", "ay"):
        squares = np.concatenate([_lacks(channel)(drive) for drive in drives]) ** 2
        spread = {low: np.sqrt(squares[(speed >= low) & (speed < low + 10)].mean()) for low in range(10, 80, 10)}
        yield f"{channel} less its truth, by wheel speed from [rad/s]: " + ", ".join(f"{low}: {value:.2f}" for low, value in spread.items())
    for channel in ("yaw_rate_ref", "vx_ref", "vy_ref", "vx", "motor_current"):
        jumps = np.concatenate([np.diff(drive[channel], 2) for drive in drives])
        yield f"{channel}: second differences of {jumps.std() / np.sqrt(6.0):.4f} as white noise a sample"


QUANTITIES: dict[str, tuple[Callable[[Recording], np.ndarray], str]] = {
    "v_x [m/s]": (lambda drive: drive["vx_ref"], ".2f"),
    "abs v_y [m/s]": (lambda drive: np.abs(drive["vy_ref"]), ".2f"),
    "abs yaw rate [rad/s]": (lambda drive: np.abs(drive["yaw_rate_ref"]), ".2f"),
    "abs ay, reference [m/s²]": (lambda drive: np.abs(_ay(drive)), ".1f"),
    "abs β [°]": (lambda drive: np.degrees(np.abs(np.arctan2(drive["vy_ref"], drive["vx_ref"]))), ".1f"),
    "abs slip angle, rear [°]": (_rear, ".1f"),
    "slip ratio of the motor": (_slip, ".2f"),
    "motor current [A]": (lambda drive: drive["motor_current"], ".0f"),
    "abs steer [rad]": (lambda drive: np.abs(drive["steer"]), ".2f"),
    "abs ax less its truth [m/s²]": (_lacks("ax"), ".1f"),
    "abs ay less its truth [m/s²]": (_lacks("ay"), ".1f"),
    "abs yaw rate less its truth [rad/s]": (_lacks("yaw_rate"), ".2f"),
}
QUANTILES = (0.01, 0.25, 0.5, 0.75, 0.95, 0.99)


def _drives(dataset: str, pattern: str) -> list[Recording]:
    source = open_source(compose_config("ingest", [f"dataset={dataset}"])["dataset"])
    return [source.read(name) for name in source.ids() if fnmatchcase(name, pattern)]


def table() -> Iterator[str]:
    """Lines of the table: a row a quantity, a column a set, in a cell the quantiles."""
    sets = {"real": _drives(*REAL)} | {f"`{pattern}`": _drives(name, pattern) for name, pattern in SIMULATED}
    shares = ", ".join(f"{100 * quantile:g} %" for quantile in QUANTILES)
    yield f"| {shares} of | " + " | ".join(sets) + " |"
    yield "| :-- |" + " :-- |" * len(sets)
    for name, (quantity, style) in QUANTITIES.items():
        cells = []
        for drives in sets.values():
            values = np.concatenate([quantity(drive)[drive["vx_ref"] > SLOWEST] for drive in drives])
            cells.append(", ".join(f"{value:{style}}" for value in np.quantile(values, QUANTILES)))
        yield f"| {name} | " + " | ".join(cells) + " |"
    minutes = [f"{sum(map(len, drives)) / 6000.0:.1f}" for drives in sets.values()]
    slow = [f"{100.0 * np.concatenate([drive['vx_ref'] <= SLOWEST for drive in drives]).mean():.1f}" for drives in sets.values()]
    yield "| minutes | " + " | ".join(minutes) + " |"
    yield f"| % of samples at {SLOWEST} m/s or less, left out above | " + " | ".join(slow) + " |"


if __name__ == "__main__":
    print("\n".join([*identified(), "", *table()]))
