"""Noise of a real recording beside a simulated one's: spectra of the channels and levels that are read from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import signal

from vehest.constants import FloatArray
from vehest.data.recording import Recording
from vehest_papers.proving_ground.noise_reading import NOISE_ABOVE, WELCH_SECONDS, read_off

SHOWN = {
    "vx": "vx [m/s/√Hz]",
    "yaw_rate": "yaw rate [rad/s/√Hz]",
    "steer": "steer [rad/√Hz]",
    "ax": "ax [m/s²/√Hz]",
    "ay": "ay [m/s²/√Hz]",
    "vy_ref": "vy, reference [m/s/√Hz]",
}
LOWEST_HZ = 0.1
BIN_WIDTH = 0.03  # of the decimal logarithm of the frequency

LEVELS = {
    "vx.noise": ("noise of vx", "m/s/√Hz"),
    "yaw_rate.noise": ("noise of the yaw rate", "rad/s/√Hz"),
    "ax.noise": ("noise of ax", "m/s²/√Hz"),
    "ay.noise": ("noise of ay", "m/s²/√Hz"),
    "steer.noise": ("noise of the steering angle", "rad/√Hz"),
    "reference.vx.noise": ("noise of the reference's vx", "m/s/√Hz"),
    "reference.vy.noise": ("noise of the reference's vy", "m/s/√Hz"),
    "ax.offset": ("offset of ax", "m/s²"),
    "ay.offset": ("offset of ay", "m/s²"),
    "ax.drift": ("drift of ax", "m/s²"),
    "ay.drift": ("drift of ay", "m/s²"),
    "roll_gradient": ("roll that leaks gravity into ay", "rad/(m/s²)"),
    "pitch_gradient": ("pitch that leaks gravity into ax", "rad/(m/s²)"),
}


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Amplitude density of a channel."""

    kind: str  # ``real`` or ``simulated``
    frequency: FloatArray  # (F,) [Hz]
    density: FloatArray  # (F,) [unit/√Hz]


def spectra(samples: Mapping[str, Recording]) -> dict[str, list[Spectrum]]:
    """Channel with unit -> amplitude densities by Welch's method (medians over windows of 20 s).

    Above ten times `LOWEST_HZ` medians over narrow bands of frequency are shown, so that small figures stay readable.

    Args:
        samples: ``simulated`` and ``real`` -> a recording.
    """
    return {
        title: [_spectrum(kind, own, name) for kind, own in samples.items()]
        for name, title in SHOWN.items()
    }


def levels(samples: Mapping[str, Recording]) -> pd.DataFrame:
    """One row a level: ``quantity``, ``unit`` and a column a kind of recording."""
    read = {
        kind: read_off(recording.channels, recording.rate_hz) for kind, recording in samples.items()
    }
    rows = [
        {"quantity": title, "unit": unit, **{kind: own[name] for kind, own in read.items()}}
        for name, (title, unit) in LEVELS.items()
    ]
    return pd.DataFrame(rows)


def same_length(samples: Mapping[str, Recording]) -> dict[str, Recording]:
    """The recordings, of the longer ones the beginning only."""
    seconds = min(recording.duration for recording in samples.values())
    return {
        kind: own.cut(own.start_time, own.start_time + seconds) for kind, own in samples.items()
    }


def comparable(samples: Mapping[str, Recording]) -> bool:
    """Whether there are two with all channels, at one rate, long enough for spectra up to beyond `NOISE_ABOVE`."""
    complete = all({*SHOWN, "vx_ref"} <= set(own.channels) for own in samples.values())
    rates = {recording.rate_hz for recording in samples.values()}
    enough = all(
        own.duration >= 2 * WELCH_SECONDS and own.rate_hz > 3 * NOISE_ABOVE
        for own in samples.values()
    )
    return complete and len(samples) == 2 and len(rates) == 1 and enough


def _spectrum(kind: str, recording: Recording, name: str) -> Spectrum:
    frequency, power = signal.welch(
        recording[name],
        recording.rate_hz,
        nperseg=round(WELCH_SECONDS * recording.rate_hz),
        average="median",
    )
    edges = np.concatenate(
        [
            np.arange(LOWEST_HZ, 10 * LOWEST_HZ, 1.0 / WELCH_SECONDS) - 0.5 / WELCH_SECONDS,
            10
            ** np.arange(np.log10(10 * LOWEST_HZ), np.log10(0.48 * recording.rate_hz), BIN_WIDTH),
        ]
    )
    band = np.digitize(frequency, edges)
    shown = [number for number in range(1, len(edges)) if (band == number).any()]
    middle, density = (
        np.array([np.median(values[band == number]) for number in shown])
        for values in (frequency, np.sqrt(power))
    )
    return Spectrum(kind, middle, density)
