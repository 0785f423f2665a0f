"""The simulated tyre sets beside the recording that the learned-dynamics UKF trains on, iros_hoons_1.

    VEHEST_DATA=FOLDER python tools/compare_tyre_sets.py

prints what conf/vehicle/f1tenth.yaml and the sensors ``small_car`` take from that recording, then a Markdown table of quantiles. Of the
paper's other recordings, which are for tests, nothing is read.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
import pandas as pd
import yaml
from scipy import signal

from vehest.configuration.composition import compose_config
from vehest.data.recording import Recording
from vehest.sources.base import open_source

REAL = ("f1tenth", "iros_hoons_1_with_friction_run_*")
SIMULATED = (
    ("sim_tyre_sets", "learn_a_*"),
    ("sim_tyre_sets", "test_a_*"),
    ("sim_tyre_sets", "test_d_*"),
)
SLOWEST = 0.5  # [m/s]; the real recordings are cut where the car is slower
CAR = yaml.safe_load(
    (Path(__file__).parents[1] / "conf" / "vehicle" / "f1tenth.yaml").read_text(encoding="utf-8")
)["parameters"]
REAR = CAR["cg_to_rear_axle"]
QUANTILES = (0.01, 0.25, 0.5, 0.75, 0.95, 0.99)
DIGITS = (2, 2, 2, 1, 1, 1, 2, 0, 2, 1, 1, 2)


def drives_of(dataset: str, pattern: str) -> list[Recording]:
    """Recordings of a data set whose names are like a pattern."""
    source = open_source(compose_config("ingest", [f"dataset={dataset}"])["dataset"])
    return [source.read(name) for name in source.ids() if fnmatchcase(name, pattern)]


def quantities(drive: Recording) -> pd.DataFrame:
    """A column a quantity, of `DIGITS`; what inertial channels show beside the reference's derivatives counts either sign."""
    vx = drive["vx_ref"]
    vy = drive["vy_ref"]
    turn = drive["yaw_rate_ref"]
    rate = drive.rate_hz
    ax = np.gradient(vx) * rate - vy * turn
    ay = np.gradient(vy) * rate + vx * turn
    return pd.DataFrame(
        {
            "v_x [m/s]": vx,
            "abs v_y [m/s]": np.abs(vy),
            "abs yaw rate [rad/s]": np.abs(turn),
            "abs ay, reference [m/s²]": np.abs(derivative(vy, rate) + vx * turn),
            "abs β [°]": np.degrees(np.abs(np.arctan2(vy, vx))),
            "abs slip angle, rear [°]": np.degrees(np.abs(np.arctan2(vy - REAR * turn, vx))),
            "slip ratio of the motor": (drive["vx"] - vx) / vx,
            "motor current [A]": drive["motor_current"],
            "abs steer [rad]": np.abs(drive["steer"]),
            "abs ax less its truth [m/s²]": np.abs(drive["ax"] - ax),
            "abs ay less its truth [m/s²]": np.abs(drive["ay"] - ay),
            "abs yaw rate less its truth [rad/s]": np.abs(drive["yaw_rate"] - turn),
        }
    )


def derivative(samples: np.ndarray, rate_hz: float) -> np.ndarray:
    """By a Savitzky-Golay filter."""
    return np.asarray(signal.savgol_filter(samples, 15, 2, deriv=1, delta=1.0 / rate_hz))


def identified(drives: Sequence[Recording]) -> Iterator[str]:
    """Lines: motor, steering and vibration of the real car, with mass, wheel radius and wheelbase as given."""
    mass = CAR["mass"]
    radius = CAR["wheel_radius"]
    wheelbase = CAR["cg_to_front_axle"] + REAR
    columns = []
    for drive in drives:
        vx = drive["vx_ref"]
        vy = drive["vy_ref"]
        turn = drive["yaw_rate_ref"]
        rate = drive.rate_hz
        scrub = -(derivative(vy, rate) + vx * turn) * np.tan(drive["steer"]) * REAR / wheelbase
        left = derivative(vx, rate) - vy * turn - scrub
        rows = (left, drive["motor_current"], -derivative(drive["vx"], rate), -np.ones_like(vx))
        columns.append(np.stack([np.convolve(row, np.ones(100) / 100.0, "valid") for row in rows]))
    left, *right = np.concatenate(columns, axis=1)
    per_ampere, inertia, friction = np.linalg.lstsq(np.stack(right, axis=1), left, rcond=None)[0]
    yield f"torque_constant {per_ampere * mass * radius:.4f} N m/A, or {per_ampere:.3f} m/s² per ampere"
    yield f"motor_inertia and wheels {inertia * mass * radius**2:.2e} kg m², or {inertia * mass:.2f} kg at the rim"
    yield f"coulomb_torque {friction * mass * radius:.2f} N m, or {friction:.2f} m/s²"
    steer_rate = np.concatenate(
        [np.abs(np.gradient(drive["steer"])) * drive.rate_hz for drive in drives]
    )
    largest = max(drive["steer"].max() for drive in drives)
    yield f"steering_rate: 99 % below {np.quantile(steer_rate, 0.99):.2f} rad/s; largest_steer {largest:.3f} rad"
    shown = pd.concat(map(quantities, drives))
    speed = np.concatenate([drive["motor_speed"] for drive in drives])
    spread = (shown.filter(like="less its truth") ** 2).groupby(speed // 10 * 10).mean() ** 0.5
    yield f"RMS by wheel speed from [rad/s]:\n{spread.loc[10:70].round(2).to_string()}"
    for channel in ("yaw_rate_ref", "vx_ref", "vy_ref", "vx", "motor_current"):
        jumps = np.concatenate([np.diff(drive[channel], 2) for drive in drives])
        yield f"{channel}: second differences of {jumps.std() / np.sqrt(6.0):.4f} as white noise a sample"


def table(sets: dict[str, list[Recording]]) -> Iterator[str]:
    """Lines of the table: a row a quantity, a column a set, in a cell the quantiles."""
    frames = [pd.concat(map(quantities, drives)) for drives in sets.values()]
    yield f"| {', '.join(f'{100 * quantile:g} %' for quantile in QUANTILES)} of | {' | '.join(sets)} |"
    yield "| :-- |" + " :-- |" * len(sets)
    for name, digits in zip(frames[0], DIGITS, strict=True):
        cells = [frame[name][frame["v_x [m/s]"] > SLOWEST].quantile(QUANTILES) for frame in frames]
        yield (
            f"| {name} | "
            + " | ".join(", ".join(f"{value:.{digits}f}" for value in cell) for cell in cells)
            + " |"
        )
    yield "| minutes | " + " | ".join(f"{len(frame) / 6000.0:.1f}" for frame in frames) + " |"
    slow = [100.0 * (frame["v_x [m/s]"] <= SLOWEST).mean() for frame in frames]
    yield (
        f"| % of samples at {SLOWEST} m/s or less, left out above | "
        + " | ".join(f"{share:.1f}" for share in slow)
        + " |"
    )


if __name__ == "__main__":
    real = drives_of(*REAL)
    print(
        "\n".join(
            [
                *identified(real),
                "",
                *table(
                    {"real": real, **{f"`{name}`": drives_of(of, name) for of, name in SIMULATED}}
                ),
            ]
        )
    )
