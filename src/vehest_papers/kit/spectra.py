"""Welch periodograms of recordings and of estimation errors, and the process noise of the kinematic
model.

Source: Welch 1967; Da Lio et al. 2023, Sections VII-A and VIII-F.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.recording import Recording

SEGMENT_SECONDS = 25.6  # length of a segment [s]: 512 samples at 20 Hz, a line every 0.04 Hz
THIRD_OCTAVE = 2.0 ** (1.0 / 6.0)


@dataclass(frozen=True, eq=False)
class Periodogram:
    """One-sided power spectral density."""

    frequency: FloatArray  # lines from 0 to half the sampling rate [Hz], shape (F,)
    density: FloatArray  # [unit² / Hz], shape (F,)
    n_segments: int  # segments that were averaged

    @property
    def power(self) -> float:
        """Mean square of the signal without its segments' means [unit²]."""
        return float(self.density.sum() * self.frequency[1])

    def level(self, hz: float) -> float:
        """Mean density in the third of an octave around a frequency, or of the nearest line
        [unit²/Hz].

        Raises
        ------
        DataError
            The frequency lies outside the lines above 0.
        """
        if not self.frequency[1] <= hz <= self.frequency[-1]:
            raise DataError(
                f"a periodogram with lines from {self.frequency[1]:.3g} to "
                f"{self.frequency[-1]:.3g} Hz has no line at {hz:g} Hz"
            )
        return float(self.density[third_octave(self.frequency, hz)].mean())


def third_octave(frequency: FloatArray, hz: float) -> NDArray[np.bool_]:
    """Which lines lie in the third of an octave around a frequency; the nearest one does, (F,)."""
    inside = (frequency >= hz / THIRD_OCTAVE) & (frequency <= hz * THIRD_OCTAVE)
    inside[np.argmin(np.abs(frequency - hz))] = True
    return inside


def periodogram(series: Sequence[FloatArray], rate_hz: float) -> Periodogram:
    """Welch's method over several series: Hann windows of `SEGMENT_SECONDS` that overlap by half,
    each segment without its mean.

    Series count by their number of segments; what is left over at the end of each counts nowhere.
    The line at 0 Hz and, because the window spreads what slowly varies, the one beside it are not
    reliable.

    Parameters
    ----------
    series
        Uniformly sampled, finite, each of shape (T,).
    rate_hz
        Sampling rate [Hz].

    Raises
    ------
    DataError
        There is none, one is shorter than a segment, or one has gaps.
    """
    length = round(SEGMENT_SECONDS * rate_hz)
    if not series:
        raise DataError("a periodogram needs at least one series")
    total = np.zeros(length // 2 + 1)
    n_segments = 0
    for position, samples in enumerate(series):
        if len(samples) < length:
            raise DataError(
                f"series {position} lasts {len(samples) / rate_hz:.1f} s, less than a segment of "
                f"the periodogram ({SEGMENT_SECONDS:g} s); give longer ones or a shorter segment"
            )
        if not np.isfinite(samples).all():
            raise DataError(f"series {position} has gaps, which a periodogram cannot skip")
        frequency, density = signal.welch(
            samples,
            rate_hz,
            window="hann",
            nperseg=length,
            noverlap=length // 2,
            detrend="constant",
        )
        n_of_series = 1 + (len(samples) - length) // (length - length // 2)
        total += n_of_series * density
        n_segments += n_of_series
    return Periodogram(frequency, total / n_segments, n_segments)


def lateral_velocity_rate(recording: Recording) -> FloatArray:
    """Central difference of ``vy_ref`` at all samples but the first and the last, shape (T - 2,)
    [m/s²].

    At frequency f it shows the rate times sin(2πf/rate)/(2πf/rate): 0.98 of it at 1 Hz and 0.64 at
    5 Hz for 20 Hz.

    Raises
    ------
    DataError
        The channel is missing or too short.
    """
    velocity = recording["vy_ref"]
    if len(velocity) < 3:
        raise DataError(
            f"recording '{recording.id}' has {len(velocity)} samples; a central difference needs "
            "three"
        )
    return (velocity[2:] - velocity[:-2]) * (0.5 * recording.rate_hz)


def process_noise(recording: Recording) -> FloatArray:
    """What the kinematic model leaves of the rate of v, v̇ - (a_y - ω u_m), at all samples but the
    ends, shape (T - 2,) [m/s²].

    Source: Da Lio et al. 2023, Section VII-A.

    Raises
    ------
    DataError
        A channel is missing.
    """
    slip_rate = recording["ay"] - recording["yaw_rate"] * recording["vx"]
    return lateral_velocity_rate(recording) - slip_rate[1:-1]


def mean_bias(recordings: Sequence[Recording]) -> float:
    """Mean of the process noise over all samples of all recordings [m/s²] (Da Lio et al. 2023,
    Section VII-A1).
    """
    return float(np.concatenate([process_noise(recording) for recording in recordings]).mean())


def decibels(density: float, reference: float) -> float:
    """By how much one power density lies above another [dB]."""
    return float(10.0 * np.log10(density / reference))
