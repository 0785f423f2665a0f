"""Sensor noise read off a real recording: the way the levels of ``race`` were found.

What shakes the body above 10 Hz is counted as noise: engine, road and sensors cannot be
distinguished in a recording. Read the Ferrari recording again with::

    from vehest_papers.proving_ground.noise_reading import read_off
    print(read_off(recording.channels, recording.rate_hz))
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import signal

from vehest.constants import GRAVITY, FloatArray

NOISE_ABOVE = 10.0  # a car's body hardly moves on purpose above this frequency [Hz]
SLOW_BELOW = 0.5  # what is left of a kinematic residual below this frequency is drift [Hz]
DELAY_BAND = (
    0.2,
    2.0,
)  # where the motion is strong and quick, for comparing the times of channels [Hz]
WELCH_SECONDS = 20.0


@dataclass(frozen=True)
class SlowError:
    """What a kinematic residual is made of below ``SLOW_BELOW``."""

    mean: float  # of the whole residual
    slopes: tuple[float, ...]  # of the residual over each explaining signal, by least squares
    std: float  # of what the explaining signals and white noise leave
    time: float  # after which the autocorrelation of that has fallen to 1/e [s]


def read_off(channels: Mapping[str, FloatArray], rate_hz: float) -> dict[str, float]:
    """Levels by their name, such as ``ay.noise``; units as in SensorLevel.

    The reference's velocities are taken to be true and on time. Then d(vx)/dt - vy·r - ax and
    d(vy)/dt + vx·r - ay are errors of ax and ay, the delay of r aside. Their slopes over ax and ay
    are the gravity that pitch and roll let in; divided by g they are given as ``pitch_gradient``
    and ``roll_gradient`` [rad s²/m].

    Parameters
    ----------
    channels
        Vx, yaw_rate, ax, ay, steer, vx_ref and vy_ref, each (T,), in SI units, of some minutes
        without a stop. rate_hz: sampling rate [Hz].
    """
    vx, vy, yaw_rate, ax, ay = (
        channels[name] for name in ("vx_ref", "vy_ref", "yaw_rate", "ax", "ay")
    )
    change = {
        name: np.gradient(values) * rate_hz
        for name, values in (("vx", vx), ("vy", vy), ("r", yaw_rate), ("ax", ax), ("ay", ay))
    }
    levels = {
        f"{name}.noise": noise_density(channels[name], rate_hz)
        for name in ("vx", "yaw_rate", "ax", "ay", "steer")
    }
    levels |= {
        f"reference.{name}.noise": noise_density(channels[f"{name}_ref"], rate_hz)
        for name in ("vx", "vy")
    }
    levels["steer.quantisation"] = quantum(channels["steer"])

    longitudinal = change["vx"] - vy * yaw_rate
    lateral = change["vy"] + vx * yaw_rate
    scale, lag = lags(longitudinal, [ax, change["ax"]], rate_hz)
    levels["ax.delay"] = lag / scale
    scale, lag, levels["yaw_rate.delay"] = lags(
        lateral, [ay, change["ay"], -vx * change["r"]], rate_hz
    )
    levels["ay.delay"] = lag / scale

    slow = slow_error(longitudinal - ax, [ax, ay, change["ax"]], levels["ax.noise"], rate_hz)
    levels |= {"ax.offset": abs(slow.mean), "ax.drift": slow.std, "ax.drift_time": slow.time}
    levels["pitch_gradient"] = abs(slow.slopes[0]) / GRAVITY
    slow = slow_error(
        lateral - ay, [ay, ax, change["ay"], vx * change["r"]], levels["ay.noise"], rate_hz
    )
    levels |= {"ay.offset": abs(slow.mean), "ay.drift": slow.std, "ay.drift_time": slow.time}
    levels["roll_gradient"] = abs(slow.slopes[0]) / GRAVITY
    return levels


def noise_density(samples: FloatArray, rate_hz: float) -> float:
    """Noise density [unit/√Hz] of samples (T,) between `NOISE_ABOVE` and the Nyquist frequency.

    Medians over time and over frequency: neither a jolt nor a resonance of the body counts for
    much.
    """
    frequency, power = signal.welch(
        samples, rate_hz, nperseg=round(WELCH_SECONDS * rate_hz), average="median"
    )
    return float(
        np.sqrt(np.median(power[(frequency >= NOISE_ABOVE) & (frequency < rate_hz / 2.0)]))
    )


def quantum(samples: FloatArray) -> float:
    """The step that samples (T,) change by in ones, twos and threes; zero where they change by
    anything.
    """
    steps = np.abs(np.diff(samples))
    if not steps.any():
        return 0.0
    smallest = float(np.percentile(steps[steps > 0.0], 10))
    multiples = steps[steps < 3.5 * smallest] / smallest
    return smallest if np.percentile(np.abs(multiples - np.round(multiples)), 95) < 0.15 else 0.0


def slow_error(
    residual: FloatArray, explaining: list[FloatArray], noise: float, rate_hz: float
) -> SlowError:
    """Split a residual (T,) below ``SLOW_BELOW`` into its mean, what other signals (T,) explain,
    white noise of a density, and the rest.
    """
    low_pass = signal.butter(2, SLOW_BELOW, fs=rate_hz, output="sos")
    slow, *signals = (signal.sosfiltfilt(low_pass, values) for values in (residual, *explaining))
    regressors = np.stack([np.ones_like(slow), *signals], axis=1)
    coefficients = np.linalg.lstsq(regressors, slow, rcond=None)[0]
    remainder = slow - regressors @ coefficients
    frequency = np.fft.rfftfreq(2 * len(remainder), 1.0 / rate_hz)
    power = np.abs(np.fft.rfft(remainder, 2 * len(remainder))) ** 2 / len(remainder)
    _, response = signal.sosfreqz(low_pass, frequency, fs=rate_hz)
    covariance = np.fft.irfft(power - noise**2 * rate_hz / 2.0 * np.abs(response) ** 4)[
        : len(remainder)
    ]
    variance = max(float(covariance[0]), 0.0)
    fallen = np.flatnonzero(covariance < variance / np.e)
    time = float(fallen[0]) / rate_hz if len(fallen) else np.inf
    return SlowError(
        float(residual.mean()), tuple(coefficients[1:].tolist()), float(np.sqrt(variance)), time
    )


def lags(target: FloatArray, regressors: list[FloatArray], rate_hz: float) -> tuple[float, ...]:
    """Coefficients of a target (T,) over regressors (T,) within ``DELAY_BAND``.

    A signal that is late by d is, to first order, the true one less d times its derivative: the
    coefficient of the derivative is d.
    """
    band = signal.butter(2, DELAY_BAND, btype="bandpass", fs=rate_hz, output="sos")
    inside = slice(round(5.0 * rate_hz), -round(5.0 * rate_hz))
    filtered_target, *parts = (
        signal.sosfiltfilt(band, values)[inside] for values in (target, *regressors)
    )
    return tuple(np.linalg.lstsq(np.stack(parts, axis=1), filtered_target, rcond=None)[0].tolist())
