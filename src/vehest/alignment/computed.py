"""Accelerations that a logger computed of speed and yaw rate, without an accelerometer.

A measured ax contains -vy·yaw_rate and gravity by pitch, a measured ay d(vy)/dt and gravity by
roll. One that was computed contains neither, and says that the car does not slip. The two are told
apart by their coherence with d(vx)/dt, or vx·yaw_rate, which hardly any delay or low-pass of
the logger changes, and by the gain.
"""

from __future__ import annotations

import numpy as np

from vehest.alignment.delays import spectra_of
from vehest.alignment.findings import Finding
from vehest.alignment.motion import Motion, motion_of
from vehest.alignment.spectra import CrossSpectra
from vehest.alignment.standstill import standstill
from vehest.data.recording import Recording

MAX_FREQUENCY_HZ = 0.5  # Hz, up to which the spectra are compared; below a logger's low-pass
MIN_COMPARED_BINS = 3  # smallest number of frequencies up to there, which 64 s of driving have
# largest share of the power of a computed acceleration that its source does not explain; measured
# ones have 0.00035 to 0.3 on recordings of real and simulated cars
MAX_UNEXPLAINED = 2e-4
MAX_GAIN_ERROR = 0.003  # largest distance of the gain of a computed acceleration from 1
MIN_SLIP_SHARE = 3.0 * MAX_UNEXPLAINED
"""Smallest share of the power of ax that -vy·yaw_rate has in a drive that can tell, with vy as
large as at a point 1 m from one that does not slip.
"""
SOURCES = {
    "ax": {"d(vx)": "d(vx)/dt", "d(vx_ref)": "d(vx_ref)/dt"},
    "ay": {"turning": "vx·yaw_rate"},
}
"""Acceleration -> signals of `vehest.alignment.delays.signals_to_compare` of which it may be
computed -> text.
"""


def computed_channels(motion: Motion, spectra: CrossSpectra) -> dict[str, str]:
    """Accelerations that a logger computed, and of what.

    Parameters
    ----------
    motion : Motion
        Channels without gaps.
    spectra : CrossSpectra
        Of `vehest.alignment.delays.signals_to_compare`.

    Returns
    -------
    dict
        ``ax``, ``ay`` or neither -> text on its source. Empty where the car hardly turns, so that a
        measured acceleration would hardly differ.
    """
    if "yaw_rate" not in motion or "ax" not in motion:
        return {}
    turning = np.square(motion["yaw_rate"][motion.moving])  # of a point 1 m away [m/s²]
    ax = motion["ax"][motion.moving]
    if np.mean(np.square(turning)) < MIN_SLIP_SHARE * np.var(ax):
        return {}
    return {
        channel: text
        for channel, sources in SOURCES.items()
        for source, text in sources.items()
        if _is_computed(spectra, source, channel)
    }


def computed_in(recording: Recording) -> dict[str, str]:
    """`computed_channels` of a recording; empty for one that is too short."""
    motion = motion_of(recording, ~standstill(recording))
    spectra = spectra_of(motion)
    return {} if spectra is None else computed_channels(motion, spectra)


def _is_computed(spectra: CrossSpectra, source: str, channel: str) -> bool:
    """Whether a channel is a filtered copy of a signal, up to MAX_FREQUENCY_HZ."""
    if not {source, channel} <= set(spectra.names):
        return False
    inside = spectra.frequency <= MAX_FREQUENCY_HZ
    if np.count_nonzero(inside) < MIN_COMPARED_BINS:
        return False
    x = spectra.names.index(source)
    y = spectra.names.index(channel)
    total = spectra.total[inside]
    across = np.abs(total[:, x, y])
    power_of_source = total[:, x, x].real.sum()
    unexplained = 1.0 - np.square(across).sum() / np.sum(total[:, x, x].real * total[:, y, y].real)
    gain = across.sum() / power_of_source
    return bool(unexplained < MAX_UNEXPLAINED and abs(gain - 1.0) < MAX_GAIN_ERROR)


def computed_findings(motion: Motion, spectra: CrossSpectra) -> list[Finding]:
    """Warnings of `computed_channels`."""
    remedies = {
        "ax": "leave the column out, as vehest new does: without ax an estimate is better",
        "ay": "declare the column of an accelerometer",
    }
    return [
        Finding(
            "warning",
            "computed",
            channel,
            f"is {source}, computed by the logger and not measured: it says that the car does not "
            f"slip; {remedies[channel]}",
        )
        for channel, source in computed_channels(motion, spectra).items()
    ]
