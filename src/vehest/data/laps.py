"""Finds laps without positions: the curvature of the path, over the distance driven, repeats."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.recording import Recording

MAX_POINTS = 8192  # points of the path, at most
# smallest correlation between the curvatures of a lap and of the next; drivers take other lines,
# the course stays
MIN_LAP_CORRELATION = 0.6
# share of the best correlation from which on a shorter period is taken, since two laps repeat too
MIN_SHARE_OF_BEST = 0.9
# rad, largest deviation of the heading after a lap from a whole number of turns, gyro drift
# included
MAX_HEADING_ERROR = 0.8
# spread of the curvature over its mean, below which the path is a circle, of which a lap is a turn
MAX_CIRCLE_SPREAD = 0.2
MAX_MISSING_SHARE = 0.005  # share of a lap that a last one may lack and count as complete
# share of a lap by which the next boundary may lie before or after the expected place
SEARCH_SHARE = 0.04


def laps_of(recording: Recording) -> list[tuple[float, float]]:
    """Start and stop of each complete lap [s], one after another; empty where nothing repeats, as
    in less than two laps.

    The path is that of ``vx`` and ``yaw_rate``, driven forwards. The first lap begins where the
    recording does, wherever that is on the course.

    Parameters
    ----------
    recording : Recording
        With vx (else vx_ref) and yaw_rate (else yaw_rate_ref).

    Raises
    ------
    DataError
        It lacks one of them.
    """
    speed = _first_of(recording, "vx", "vx_ref")
    turning = _first_of(recording, "yaw_rate", "yaw_rate_ref")
    distance = np.cumsum(np.maximum(speed, 0.0)) / recording.rate_hz
    heading = np.cumsum(np.where(speed > 0.0, turning, 0.0)) / recording.rate_hz
    if len(recording) < 16 or not distance[-1] > 0.0:
        return []
    points = min(MAX_POINTS, len(recording))
    grid = np.linspace(0.0, distance[-1], points)
    turned = np.interp(grid, distance, heading)
    curvature = np.diff(turned) / (grid[1] - grid[0])
    if np.std(curvature) < MAX_CIRCLE_SPREAD * abs(float(np.mean(curvature))):
        bounds = _turns(turned)
    else:
        period = _period(curvature, turned)
        bounds = [] if period is None else _boundaries(curvature, period)
    times = [float(np.interp(grid[bound], distance, recording.time)) for bound in bounds]
    return list(pairwise(times))


def _first_of(recording: Recording, *names: str) -> FloatArray:
    """Samples of the first of several channels that a recording has, 0 for NaN; `DataError` for
    none.
    """
    name = next((name for name in names if name in recording), None)
    if name is None:
        raise DataError(
            f"recording '{recording.id}' has neither {' nor '.join(names)}, without which no laps "
            "can be found"
        )
    return np.nan_to_num(recording[name])


def _turns(turned: FloatArray) -> list[int]:
    """Indices of the points at which whole turns of a circle are completed, 0 first, by the
    accumulated heading ``turned`` [rad].
    """
    n_turns = np.floor(np.abs(turned - turned[0]) / (2.0 * math.pi) + 1e-9)
    return [0, *(np.flatnonzero(np.diff(np.maximum.accumulate(n_turns))) + 1).tolist()]


def _period(curvature: FloatArray, turned: FloatArray) -> int | None:
    """Number of points after which the curvature repeats and the heading is the same again; None
    where there is none.

    None where that is never.
    """
    correlation = _correlations(curvature)
    lags = np.arange(len(correlation))
    sums = np.concatenate([[0.0], np.cumsum(turned)])
    mean_turn = (sums[-1] - sums[lags] - sums[len(turned) - lags]) / (len(turned) - lags)
    off = np.abs(mean_turn - 2.0 * math.pi * np.rint(mean_turn / (2.0 * math.pi)))
    peak = np.zeros(len(correlation), dtype=bool)
    peak[1:-1] = (correlation[1:-1] >= correlation[:-2]) & (correlation[1:-1] > correlation[2:])
    periods = np.flatnonzero(
        peak & (correlation > MIN_LAP_CORRELATION) & (off < MAX_HEADING_ERROR) & (lags >= 8)
    )
    if not len(periods):
        return None
    best = correlation[periods].max()
    return int(periods[correlation[periods] >= MIN_SHARE_OF_BEST * best][0])


def _correlations(samples: FloatArray) -> FloatArray:
    """Autocorrelation (Pearson) of samples for lags of 0 to half their number."""
    number = len(samples)
    size = 1 << (2 * number - 1).bit_length()
    spectrum = np.fft.rfft(samples, size)
    products = np.fft.irfft(spectrum * spectrum.conj(), size)[:number]
    sums, squares = (
        np.concatenate([[0.0], np.cumsum(power)]) for power in (samples, np.square(samples))
    )
    lags = np.arange(number // 2 + 1)
    left = number - lags
    first_sum = sums[left]
    second_sum = sums[number] - sums[lags]
    first_square = squares[left] - first_sum**2 / left
    second_square = squares[number] - squares[lags] - second_sum**2 / left
    scatter = np.sqrt(np.maximum(first_square * second_square, 0.0))
    together = products[: len(lags)] - first_sum * second_sum / left
    return np.divide(
        together, scatter, out=np.zeros(len(lags)), where=scatter > 1e-12 * squares[number]
    )


def _boundaries(curvature: FloatArray, period: int) -> list[int]:
    """Indices of the points at which laps begin, and of the end of the last complete one: each a
    period after the one before, shifted to where the two laps agree best.
    """
    bounds = [0]
    reach = max(round(SEARCH_SHARE * period), 1)
    while bounds[-1] + period < len(curvature):
        last = bounds[-1]
        length = min(
            period, len(curvature) - last - period - reach
        )  # so that every move has as many points to fit
        if length < period // 4:
            bounds.append(last + period)
            continue
        template = curvature[last : last + length]
        starts = last + period + np.arange(-reach, reach + 1)
        misfits = [
            float(np.sum(np.square(template - curvature[start : start + length])))
            for start in starts
        ]
        bounds.append(int(starts[int(np.argmin(misfits))]))
    if len(bounds) > 1 and len(curvature) - bounds[-1] >= period - max(
        round(MAX_MISSING_SHARE * period), 2
    ):
        bounds.append(len(curvature))
    return bounds
