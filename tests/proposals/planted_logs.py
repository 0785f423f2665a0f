"""A car that is known, as a logger might have written it; for tests."""

from functools import lru_cache

import numpy as np
import pandas as pd

from vehest.run.own_car.inspect import inspect

G = 9.80665
WHEELBASE = 2.7
RATIO = 15.0
RADIUS = 0.31
TRACK = 1.5


def drive(seconds=120.0, rate_hz=50.0, seed=0):
    """A linear single track on a winding road: SI units, ISO 8855, (T,) each, the wheels' and the
    steering wheel's angles with them.
    """
    generator = np.random.default_rng(seed)
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    phases = generator.uniform(0.0, 2.0 * np.pi, 6)
    vx = (
        20.0
        + 5.0 * np.sin(2 * np.pi * 0.02 * t + phases[0])
        + 2.0 * np.sin(2 * np.pi * 0.07 * t + phases[1])
    )
    target_ay = 2.5 * np.sin(2 * np.pi * 0.11 * t + phases[2]) + 1.5 * np.sin(
        2 * np.pi * 0.23 * t + phases[3]
    )
    r = target_ay / vx
    vy = r * (1.4 - 0.0045 * vx * vx) + 0.08 * np.sin(2 * np.pi * 0.31 * t + phases[4])
    steer = WHEELBASE * r / vx + 0.002 * target_ay
    ax = np.gradient(vx, t) - vy * r
    ay = np.gradient(vy, t) + vx * r

    def noisy(samples, level):
        return samples + level * generator.standard_normal(len(t))

    side = 0.5 * TRACK * r
    wheels = {"fl": vx - side, "fr": vx + side, "rl": vx - side, "rr": vx + side}
    return {
        "t": t,
        "vx": noisy(vx, 0.02),
        "vy": noisy(vy, 0.005),
        "r": noisy(r, 0.002),
        "ax": noisy(ax, 0.05),
        "ay": noisy(ay, 0.05),
        "steer": noisy(steer, 2e-4),
        "handwheel": noisy(RATIO * steer, 2e-3),
        "sideslip": np.arctan2(vy, vx),
        **{f"wheel_{corner}": noisy(speed / RADIUS, 0.03) for corner, speed in wheels.items()},
    }


def usual(d):
    """km/h, deg/s and g under names that an engineer would give."""
    return pd.DataFrame(
        {
            "Time [s]": d["t"],
            "Speed": 3.6 * d["vx"],
            "Gyro": np.degrees(d["r"]),
            "LatAcc": d["ay"] / G,
            "LongAcc": d["ax"] / G,
            "Steer": np.degrees(d["handwheel"]),
            "Beta": np.degrees(d["sideslip"]),
        }
    )


@lru_cache(maxsize=100)
def _cells(samples):
    """The cells of a column as pandas writes them."""
    column = pd.Series(np.frombuffer(samples)).to_csv(index=False, header=False)
    return column.replace('""', "").splitlines()


def write(file, table, **options):
    """A table of text.

    Columns of numbers, most of which many tests write alike, become text once.
    """
    table = table.round(5)
    if options or len(table.columns) < 2 or not (table.dtypes == np.float64).all():
        table.to_csv(file, index=False, **options)
    else:
        columns = [_cells(samples.tobytes()) for samples in table.to_numpy().T]
        rows = map(",".join, zip(*columns, strict=True))
        file.write_text("\n".join([table.iloc[:0].to_csv(index=False).rstrip("\n"), *rows, ""]))
    return file


def inspected(*files, vehicle=None):
    """What `vehest new my_car` finds in files."""
    return inspect("my_car", files, vehicle)


def examine(folder, table, **options):
    """What it finds in the file of a table."""
    return inspected(write(folder / "lap.csv", table, **options))
