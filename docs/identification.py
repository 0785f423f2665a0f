"""What docs/identify_*.py share: the folder of the recordings, least squares, delays, a low-pass, the scatter of poses."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

BLOCK = 50  # samples that are resampled together


def data_folder() -> Path:
    """The folder with the recordings; ends the script where VEHEST_DATA does not name it."""
    root = os.environ.get("VEHEST_DATA")
    if not root:
        sys.exit("set VEHEST_DATA to the folder with the recordings")
    return Path(root)


def regression(columns: list[Array], measured: Array, chosen: Any = slice(None)) -> tuple[list[float], float]:
    """Factors of least squares, and the standard deviation of the residual."""
    rows, values = np.stack(columns, axis=1)[chosen], measured[chosen]
    factors = np.linalg.lstsq(rows, values, rcond=None)[0]
    return factors.tolist(), float((values - rows @ factors).std())


def block_regression(columns: list[Array], measured: Array, chosen: Any = slice(None)) -> tuple[list[float], list[float]]:
    """Factors of least squares, and their standard deviations over 200 resamples of the drive in blocks."""
    rows, values = np.stack(columns, axis=1)[chosen], measured[chosen]
    blocks = len(rows) // BLOCK
    generator = np.random.default_rng(0)
    drawn = []
    for _ in range(200):
        picked = (generator.integers(0, blocks, blocks)[:, None] * BLOCK + np.arange(BLOCK)).ravel()
        drawn.append(np.linalg.lstsq(rows[picked], values[picked], rcond=None)[0])
    return np.linalg.lstsq(rows, values, rcond=None)[0].tolist(), np.std(drawn, axis=0).tolist()


def best_delay(delays: Iterable[float], columns_of: Callable[[float], list[Array]], measured: Array) -> tuple[float, float, list[Array]]:
    """Residual, delay [s] and columns of the delay whose columns explain a signal best."""
    scored = []
    for delay in delays:
        columns = columns_of(delay)
        scored.append((regression(columns, measured)[1], float(delay), columns))
    return min(scored, key=lambda one: one[0])


def smooth(samples: Array, cutoff: float, rate: float) -> Array:
    """A second-order Butterworth low-pass, run both ways."""
    return np.asarray(signal.sosfiltfilt(signal.butter(2, cutoff, fs=rate, output="sos"), samples))


def late(samples: Array, delay: float, rate: float) -> Array:
    """A signal as it was some time earlier."""
    times = np.arange(len(samples)) / rate
    return np.interp(times - delay, times, samples)


def accelerations(vx: Array, vy: Array, yaw_rate: Array, rate: float) -> tuple[Array, Array]:
    """Lateral and longitudinal acceleration of planar motion [m/s²]."""
    return np.gradient(vy) * rate + vx * yaw_rate, np.gradient(vx) * rate - vy * yaw_rate


def squared_scatter(times: Array, place: Array, middle: int) -> Array:
    """Variance, along each axis, of nine poses about the cubic through them."""
    near = slice(middle - 4, middle + 5)
    basis = np.vander((times[near] - times[middle]) / 0.04, 4)
    rest = place[near] - basis @ np.linalg.lstsq(basis, place[near], rcond=None)[0]
    return np.asarray(np.square(rest).sum(axis=0) / (9 - 4))
