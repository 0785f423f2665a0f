"""Cross-spectra of signals over segments of a drive, and lags from their phase."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from vehest.alignment.standstill import BoolArray
from vehest.constants import FloatArray

ComplexArray = NDArray[np.complex128]  # array of complex numbers in double precision

BAND_HZ = (0.1, 3.0)  # Hz, where cars move and references can be differentiated
SEGMENT_SECONDS = (4.0, 16.0)  # s, length of the shortest and longest segment
# number of segments into which a drive is divided, without overlap, within SEGMENT_SECONDS
SEGMENTS_IN_A_DRIVE = 8.0
MIN_DRIVE_SECONDS = 16.0  # s, shortest drive that has spectra
MIN_RATE_HZ = 5.0  # Hz, lowest rate of a recording that has spectra
MIN_BINS = 4  # smallest number of frequencies in the band
MIN_SEGMENTS = 6  # smallest number of segments of selected samples alone
# smallest number of samples in a period of the highest frequency that is used
MIN_SAMPLES_A_PERIOD = 5.0
MIN_AVERAGED_RATE_HZ = 30.0  # Hz, lowest rate to which a faster recording is averaged down
# largest number of groups of segments, or blocks, that the jackknife leaves out in turn
MAX_GROUPS = 12
SMOOTHED_BINS = 5  # number of neighbouring bins of a running mean; odd
# largest coherence of a bin that counts; limits its weight, which is infinite at 1
MAX_COHERENCE = 0.99
# smallest power of a bin over that of the strongest (geometric mean of both signals); with less it
# has no weight, since a window leaks more
MIN_POWER_SHARE = 1e-6
MIN_MEAN_COHERENCE = 0.25  # smallest mean coherence over the band with which a lag is known
MAX_LAG_SECONDS = 1.2  # s, longest delay that is searched
MAX_TIME_CONSTANT_SECONDS = 10.0  # s, longest time constant that is searched
N_STEPS = 25  # largest number of Gauss-Newton steps of a fit
CONFIDENCE = 0.95  # level of all intervals, which texts call 95 %


@dataclass(frozen=True, eq=False)
class CrossSpectra:
    """Cross-spectra of N signals in F bins of the band, in G groups of segments that follow one
    another.
    """

    names: tuple[str, ...]  # names of the signals
    frequency: FloatArray  # frequencies of the bins [Hz], (F,)
    groups: ComplexArray  # sums of conj(X_i)·X_j over the segments of a group, (G, F, N, N)

    @property
    def omega(self) -> FloatArray:
        """Angular frequency [rad/s], (F,)."""
        return 2.0 * math.pi * self.frequency

    @property
    def total(self) -> ComplexArray:
        """Sum over the groups, (F, N, N)."""
        return np.asarray(self.groups.sum(axis=0), dtype=np.complex128)

    def combined(self, combinations: Mapping[str, Mapping[str, float]]) -> CrossSpectra:
        """Spectra of sums of the signals: name -> signal -> factor.

        Parameters
        ----------
        combinations : mapping
            New name -> old name -> real factor.

        Returns
        -------
        CrossSpectra
            Of the new signals alone.
        """
        rows = np.array(
            [[factors.get(name, 0.0) for name in self.names] for factors in combinations.values()]
        )
        return CrossSpectra(
            tuple(combinations),
            self.frequency,
            np.asarray(rows @ self.groups @ rows.T, dtype=np.complex128),
        )


def cross_spectra(
    signals: Mapping[str, FloatArray], rate_hz: float, selected: BoolArray | None = None
) -> CrossSpectra | None:
    """Estimate cross-spectra in the band by Welch's method under a Hann window.

    Parameters
    ----------
    signals : mapping of str to (T,)
        Name -> samples, all of one length and clock, without gaps.
    rate_hz : float
        Sampling rate [Hz].
    selected : (T,) of bool, optional
        Only segments whose samples are all selected count.

    Returns
    -------
    CrossSpectra or None
        None where the drive is too short or too slowly sampled.
    """
    duration = len(next(iter(signals.values()), ())) / rate_hz
    if duration < MIN_DRIVE_SECONDS or rate_hz < MIN_RATE_HZ:
        return None
    factor = max(math.floor(rate_hz / MIN_AVERAGED_RATE_HZ), 1)
    rate = rate_hz / factor
    seconds = min(max(duration / SEGMENTS_IN_A_DRIVE, SEGMENT_SECONDS[0]), SEGMENT_SECONDS[1])
    length = round(seconds * rate)
    frequency = np.fft.rfftfreq(length, 1.0 / rate)
    inside = (frequency >= max(BAND_HZ[0], 1.5 / seconds)) & (
        frequency <= min(BAND_HZ[1], rate / MIN_SAMPLES_A_PERIOD)
    )
    if np.count_nonzero(inside) < MIN_BINS:
        return None
    window = np.hanning(length + 1)[:-1]
    is_selected = None
    if selected is not None and not selected.all():
        is_selected = _pieces(selected.astype(np.float64), factor, length).min(axis=1) == 1.0
        if np.count_nonzero(is_selected) < MIN_SEGMENTS:
            return None
    parts = []
    for samples in signals.values():
        pieces = _pieces(samples, factor, length)
        pieces = pieces if is_selected is None else pieces[is_selected]
        level = pieces.mean(axis=1, keepdims=True)
        parts.append(np.fft.rfft((pieces - level) * window, axis=1)[:, inside])
    spectrum = np.stack(parts, axis=-1)  # (segments, F, N)
    edges = np.linspace(0, len(spectrum), min(MAX_GROUPS, len(spectrum)) + 1).astype(int)
    groups = []
    for first, last in itertools.pairwise(edges):
        across = spectrum[first:last].transpose(1, 2, 0)  # (F, N, segments)
        groups.append(across.conj() @ across.transpose(0, 2, 1))
    return CrossSpectra(
        tuple(signals), np.asarray(frequency[inside], dtype=np.float64), np.stack(groups)
    )


def _pieces(samples: FloatArray, factor: int, length: int) -> FloatArray:
    """Segments of the averaged samples, (segments, length)."""
    slower = samples[: len(samples) // factor * factor].reshape(-1, factor).mean(axis=1)
    return np.lib.stride_tricks.sliding_window_view(slower, length)[:: max(length // 2, 1)]


@dataclass(frozen=True)
class Measured:
    """A quantity with the half width of its 95 % interval."""

    value: float  # estimate, in the unit of the quantity
    half_width: float  # half width of the interval, in the same unit

    @property
    def low(self) -> float:
        """Lower end of the interval."""
        return self.value - self.half_width

    @property
    def high(self) -> float:
        """Upper end of the interval."""
        return self.value + self.half_width

    def widened(self, deviation: float) -> Measured:
        """The quantity with a systematic standard uncertainty added to its interval."""
        return Measured(self.value, math.hypot(self.half_width, student(math.inf) * deviation))


def jackknife(groups: NDArray[Any], fit: Callable[[NDArray[Any]], FloatArray]) -> list[Measured]:
    """Values of a fit to a sum of groups (G, ...), with intervals from leaving out one group after
    another (Student's).

    Parameters
    ----------
    groups : array
        (G, ...), of which the fit takes a sum.
    fit : callable
        Sum -> (P,).

    Returns
    -------
    list of Measured
        P values at the sum of all groups, with 95 % intervals of G - 1 degrees of freedom.
    """
    total = groups.sum(axis=0)
    number = len(groups)
    left_out = np.stack([fit(total - group) for group in groups])
    spread = np.sqrt(
        (number - 1) / number * np.square(left_out - left_out.mean(axis=0)).sum(axis=0)
    )
    factor = student(number - 1)
    return [
        Measured(value, factor * width)
        for value, width in zip(fit(total).tolist(), spread.tolist(), strict=True)
    ]


def student(freedom: float) -> float:
    """Half width of the 95 % interval of Student's distribution, in standard deviations.

    Parameters
    ----------
    freedom : float
        Degrees of freedom; infinite for the normal distribution.
    """
    return float(scipy.special.stdtrit(freedom, 0.5 + 0.5 * CONFIDENCE))


@dataclass(frozen=True)
class Lag:
    """Lag of one signal behind another: a delay and a first-order low-pass, of which either may be
    held at zero.
    """

    delay: Measured  # delay [s]
    time_constant: Measured  # time constant of the low-pass [s]
    together: Measured  # sum of both, which is the delay of slow motion [s]
    fit: float  # share of the phase that is explained


def lag_of(spectra: CrossSpectra, source: str, follower: str, *, low_pass: bool) -> Lag | None:
    """The lag of a signal behind another, from the phase of their cross-spectrum, -ωτ - atan(ωT).

    The phase alone is fitted: noise in either signal changes the ratio of their amplitudes, and not
    the mean phase. Each bin has the weight of maximum likelihood, coherence² / (1 - coherence²)
    (Hannan & Thomson, Biometrika 60 (3), 1973).

    Parameters
    ----------
    spectra : CrossSpectra
        Of both signals, as `cross_spectra` makes them.
    source, follower : str
        Names of the signals.
    low_pass : bool
        Whether T is fitted, else 0.

    Returns
    -------
    Lag or None
        None where a signal is missing, or the coherence is too low.
    """
    if not {source, follower} <= set(spectra.names):
        return None
    x = spectra.names.index(source)
    y = spectra.names.index(follower)
    total = spectra.total
    across = smoothed(total[:, x, y].real) + 1j * smoothed(total[:, x, y].imag)
    power = smoothed(total[:, x, x].real) * smoothed(total[:, y, y].real)
    if not (power > 0.0).all() or not np.isfinite(power).all():
        return None
    coherence = np.minimum(np.square(np.abs(across)) / power, MAX_COHERENCE)
    coherence[power < MIN_POWER_SHARE**2 * power.max()] = 0.0
    if coherence.mean() < MIN_MEAN_COHERENCE:
        return None
    weight = coherence / (1.0 - coherence) / np.maximum(np.abs(across), np.finfo(float).tiny)
    omega = spectra.omega
    start = _coarse(weight * total[:, x, y], omega, low_pass=low_pass)

    def fitted(cross_spectra: ComplexArray) -> FloatArray:
        delay, time_constant = _refined(
            weight * cross_spectra[:, x, y], omega, start, low_pass=low_pass
        )
        return np.array([delay, time_constant, delay + time_constant])

    delay, time_constant, together = jackknife(spectra.groups, fitted)
    phase = omega * delay.value + np.arctan(omega * time_constant.value)
    explained = np.sum(weight * (total[:, x, y] * np.exp(1j * phase)).real) / np.sum(
        weight * np.abs(total[:, x, y])
    )
    return Lag(delay, time_constant, together, float(explained))


def smoothed(values: FloatArray) -> FloatArray:
    """Running mean over the bins, (F,)."""
    reach = SMOOTHED_BINS // 2
    return np.convolve(
        np.pad(values, reach, mode="edge"), np.full(SMOOTHED_BINS, 1.0 / SMOOTHED_BINS), "valid"
    )


def _coarse(cross: ComplexArray, omega: FloatArray, *, low_pass: bool) -> tuple[float, float]:
    """Delay and time constant [s] of the best point of a grid, by the real part of the weighted
    cross-spectrum once both are compensated for.
    """
    delays = np.linspace(-MAX_LAG_SECONDS, MAX_LAG_SECONDS, 97)
    constants = (
        np.concatenate([[0.0], np.geomspace(0.05, MAX_TIME_CONSTANT_SECONDS, 15)])
        if low_pass
        else np.zeros(1)
    )
    advance = np.exp(1j * np.multiply.outer(delays, omega)) * cross
    turn = np.exp(1j * np.arctan(np.multiply.outer(constants, omega)))
    score = advance.real @ turn.real.T - advance.imag @ turn.imag.T
    delay, constant = np.unravel_index(np.argmax(score), score.shape)
    return float(delays[delay]), float(constants[constant])


def _refined(
    cross: ComplexArray, omega: FloatArray, start: tuple[float, float], *, low_pass: bool
) -> tuple[float, float]:
    """Delay and time constant [s] by Gauss-Newton on the weighted phase; the time constant cannot
    be negative.

    Parameters
    ----------
    cross : ComplexArray
        Weighted cross-spectrum, (F,).
    omega : FloatArray
        Angular frequency [rad/s], (F,).
    start : tuple of float
        Delay and time constant [s].
    low_pass : bool
        Whether the time constant is free; it stays at its start otherwise.
    """
    delay, constant = start
    size = np.abs(cross)
    for _ in range(N_STEPS):
        turned = cross * np.exp(1j * (omega * delay + np.arctan(omega * constant)))
        by_delay = omega
        by_constant = omega / (1.0 + np.square(omega * constant))
        first = -(by_delay * turned.imag).sum()
        second = -(by_constant * turned.imag).sum()
        delay_weight = (size * by_delay**2).sum()
        joint_weight = (size * by_delay * by_constant).sum()
        constant_weight = (size * by_constant**2).sum()
        if delay_weight <= 0.0:
            break
        determinant = delay_weight * constant_weight * (1.0 + 1e-6) - joint_weight * joint_weight
        step = first / delay_weight
        change = 0.0
        if low_pass and determinant > 0.0:
            moved = (delay_weight * second - joint_weight * first) / determinant
            if constant > 0.0 or moved > 0.0:
                step = (constant_weight * first - joint_weight * second) / determinant
                change = moved
        step = min(max(step, -0.1), 0.1)
        change = min(max(change, -0.5), 0.5)
        delay = min(max(delay + step, -MAX_LAG_SECONDS), MAX_LAG_SECONDS)
        constant = min(max(constant + change, 0.0), MAX_TIME_CONSTANT_SECONDS)
        if abs(step) + abs(change) < 1e-7:
            break
    return float(delay), float(constant)
