"""What judging the health of an estimate takes: a row online, and a row in batch, on a drive that obeys planar kinematics.

Prints microseconds of the processor a row, the least of five passes over a minute at 100 Hz; one thread, after compilation.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

SETS = (("yaw_rate", "vx", "ay", "ax"), ("yaw_rate", "vx", "ay", "ax", "steer"))
PASSES = 5


def main() -> None:
    """Measure and print."""
    from single_track_drive import linear_drive
    from vehest.trust.health import health_rows, learn_health

    drives = [linear_drive(60.0, 100.0, seed)[0] for seed in range(3)]
    for channels in SETS:
        model = learn_health(drives[:1], drives[1:2], channels, 100.0)
        packed, rows = model.packed(), np.ascontiguousarray(drives[2].stack(channels))
        measured = np.isfinite(rows)
        single = [(rows[k : k + 1], measured[k : k + 1]) for k in range(len(rows))]
        online, batch = [], []
        for _ in range(PASSES):
            state, started = model.start(), time.process_time()
            health_rows(packed, rows, measured, state)
            batch.append(time.process_time() - started)
            state, started = model.start(), time.process_time()
            for row, known in single:
                health_rows(packed, row, known, state)
            online.append(time.process_time() - started)
        least = [1e6 * min(times) / len(rows) for times in (online, batch)]
        print(f"{', '.join(channels)}: {least[0]:.2f} µs a row online, {least[1]:.2f} µs in batch, order {len(model.coefficients)}")


if __name__ == "__main__":
    main()
