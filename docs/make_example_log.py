"""Write docs/examples/lap.csv, the log of the how-to guides: a simulated lap in the units of a logger.

Run by ``make example_log``, which simulates the lap and brings it to 20 Hz; the only argument is the stored recording.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import vehest

OUT = Path(__file__).parent / "examples" / "lap.csv"
STEERING_RATIO = 16.0
COLUMNS = "Timestamp,Speed,GyroZ,AccX,AccY,SteerWheel,SlipAngle"
FORMATS = ("%.2f", "%.3f", "%.3f", "%.3f", "%.3f", "%.2f", "%.3f")


def write_log(stored: Path) -> None:
    """Units of a logger: km/h, deg/s, m/s² with a reversed ay, the steering wheel's angle and an optical sensor's sideslip angle in deg."""
    recording = vehest.read_recording(stored)
    columns = (
        recording.time,
        3.6 * recording["vx"],
        np.degrees(recording["yaw_rate"]),
        recording["ax"],
        -recording["ay"],
        STEERING_RATIO * np.degrees(recording["steer"]),
        np.degrees(recording["sideslip_ref"]),
    )
    rows = np.stack(columns, axis=1)
    np.savetxt(OUT, rows, FORMATS, delimiter=",", header=COLUMNS, comments="")


if __name__ == "__main__":
    write_log(Path(sys.argv[1]))
