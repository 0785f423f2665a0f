"""How noisy a measured signal is, read off the signal itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from vehest.filters.gaussian import FloatArray

STOP_BAND_DB = 60.0


def high_passed_level(series: Sequence[FloatArray], cutoff: float) -> float:
    """Standard deviation of what several recordings of one signal hold above a frequency, taken together.

    A linear-phase FIR filter (Kaiser window) passes from 1.25 times the cut-off on and is 60 dB down below 0.75 times of it. Only
    samples count where the filter sees measured samples alone: none at the ends, none around gaps (NaN).

    Args:
        series: one array a recording, (T,), all sampled at one rate.
        cutoff: as a fraction of the Nyquist frequency, between 0 and 0.8.

    Raises:
        ValueError: the cut-off is out of range, or no recording is long enough.

    Source: Leanza, Reina & Blanco-Claraco 2021 take noise levels this way, with a cut-off of 0.2 (stop band to 0.15, pass band from 0.25).
    """
    if not 0.0 < cutoff < 0.8:
        raise ValueError(f"the cut-off must lie between 0 and 0.8 of the Nyquist frequency, not at {cutoff}")
    count, shape = signal.kaiserord(STOP_BAND_DB, 0.5 * cutoff)
    taps = signal.firwin(count | 1, cutoff, window=("kaiser", shape), pass_zero=False)
    passed = [np.convolve(samples, taps, "valid") for samples in series if len(samples) >= len(taps)]
    known = np.concatenate([values[~np.isnan(values)] for values in passed]) if passed else np.empty(0)
    if not len(known):
        raise ValueError(f"{len(taps)} samples without a gap are needed to read a noise level")
    return float(np.std(known))


def quiet_level(series: Sequence[FloatArray], quiet: Sequence[NDArray[np.bool_]], least: int) -> float:
    """Standard deviation of what several recordings of one signal hold while nothing happens, taken together.

    Each stretch in which nothing happens is cut into pieces, and deviations are those from the piece's own mean, so that neither offsets
    nor slow changes count.

    Args:
        series: one array a recording, (T,).
        quiet: where nothing happens, one array a recording, (T,).
        least: samples of a piece; what is left over is not looked at.

    Raises:
        ValueError: there is no such piece without a gap.

    Source: Bertipaglia et al. 2024, Section III-B, take noise levels from driving straight ahead at constant speed.
    """
    if least < 2:
        raise ValueError(f"a piece must hold at least 2 samples, not {least}")
    squares, count = 0.0, 0
    for samples, still in zip(series, quiet, strict=True):
        usable = still & ~np.isnan(samples)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], usable.astype(np.int8), [0]])))
        for start, end in zip(edges[::2], edges[1::2], strict=True):
            pieces = samples[start : end - (end - start) % least].reshape(-1, least)
            squares += float(np.square(pieces - pieces.mean(1, keepdims=True)).sum())
            count += len(pieces) * (least - 1)
    if not count:
        raise ValueError(f"no stretch of {least} samples without a gap in which nothing happens")
    return float(np.sqrt(squares / count))
