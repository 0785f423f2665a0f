"""Where the car stands."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.derived import STANDSTILL_SPEED
from vehest.data.recording import Recording
from vehest.data.runs import equal_runs

BoolArray = NDArray[np.bool_]  # array of truth values

MAX_STANDSTILL_YAW_RATE = 0.05  # rad/s, largest magnitude of the yaw rate of a standing car
# m/s², largest standard deviation of an acceleration of a standing car
MAX_STANDSTILL_SHAKING = 0.3


def standstill(recording: Recording) -> BoolArray:
    """Where the car stands, (T,): the speed is zero and, where they are measured, neither yaw rate
    nor accelerations show motion.

    Parameters
    ----------
    recording : Recording
        Without ``vx`` the car counts as moving throughout.

    Returns
    -------
    BoolArray
        Decided run by run of slow samples: one that shakes or turns is moving as a whole.
    """
    is_standing = np.zeros(len(recording), dtype=bool)
    if "vx" not in recording:
        return is_standing
    slow = np.abs(recording["vx"]) < STANDSTILL_SPEED
    starts, ends = equal_runs(slow).T
    lengths = ends - starts
    is_still = slow[starts]
    if "yaw_rate" in recording:
        is_still &= ~(
            np.fmax.reduceat(np.abs(recording["yaw_rate"]), starts) > MAX_STANDSTILL_YAW_RATE
        )
    for name in ("ax", "ay"):
        if name in recording:
            is_still &= _spreads(recording[name], starts, lengths) <= MAX_STANDSTILL_SHAKING
    return np.repeat(is_still, lengths)


def _spreads(
    samples: FloatArray, starts: NDArray[np.int64], lengths: NDArray[np.int64]
) -> FloatArray:
    """Standard deviation of the known samples of each run; 0 where none is known."""
    measured = np.isfinite(samples)
    number = np.maximum(np.add.reduceat(measured.astype(np.int64), starts), 1)
    mean = np.add.reduceat(np.where(measured, samples, 0.0), starts) / number
    deviation = np.where(measured, samples - np.repeat(mean, lengths), 0.0)
    return np.asarray(
        np.sqrt(np.add.reduceat(np.square(deviation), starts) / number), dtype=np.float64
    )
