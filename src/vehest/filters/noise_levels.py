"""How noisy a measured signal is, read off the signal itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from vehest.constants import FloatArray

STOP_BAND_DB = 60.0  # attenuation of the high-pass in its stop band


def high_passed_level(series: Sequence[FloatArray], cutoff: float) -> float:
    """Standard deviation of one signal above a frequency, over several recordings together, in the
    signal's unit; as a level of its noise.

    A linear-phase FIR filter (Kaiser window) passes from 1.25 times the cut-off on and is 60 dB
    down below 0.75 times of it. Only samples count where the filter reads measured samples alone:
    none at the ends, none around gaps (NaN).

    Parameters
    ----------
    series : Sequence[FloatArray]
        One array a recording, (T,), all sampled at one rate.
    cutoff : float
        As a fraction of the Nyquist frequency, between 0 and 0.8.

    Raises
    ------
    ValueError
        No recording is long enough.

    Source: Leanza, Reina & Blanco-Claraco 2021 take noise levels this way, with a cut-off of 0.2
    (stop band to 0.15, pass band from 0.25).
    """
    count, shape = scipy.signal.kaiserord(STOP_BAND_DB, 0.5 * cutoff)
    taps = scipy.signal.firwin(count | 1, cutoff, window=("kaiser", shape), pass_zero=False)
    passed = [
        np.convolve(samples, taps, "valid") for samples in series if len(samples) >= len(taps)
    ]
    gap_free_samples = (
        np.concatenate([values[~np.isnan(values)] for values in passed]) if passed else np.empty(0)
    )
    if not len(gap_free_samples):
        raise ValueError(f"{len(taps)} samples without a gap are needed to read a noise level")
    return float(np.std(gap_free_samples))


def quiet_level(
    series: Sequence[FloatArray],
    activity: Sequence[FloatArray],
    piece_samples: int,
    share: float = 0.1,
) -> float:
    """Standard deviation of one signal over several recordings while another signal is quiet.

    Recordings are cut into segments. Those in which the other signal deviates least from a straight
    line count; the level is the deviation of the signal from a straight line in them.

    Parameters
    ----------
    series : Sequence[FloatArray]
        One array a recording, (T,).
    activity : Sequence[FloatArray]
        The other signal, one array a recording, (T,).
    piece_samples : int
        Samples of a segment, three or more.
    share : float, default 0.1
        Fraction of the segments that count.

    Raises
    ------
    ValueError
        No segment is without a gap.

    Source: Bertipaglia et al. 2024, Section III-B, read levels where the steering angle is zero and
    the speed constant.
    """

    def cut_into_pieces(samples: FloatArray) -> FloatArray:
        return samples[: len(samples) - len(samples) % piece_samples].reshape(-1, piece_samples)

    signal_pieces, activity_pieces = (
        np.concatenate([cut_into_pieces(samples) for samples in signals])
        for signals in (series, activity)
    )
    is_gap_free = ~(np.isnan(signal_pieces).any(1) | np.isnan(activity_pieces).any(1))
    if not is_gap_free.any():
        raise ValueError(f"no segment of {piece_samples} samples without a gap")
    signal_variance, activity_variance = (
        np.square(scipy.signal.detrend(values[is_gap_free], axis=1)).sum(1) / (piece_samples - 2)
        for values in (signal_pieces, activity_pieces)
    )
    quietest = np.argsort(activity_variance, kind="stable")[
        : max(1, round(share * len(activity_variance)))
    ]
    return float(np.sqrt(signal_variance[quietest].mean()))
