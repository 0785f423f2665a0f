"""The paper's statements beside Table 3: errors lap by lap, underestimated sideslip, errors before
a stop.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording

LAPS = 3
SKIP_SECONDS = 1.5
BLOCK_SECONDS = 10.0
MIN_SPEED = 0.3  # m/s
STOP_SECONDS = (5.0, 0.4)  # before the stop, in which an error counts


def laps_of(drive: Recording) -> list[NDArray[np.bool_]]:
    """Which samples belong to each of the three laps of equal length: thirds of the way."""
    share = shares_of_way(drive) * LAPS
    return [(share > lap) & (share <= lap + 1) for lap in range(LAPS)]


def shares_of_way(drive: Recording) -> FloatArray:
    """Share of the whole way that lies behind each sample, (T,)."""
    way = np.cumsum(np.maximum(drive["vx_ref"], 0.0))
    return np.asarray(way / way[-1], dtype=np.float64)


def log_change_of_last_lap(
    drive: Recording, estimate: Estimate, minimum_speed: float
) -> FloatArray:
    """Logarithm of the mean squared error of β on the last lap over that on the first, at the same
    places of the course, (B,).

    A lap is cut into stretches of equal length, which last 10 s on the faster of both.
    """
    squared = np.square(np.degrees(estimate["sideslip"] - drive["sideslip_ref"]))
    scored = (drive["vx"] >= minimum_speed) & (drive.time >= drive.start_time + SKIP_SECONDS)
    first, *_, last = (lap & scored for lap in laps_of(drive))
    n_samples = min(int(first.sum()), int(last.sum()))
    n_blocks = max(int(n_samples / drive.rate_hz / BLOCK_SECONDS), 1)
    of_lap = shares_of_way(drive) * LAPS % 1.0
    block = np.minimum((of_lap * n_blocks).astype(int), n_blocks - 1)
    means = [
        np.bincount(block[lap], squared[lap], n_blocks)
        / np.bincount(block[lap], minlength=n_blocks)
        for lap in (first, last)
    ]
    return np.asarray(np.log(means[1] / means[0]), dtype=np.float64)


def error_before_stop(drive: Recording, estimate: Estimate) -> float:
    """RMSE of β from 5 s to 0.4 s before the stop that ends a drive [deg]."""
    before = stop_of(drive) - drive.time
    chosen = (before <= STOP_SECONDS[0]) & (before > STOP_SECONDS[1])
    error = np.degrees(estimate["sideslip"] - drive["sideslip_ref"])[chosen]
    return float(np.sqrt(np.mean(np.square(error))))


def stop_of(drive: Recording) -> float:
    """When the car comes to its last stop [s]."""
    moves = np.flatnonzero(drive["vx_ref"] > MIN_SPEED)
    return float(drive.time[min(int(moves[-1]) + 1, len(drive) - 1)])
