"""The shift between the clock of an estimate and that of a recording, by correlation with the
reference.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import DataError

MAX_RATE = 100.0  # Hz; estimate and reference are correlated at this rate at most
MIN_OVERLAP_SECONDS = 5.0  # s of samples that both have; a shift with less does not count
MIN_OVERLAP_SHARE = 0.5  # smallest overlap as a share of the shorter one's samples
MIN_VARIANCE_RATIO = 1.5
"""Smallest ratio of the variance unexplained at the second best shift to that at the best one;
below it the shift is ambiguous and refused.
"""

MIN_UNEXPLAINED = 1e-3  # share of the variance below which two shifts count as equally good


@dataclass(frozen=True)
class Series:
    """Samples of one quantity.

    Attributes
    ----------
    time : (T,) array
        Times, ascending [s].
    values : (T,) array
        NaN where there is no sample.
    """

    time: FloatArray
    values: FloatArray

    @property
    def rate_hz(self) -> float:
        """Mean sampling rate [Hz]."""
        return float((len(self.time) - 1) / (self.time[-1] - self.time[0]))

    def sampled(self, rate_hz: float) -> tuple[FloatArray, FloatArray]:
        """Resample to a uniform rate: deviations from the mean, 0 where there is no sample, and a
        mask, 1 where there is one.

        Parameters
        ----------
        rate_hz : float
            [Hz].

        Returns
        -------
        tuple of FloatArray
            (N,) each; values between samples are interpolated, across gaps they count as missing.
        """
        grid = self.time[0] + np.arange(int((self.time[-1] - self.time[0]) * rate_hz) + 1) / rate_hz
        finite = np.isfinite(self.values)
        measured = np.interp(grid, self.time, finite.astype(np.float64)) > 0.999
        values = np.interp(grid, self.time[finite], self.values[finite])
        centred = values - values[measured].mean() if measured.any() else values
        return np.where(measured, centred, 0.0), measured.astype(np.float64)


@dataclass(frozen=True)
class Shift:
    """Shift between the clocks of an estimate and of the reference."""

    seconds: float  # seconds to add to the times of the estimate
    correlation: float  # correlation with the reference after the shift


def estimate_shift(estimate: Series, reference: Series) -> Shift:
    """The shift at which an estimate correlates best with the reference.

    Every shift with at least half of the shorter series in common is tried. Gain and offset of the
    estimate do not matter. A delay of the estimator itself is part of the shift.

    Parameters
    ----------
    estimate : Series
        v or β of an estimate, on its own clock.
    reference : Series
        The same quantity of the recording's reference.

    Returns
    -------
    Shift
        Between samples by a parabola.

    Raises
    ------
    DataError
        There is too little in common, or another shift explains nearly as much of the variance, as
        on laps that resemble each other.
    """
    if min(np.isfinite(series.values).sum() for series in (estimate, reference)) < 2:
        raise DataError("--shift auto: there are no values to correlate; give --shift SECONDS")
    rate_hz = min(max(estimate.rate_hz, reference.rate_hz), MAX_RATE)
    correlations, lags = _correlations(
        reference.sampled(rate_hz), estimate.sampled(rate_hz), rate_hz
    )
    shifts = lags / rate_hz + reference.time[0] - estimate.time[0]
    if not np.isfinite(correlations).any():
        raise DataError("--shift auto: both are too short to correlate; give --shift SECONDS")
    best = int(np.argmax(correlations))
    peak = float(correlations[best])
    second_best = _second_peak(correlations, best)
    second = float(correlations[second_best]) if second_best is not None else 0.0
    unexplained = max(1.0 - max(peak, 0.0) ** 2, MIN_UNEXPLAINED)
    if 1.0 - max(second, 0.0) ** 2 < MIN_VARIANCE_RATIO * unexplained:
        alternative = (
            f", {second:.2f} at {shifts[second_best]:.3g} s" if second_best is not None else ""
        )
        raise DataError(
            f"--shift auto is ambiguous: its correlation with the reference is {peak:.2f} at "
            f"{shifts[best]:.3g} s{alternative}; give --shift SECONDS"
        )
    return Shift(float(shifts[best]) + _vertex(correlations, best) / rate_hz, peak)


def _correlations(
    reference: tuple[FloatArray, FloatArray],
    estimate: tuple[FloatArray, FloatArray],
    rate_hz: float,
) -> tuple[FloatArray, FloatArray]:
    """Pearson's correlation of the samples in common at every lag of the estimate in samples, and
    these lags; -inf where the samples are too few.
    """
    a, has_a = reference
    b, has_b = estimate
    size = len(a) + len(b) - 1
    lags = np.arange(-(len(b) - 1), len(a))

    def products(x: FloatArray, y: FloatArray) -> FloatArray:
        spectrum = np.fft.rfft(x, size) * np.conj(np.fft.rfft(y, size))
        return np.asarray(np.fft.irfft(spectrum, size)[lags])

    n = np.round(products(has_a, has_b))
    min_overlap = max(
        MIN_OVERLAP_SECONDS * rate_hz, MIN_OVERLAP_SHARE * min(has_a.sum(), has_b.sum())
    )
    enough = n >= min_overlap
    count = np.where(enough, n, 1.0)
    sum_a = products(a, has_b)
    sum_b = products(has_a, b)
    variance_a = products(a * a, has_b) - sum_a**2 / count
    variance_b = products(has_a, b * b) - sum_b**2 / count
    covariance = products(a, b) - sum_a * sum_b / count
    floor = 1e-9 * max(float((a * a).sum()), np.finfo(float).tiny)
    floor *= max(float((b * b).sum()), np.finfo(float).tiny)
    product = variance_a * variance_b
    usable = enough & (product > floor)
    correlation = covariance / np.sqrt(np.where(usable, product, 1.0))
    return np.where(usable, correlation, -np.inf), lags.astype(np.float64)


def _second_peak(correlations: FloatArray, best: int) -> int | None:
    """Index of the highest local maximum outside the lobe of the best one; None without any."""
    low = high = best
    limit = 0.5 * correlations[best]
    while low > 0 and correlations[low] > limit:
        low -= 1
    while high < len(correlations) - 1 and correlations[high] > limit:
        high += 1
    outside = correlations.copy()
    outside[low : high + 1] = -np.inf
    highest = int(np.argmax(outside))
    return highest if np.isfinite(outside[highest]) else None


def _vertex(correlations: FloatArray, best: int) -> float:
    """Position of the vertex of the parabola through the best lag and its neighbours, in samples
    from the best lag.
    """
    if not 0 < best < len(correlations) - 1:
        return 0.0
    before, peak, after = correlations[best - 1 : best + 2]
    curvature = before - 2.0 * peak + after
    if not np.isfinite(curvature) or curvature >= 0.0:
        return 0.0
    return float(0.5 * (before - after) / curvature)
