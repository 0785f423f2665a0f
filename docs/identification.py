"""What docs/identify_*.py share: the folder of the recordings, least squares, delays, a low-pass, the scatter of poses, printing.

A drive is a table with a row a sample of an even clock; its column ``kept`` says which rows count.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import signal

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Figures = dict[str, float]  # by name; those that end in ``_sd`` are standard deviations

BLOCK = 50  # samples that are resampled together


def data_folder() -> Path:
    """The folder with the recordings; ends the script where VEHEST_DATA does not name it."""
    root = os.environ.get("VEHEST_DATA")
    if not root:
        sys.exit("set VEHEST_DATA to the folder with the recordings")
    return Path(root)


def show(title: str, figures: Mapping[str, float]) -> None:
    """Print figures, each with its standard deviation where it has one."""
    print(f"\n## {title}")
    for name, value in figures.items():
        if not name.endswith("_sd"):
            print(f"{name:56} {value:.10g}" + (f" ± {figures[f'{name}_sd']:.2g}" if f"{name}_sd" in figures else ""))


def factors_of(columns: Mapping[str, Array], measured: Array, chosen: Any = slice(None)) -> Figures:
    """Factors of least squares by the columns' names, and their standard deviations over 200 resamples of the drive in blocks."""
    rows, values = np.stack(list(columns.values()), axis=1)[chosen], measured[chosen]
    blocks = len(rows) // BLOCK
    generator = np.random.default_rng(0)
    drawn = []
    for _ in range(200):
        picked = (generator.integers(0, blocks, blocks)[:, None] * BLOCK + np.arange(BLOCK)).ravel()
        drawn.append(np.linalg.lstsq(rows[picked], values[picked], rcond=None)[0])
    found = dict(zip(columns, np.linalg.lstsq(rows, values, rcond=None)[0].tolist(), strict=True))
    return found | {f"{name}_sd": sd for name, sd in zip(columns, np.std(drawn, axis=0).tolist(), strict=True)}


def rest_of(columns: Sequence[Array], measured: Array) -> Array:
    """What least squares leaves of a signal."""
    rows = np.stack(columns, axis=1)
    return np.asarray(measured - rows @ np.linalg.lstsq(rows, measured, rcond=None)[0])


def best_delay(delays: Iterable[float], columns_of: Callable[[float], Sequence[Array]], measured: Array) -> tuple[float, float]:
    """Standard deviation of the residual, and the delay [s] whose columns explain a signal best."""
    return min((float(rest_of(columns_of(delay), measured).std()), float(delay)) for delay in delays)


def joined(drives: Sequence[pd.DataFrame], name: str, rate: float, delay: float = 0.0) -> Array:
    """A signal of all drives as it was some time earlier, rows that count."""
    return np.concatenate([late(own[name].to_numpy(np.float64), delay, rate)[own["kept"].to_numpy()] for own in drives])


def explained(
    drives: Sequence[pd.DataFrame], rate: float, name: str, by: Sequence[str], delays: Iterable[float], chosen: Any = slice(None)
) -> Figures:
    """A sensor's signal by others that are some time older: factors, delay, residual, and correlation with the first of them."""
    measured = joined(drives, name, rate)[chosen]
    rest, delay = best_delay(delays, lambda one: [joined(drives, other, rate, one)[chosen] for other in by], measured)
    columns = {f"{name} by {other}": joined(drives, other, rate, delay)[chosen] for other in by}
    correlation = float(np.corrcoef(columns[f"{name} by {by[0]}"], measured)[0, 1])
    about = {"late [ms]": 1e3 * delay, "rest": rest, "varies by": float(measured.std()), "correlation": correlation, "rows": len(measured)}
    return factors_of(columns, measured) | {f"{name} {what}": value for what, value in about.items()}


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


def scatter(times: Array, place: Array, middles: Iterable[int]) -> Array:
    """Distance by which nine poses about each of some rows scatter about the cubic through them."""
    found = []
    for middle in middles:
        near = slice(middle - 4, middle + 5)
        basis = np.vander((times[near] - times[middle]) / 0.04, 4)
        rest = place[near] - basis @ np.linalg.lstsq(basis, place[near], rcond=None)[0]
        found.append(np.sqrt(np.square(rest).sum() / (9 - 4)))
    return np.array(found)
