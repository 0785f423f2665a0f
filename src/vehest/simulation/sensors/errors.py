"""Errors of a sensor: delay, scale, offset, drift, noise and quantisation, each from a random
stream of its own.
"""

from __future__ import annotations

import math
import zlib

import numpy as np
from scipy import signal

from vehest.constants import FloatArray
from vehest.simulation.random_streams import SENSORS, random_stream
from vehest.simulation.sensors.levels import SensorLevel


def sensor_signal(
    true: FloatArray, level: SensorLevel, rate_hz: float, seed: int, name: str
) -> FloatArray:
    """Signal of a sensor, (T,): delay, gain, scale, bias, offset, drift, noise, quantisation.

    Parameters
    ----------
    true : array, shape (T,)
        The measured quantity, uniformly sampled.
    level : SensorLevel
        Size of each error, in the quantity's unit.
    rate_hz : float
        Sampling rate [Hz].
    seed : int
        Of the drive. Each error has a random stream, which the sensor's name and the kind of error
        select.
    name : str
        Of the sensor.

    Returns
    -------
    FloatArray
        (T,). An error of size zero draws nothing, which leaves the streams of the others unchanged.
    """
    value = delayed(true, level.delay * rate_hz)
    if level.gain:
        value = value * (1.0 + level.gain)
    if level.scale:
        value = value * (1.0 + level.scale * stream(seed, f"{name}.scale").standard_normal())
    if level.bias:
        value = value + level.bias
    if level.offset:
        value = value + level.offset * stream(seed, f"{name}.offset").standard_normal()
    if level.drift:
        value = value + level.drift * _gauss_markov(
            stream(seed, f"{name}.drift"), len(true), level.drift_time * rate_hz
        )
    if level.noise:
        value = value + level.noise * math.sqrt(rate_hz / 2.0) * stream(
            seed, f"{name}.noise"
        ).standard_normal(len(true))
    return (
        np.round(value / level.quantisation) * level.quantisation if level.quantisation else value
    )


def stream(seed: int, name: str) -> np.random.Generator:
    """The random stream of one error of one sensor in one drive, independent of other errors."""
    return random_stream(seed, SENSORS, zlib.crc32(name.encode()))


def delayed(samples: FloatArray, delay: float) -> FloatArray:
    """Samples (T,) delayed by ``delay`` sampling intervals, held before the first one.

    Between samples by the cubic through the four nearest (Lagrange): half way between two, a sine
    of a tenth of the sampling rate loses 0.4 % of its amplitude and nothing of its phase.

    Parameters
    ----------
    samples : FloatArray
        (T,), uniform.
    delay : float
        In samples, zero or positive; also a fraction.

    Returns
    -------
    FloatArray
        (T,); the very same array without a delay. The newest value is repeated where the cubic
        needs a sample after the last.
    """
    if delay == 0.0:
        return samples
    n_samples = len(samples)
    delay_samples = min(math.floor(delay), n_samples)
    u = 1.0 - (delay - math.floor(delay))  # of the way from the older to the younger neighbour
    padded = np.concatenate([np.full(delay_samples + 2, samples[0]), samples, samples[-1:]])
    oldest, older, younger, youngest = (padded[first : first + n_samples] for first in range(4))
    if u == 1.0:
        return younger.copy()
    return (
        -u * (u - 1.0) * (u - 2.0) / 6.0 * oldest
        + (u + 1.0) * (u - 1.0) * (u - 2.0) / 2.0 * older
        - (u + 1.0) * u * (u - 2.0) / 2.0 * younger
        + (u + 1.0) * u * (u - 1.0) / 6.0 * youngest
    )


def _gauss_markov(generator: np.random.Generator, n_samples: int, correlation: float) -> FloatArray:
    """Unit-variance first-order Gauss-Markov process of a correlation time in samples,
    (n_samples,).
    """
    keep = math.exp(-1.0 / correlation)
    step = math.sqrt(-math.expm1(-2.0 / correlation))
    driven = step * generator.standard_normal(n_samples)
    driven[:1] /= step
    process: FloatArray = signal.lfilter([1.0], [1.0, -keep], driven)
    return process
