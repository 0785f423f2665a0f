"""The clocks of ay, yaw rate and lateral velocity, fitted together."""

from __future__ import annotations

import math

import numpy as np
import scipy

from vehest.alignment.motion import Motion
from vehest.alignment.spectra import (
    MAX_LAG_SECONDS,
    MIN_AVERAGED_RATE_HZ,
    ComplexArray,
    CrossSpectra,
    Measured,
    cross_spectra,
    jackknife,
    smoothed,
)
from vehest.constants import FloatArray

# names of the signals that are fitted together
SIGNALS = ("ay", "turning", "sliding", "arm", "gaining")
# largest ratio of the gains of d(vy)/dt and vx·yaw_rate, or its inverse, with which a delay is
# estimated; noise alone shrinks it to 0.6 in sound drives
MAX_GAIN_RATIO = 2.5
# smallest share of what the other terms leave of ay that d(vy)/dt must explain
MIN_SLIDING_SHARE = 0.1
# largest number of times that channels are shifted by the fitted delays and fitted again
N_SHIFTS = 6
SHIFT_TOLERANCE_SECONDS = 1e-3  # s, remaining delays below which no more shifts follow
MIN_SAMPLES = 10  # smallest number of samples with which a delay is estimated
N_STEPS = 8  # largest number of Gauss-Newton steps of a fit
N_WEIGHTINGS = 3  # number of fits one after another, each weighted by the residual of the last one
MAX_STEP_SECONDS = 0.1  # s, largest change of a delay by one Gauss-Newton step
# smallest residual in a bin over the largest power of ay; limits the weights of bins
MIN_RESIDUAL_SHARE = 1e-6


def lateral_lateness(motion: Motion) -> tuple[Measured, Measured, Measured] | None:
    """Lateness of yaw rate and of lateral velocity against ay, and of the former against the latter
    [s].

        ay(t) = g·(vx·yaw_rate(t + τ₁) + d(vy)/dt(t + τ₂)) + x·d(yaw_rate)/dt(t + τ₁) +
        y·d(vx)/dt·yaw_rate(t + τ₁)

    Delays, the gain g that roll lets in, the lever arm x and the lateness y of vx are fitted
    together. At one speed a lever arm looks as a delay of the yaw rate does; varying speed tells
    them apart. One gain serves both accelerations, so that noise of the differentiated velocity
    shrinks neither. Bins have the weight that the residual leaves them. Channels are shifted and
    fitted again until next to nothing is left, since turning the phase of a segment does not shift
    its ends.

    Parameters
    ----------
    motion : Motion
        With ay, yaw rate, speed and lateral velocity; it is averaged down to about
        MIN_AVERAGED_RATE_HZ.

    Returns
    -------
    tuple of Measured, or None
        τ₁, τ₂ and their difference [s]; None where a channel is missing, the drive is too short, or
        d(vy)/dt does not explain ay without vx·yaw_rate.
    """
    if (
        not motion.velocity
        or not {"ay", "yaw_rate"} <= set(motion.channels)
        or len(motion) < MIN_SAMPLES
    ):
        return None
    slower = motion.slower(max(int(motion.rate_hz / MIN_AVERAGED_RATE_HZ), 1))
    turning = sliding = 0.0
    for _ in range(N_SHIFTS):
        shifted = _spectra(slower, turning, sliding)
        weighted = None if shifted is None else _weighted(shifted.total, shifted.omega)
        if shifted is None or weighted is None:
            return None
        spectra = shifted
        (start, weight) = weighted
        if (
            max(map(abs, start)) < SHIFT_TOLERANCE_SECONDS
            or max(abs(turning + start[0]), abs(sliding + start[1])) > MAX_LAG_SECONDS
        ):
            break
        turning = turning + start[0]
        sliding = sliding + start[1]

    def lateness(spectrum: ComplexArray) -> FloatArray:
        again = _fit(spectrum, spectra.omega, weight, start)
        first, second = again[0] if again is not None else (math.nan, math.nan)
        return np.array([turning + first, sliding + second, turning + first - sliding - second])

    first, second, difference = jackknife(spectra.groups, lateness)
    return first, second, difference


def _spectra(motion: Motion, turning: float, sliding: float) -> CrossSpectra | None:
    """Cross-spectra of the signals, after yaw rate and ay are shifted onto the clock of the lateral
    velocity by these delays [s].
    """
    clock = np.arange(len(motion)) / motion.rate_hz
    ay = motion["ay"]
    yaw_rate = motion["yaw_rate"]
    if turning or sliding:
        ay = scipy.interpolate.CubicSpline(clock, ay)(np.clip(clock - sliding, 0.0, clock[-1]))
        yaw_rate = scipy.interpolate.CubicSpline(clock, yaw_rate)(
            np.clip(clock + turning - sliding, 0.0, clock[-1])
        )
    signals = (
        ay,
        motion.vx * yaw_rate,
        motion.sliding,
        motion.derivative(yaw_rate),
        motion.derivative(motion.vx) * yaw_rate,
    )
    if not all(0.0 < np.ptp(samples) < np.inf for samples in signals):
        return None
    return cross_spectra(dict(zip(SIGNALS, signals, strict=True)), motion.rate_hz, motion.moving)


def _weighted(
    spectrum: ComplexArray, omega: FloatArray
) -> tuple[tuple[float, float], FloatArray] | None:
    """Both delays [s], and the weights of the bins by the residual, (F,)."""
    floor = MIN_RESIDUAL_SHARE * float(spectrum[:, 0, 0].real.max())
    weight = np.ones(len(omega)) / max(floor, np.finfo(float).tiny)
    start = (0.0, 0.0)
    explained = 0.0
    for _ in range(N_WEIGHTINGS):
        fitted = _fit(spectrum, omega, weight, start)
        if fitted is None:
            return None
        start, residual, explained = fitted
        weight = 1.0 / np.maximum(smoothed(residual), max(floor, np.finfo(float).tiny))
    if (
        explained < MIN_SLIDING_SHARE
        or not 1.0 / MAX_GAIN_RATIO < _sliding_gain(spectrum, omega, weight, start) < MAX_GAIN_RATIO
    ):
        return None
    return start, weight


def _fit(
    spectrum: ComplexArray, omega: FloatArray, weight: FloatArray, start: tuple[float, float]
) -> tuple[tuple[float, float], FloatArray, float] | None:
    """Both delays [s] by Gauss-Newton, the power of the residual (F,), and the share of it that
    d(vy)/dt took away.
    """
    turning, sliding = start
    for _ in range(N_STEPS):
        p = np.exp(1j * omega * turning)
        d = np.exp(1j * omega * sliding)
        columns = np.zeros(
            (len(omega), 5, 5), dtype=np.complex128
        )  # (F, signals, parameters): g, g·τ₁, g·τ₂, x, y
        columns[:, 1, 0] = p
        columns[:, 2, 0] = d
        columns[:, 3, 3] = p
        columns[:, 4, 4] = p
        columns[:, 1, 1] = 1j * omega * p
        columns[:, 2, 2] = 1j * omega * d
        left = columns.conj().transpose(0, 2, 1)
        normal = np.einsum("fpq,f->pq", (left @ spectrum @ columns).real, weight)
        right = np.einsum("fp,f->p", (left @ spectrum[:, :, :1])[:, :, 0].real, weight)
        scale = np.sqrt(np.diag(normal))
        if not (np.isfinite(scale).all() and (scale > 0.0).all()):
            return None
        try:
            values = (
                np.linalg.solve(normal / scale / scale[:, None] + 1e-9 * np.eye(5), right / scale)
                / scale
            )
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(values).all() or values[0] == 0.0:
            return None
        turning += float(np.clip(values[1] / values[0], -MAX_STEP_SECONDS, MAX_STEP_SECONDS))
        sliding += float(np.clip(values[2] / values[0], -MAX_STEP_SECONDS, MAX_STEP_SECONDS))
        turning, sliding = (
            min(max(delay, -MAX_LAG_SECONDS), MAX_LAG_SECONDS) for delay in (turning, sliding)
        )
        if np.abs(values[1:3]).max() < 1e-6 * abs(values[0]):
            break
    mix = -np.einsum("fsp,p->fs", columns, values)
    mix[:, 0] += 1.0
    residual = np.einsum("fs,fst,ft->f", mix.conj(), spectrum, mix).real
    mix[:, 2] = 0.0
    before = float(weight @ np.einsum("fs,fst,ft->f", mix.conj(), spectrum, mix).real)
    return (
        (turning, sliding),
        residual,
        1.0 - float(weight @ residual) / before if before > 0.0 else 0.0,
    )


def _sliding_gain(
    spectrum: ComplexArray, omega: FloatArray, weight: FloatArray, delays: tuple[float, float]
) -> float:
    """The gain that d(vy)/dt would have, were it fitted apart from that of vx·yaw_rate."""
    advance = np.exp(
        1j * np.multiply.outer(omega, [0.0, delays[0], delays[1], delays[0], delays[0]])
    )
    products = np.einsum("fst,fs,ft,f->st", spectrum, advance.conj(), advance, weight).real
    gains = np.linalg.lstsq(products[1:, 1:], products[1:, 0], rcond=None)[0]
    return float(gains[1] / gains[0]) if gains[0] != 0.0 else 0.0
