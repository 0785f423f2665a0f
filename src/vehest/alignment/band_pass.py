"""A Butterworth band-pass without phase: the design and the recursion of scipy.signal, which takes
a second to import.
"""

from __future__ import annotations

import numba
import numpy as np

from vehest.constants import FloatArray

EXTENSION = 15  # number of samples that are added at both ends by odd reflection


def butterworth_band(low_hz: float, high_hz: float, rate_hz: float) -> FloatArray:
    """Sections of a band-pass of order 2 x 2, (2, 5): b₀, b₁, b₂, a₁, a₂ each, the lower poles
    last.

    Source: Oppenheim & Schafer, Discrete-Time Signal Processing, 2010, section 7.3 (bilinear
    transformation).

    Parameters
    ----------
    low_hz, high_hz : float
        Where the band ends, -3 dB in one pass [Hz].
    rate_hz : float
        Sampling rate, more than twice ``high_hz`` [Hz].
    """
    low, high = 4.0 * np.tan(np.pi * np.array([low_hz, high_hz]) / rate_hz)
    half = (
        -np.exp(0.25j * np.pi) * (high - low) / 2.0
    )  # one of the low-pass prototype's two poles, as wide as the band
    root = np.sqrt(half**2 - low * high)
    poles = (4.0 + half + [root, -root]) / (4.0 - half - [root, -root])
    gain = (high - low) ** 2 * 16.0 / np.prod(np.abs(4.0 - half - [root, -root]) ** 2)
    slow, fast = sorted(poles, key=lambda pole: abs(np.angle(pole)))
    rows = ((gain, 2.0, fast), (1.0, -2.0, slow))
    return np.array(
        [
            (scale, middle * scale, scale, -2.0 * pole.real, abs(pole) ** 2)
            for scale, middle, pole in rows
        ]
    )


def without_phase(sections: FloatArray, samples: FloatArray) -> FloatArray:
    """Samples (T,), T > 15, filtered forwards, then backwards, from a steady state each.

    Parameters
    ----------
    sections : FloatArray
        (S, 5), as `butterworth_band` returns them.
    samples : FloatArray
        Without gaps.

    Returns
    -------
    FloatArray
        (T,). Both passes together square the magnitude of the response and cancel its phase.
    """
    extended = np.pad(samples, EXTENSION, mode="reflect", reflect_type="odd")
    for _ in range(2):
        extended = _filtered(sections, extended)[::-1].copy()
    return extended[EXTENSION:-EXTENSION]


@numba.njit(cache=True, error_model="numpy")
def _filtered(sections, samples):  # type: ignore[no-untyped-def]
    """Samples through all sections one after another (transposed direct form II), from the steady
    state of the first sample.
    """
    state = np.empty((len(sections), 2))
    out = np.empty(len(samples))
    level = samples[0]
    for s, (b0, b1, b2, a1, a2) in enumerate(sections):
        settled = level * (b0 + b1 + b2) / (1.0 + a1 + a2)
        state[s, 0] = settled - b0 * level
        state[s, 1] = b2 * level - a2 * settled
        level = settled
    for k in range(len(samples)):
        value = samples[k]
        for s, (b0, b1, b2, a1, a2) in enumerate(sections):
            now = b0 * value + state[s, 0]
            state[s, 0] = b1 * value - a1 * now + state[s, 1]
            state[s, 1] = b2 * value - a2 * now
            value = now
        out[k] = value
    return out
