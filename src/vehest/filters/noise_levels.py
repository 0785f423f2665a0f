"""How noisy a measured signal is, read off the signal itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from vehest.constants import FloatArray

STOP_BAND_DB = 60.0


def high_passed_level(series: Sequence[FloatArray], cutoff: float) -> float:
    """Standard deviation of what several recordings of one signal hold above a frequency, taken together.

    A linear-phase FIR filter (Kaiser window) passes from 1.25 times the cut-off on and is 60 dB down below 0.75 times of it. Only
    samples count where the filter sees measured samples alone: none at the ends, none around gaps (NaN).

    Args:
        series: one array a recording, (T,), all sampled at one rate.
        cutoff: as a fraction of the Nyquist frequency, between 0 and 0.8.

    Raises:
        ValueError: no recording is long enough.

    Source: Leanza, Reina & Blanco-Claraco 2021 take noise levels this way, with a cut-off of 0.2 (stop band to 0.15, pass band from 0.25).
    """
    count, shape = scipy.signal.kaiserord(STOP_BAND_DB, 0.5 * cutoff)
    taps = scipy.signal.firwin(count | 1, cutoff, window=("kaiser", shape), pass_zero=False)
    passed = [
        np.convolve(samples, taps, "valid") for samples in series if len(samples) >= len(taps)
    ]
    known = (
        np.concatenate([values[~np.isnan(values)] for values in passed]) if passed else np.empty(0)
    )
    if not len(known):
        raise ValueError(f"{len(taps)} samples without a gap are needed to read a noise level")
    return float(np.std(known))


def quiet_level(
    series: Sequence[FloatArray], activity: Sequence[FloatArray], least: int, share: float = 0.1
) -> float:
    """Standard deviation of several recordings of one signal while little else happens, taken together.

    Recordings are cut into pieces; those count in which another signal deviates least from a straight line, and in them what the signal
    itself deviates from one.

    Args:
        series: one array a recording, (T,).
        activity: the other signal, one array a recording, (T,).
        least: samples of a piece, three or more.
        share: of the pieces that count.

    Raises:
        ValueError: no piece is without a gap.

    Source: Bertipaglia et al. 2024, Section III-B, read levels where the steering angle is zero and the speed constant.
    """

    def pieces(samples: FloatArray) -> FloatArray:
        return samples[: len(samples) - len(samples) % least].reshape(-1, least)

    own, others = (
        np.concatenate([pieces(samples) for samples in signals]) for signals in (series, activity)
    )
    known = ~(np.isnan(own).any(1) | np.isnan(others).any(1))
    if not known.any():
        raise ValueError(f"no stretch of {least} samples without a gap")
    left, moved = (
        np.square(scipy.signal.detrend(values[known], axis=1)).sum(1) / (least - 2)
        for values in (own, others)
    )
    quietest = np.argsort(moved, kind="stable")[: max(1, round(share * len(moved)))]
    return float(np.sqrt(left[quietest].mean()))
