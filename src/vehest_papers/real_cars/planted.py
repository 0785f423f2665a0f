"""Errors that are injected into a recording: which of them the checks detect, and whether a check
names an unchanged channel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pandas as pd
from scipy import signal

from vehest.alignment.checks import Finding, checks_of_recording
from vehest.constants import GRAVITY, FloatArray
from vehest.data.recording import Recording

DELAYS = (0.02, 0.04, 0.1)  # s
TIME_CONSTANT = 0.4  # s
SENSOR_RATE_HZ = 10.0  # Hz
REFERENCE = ("vy_ref", "sideslip_ref")
COUNTED_NOTES = frozenset({"offset", "held"})
Change = Callable[[FloatArray, float], FloatArray]


@dataclass(frozen=True)
class Fault:
    """An error of one or several channels."""

    name: str  # kind of error
    # that it changes; those that a recording does not have are left out, at least one must be there
    channels: tuple[str, ...]
    size: str  # with its unit
    checks: frozenset[str]  # names of checks of which one must detect it; empty where none can
    change: Change  # samples (T,) and sampling rate [Hz] to samples

    def __call__(self, recording: Recording) -> Recording:
        """The recording with the fault in it."""
        changed = {
            name: self.change(recording[name], recording.rate_hz)
            for name in self.channels
            if name in recording
        }
        return replace(recording, channels={**recording.channels, **changed})


def planted_faults() -> list[Fault]:
    """Delays, signs, units, offsets, held samples of a slow sensor, low-pass filters."""
    delayed = [("yaw_rate",), ("ay",), ("ax",), REFERENCE, ("steer",)]
    faults = [
        Fault(
            "late",
            channels,
            f"{1e3 * seconds:.0f} ms",
            frozenset() if channels == ("steer",) else frozenset({"delay"}),
            partial(_late, seconds),
        )
        for channels in delayed
        for seconds in DELAYS
    ]
    faults += [
        Fault("reversed", channels, "-1", frozenset({"sign"}), partial(_scaled, -1.0))
        for channels in [
            ("ay",),
            ("yaw_rate",),
            ("ax",),
            ("steer",),
            ("vy_ref",),
            ("sideslip_ref",),
            REFERENCE,
        ]
    ]
    units = [
        ("yaw_rate", "deg/s", 180.0 / np.pi),
        ("sideslip_ref", "deg", 180.0 / np.pi),
        ("vy_ref", "km/h", 3.6),
        ("vx", "km/h", 3.6),
        ("ay", "g", 1.0 / GRAVITY),
    ]
    checks_of_units = frozenset({"unit", "impossible"})
    faults += [
        Fault("in another unit", (name,), unit, checks_of_units, partial(_scaled, factor))
        for name, unit, factor in units
    ]
    offsets = [
        ("ay", "0.3 m/s²", 0.3),
        ("ay", "1 m/s²", 1.0),
        ("steer", "4 deg", float(np.radians(4.0))),
    ]
    faults += [
        Fault("offset", (name,), size, frozenset({"offset"}), partial(_shifted, offset))
        for name, size, offset in offsets
    ]
    faults += [
        Fault(
            "held",
            (name,),
            f"{SENSOR_RATE_HZ:g} Hz",
            frozenset({"held"}),
            partial(_repeated, SENSOR_RATE_HZ),
        )
        for name in ("yaw_rate", "ay")
    ]
    slow = partial(_low_passed, TIME_CONSTANT)
    faults += [
        Fault("low-passed", (name,), f"{TIME_CONSTANT:g} s", frozenset({"bandwidth"}), slow)
        for name in ("yaw_rate", "ax")
    ]
    return faults


def detections(recording: Recording) -> pd.DataFrame:
    """Which of `planted_faults` the checks detect; those whose channels are missing are left out.

    Findings on the unchanged recording do not count. An error is detected where one of its checks
    names one of its channels or, where the channels contradict each other without a decision, has
    it among the alternatives.

    Returns
    -------
    DataFrame
        A row an error: ``fault``, ``channel``, ``size``, ``detectable``, ``detected``,
        ``reported`` (channels that its checks name), ``message``, ``false_alarms`` (checks and
        unchanged channels, separated by "; ").
    """
    before = {(finding.level, finding.check, finding.channel) for finding in _counted(recording)}
    rows = []
    for fault in planted_faults():
        changed = [name for name in fault.channels if name in recording]
        if not changed:
            continue
        new = [
            finding
            for finding in _counted(fault(recording))
            if (finding.level, finding.check, finding.channel) not in before
        ]
        right = [
            finding for finding in new if finding.check in fault.checks and _names(finding, changed)
        ]
        wrong = [finding for finding in new if finding.channel and not _names(finding, changed)]
        rows.append(
            {
                "fault": fault.name,
                "channel": " and ".join(changed),
                "size": fault.size,
                "detectable": bool(fault.checks),
                "detected": bool(right),
                "reported": ", ".join(
                    dict.fromkeys(finding.channel or "undecided" for finding in right)
                ),
                "message": right[0].message if right else "",
                "false_alarms": "; ".join(
                    f"{finding.check}: {finding.channel}" for finding in wrong
                ),
            }
        )
    return pd.DataFrame(rows)


def _counted(recording: Recording) -> list[Finding]:
    return [
        finding
        for finding in checks_of_recording(recording)
        if finding.level != "note" or finding.check in COUNTED_NOTES
    ]


def _names(finding: Finding, channels: Sequence[str]) -> bool:
    """Whether a finding is about one of the channels.

    ``kinematics`` is about all those that it compares.
    """
    if finding.check == "kinematics":
        return bool({"ay", "yaw_rate", "vx", "vx_ref", "vy_ref"} & set(channels))
    return bool({finding.channel, *finding.suspects} & set(channels))


def _late(seconds: float, samples: FloatArray, rate_hz: float) -> FloatArray:
    places = np.arange(len(samples), dtype=np.float64)
    return np.interp(places - seconds * rate_hz, places, samples)


def _scaled(factor: float, samples: FloatArray, rate_hz: float) -> FloatArray:
    return factor * samples


def _shifted(offset: float, samples: FloatArray, rate_hz: float) -> FloatArray:
    return samples + offset


def _repeated(sensor_rate_hz: float, samples: FloatArray, rate_hz: float) -> FloatArray:
    step = max(round(rate_hz / sensor_rate_hz), 1)
    return np.repeat(samples[::step], step)[: len(samples)]


def _low_passed(time_constant: float, samples: FloatArray, rate_hz: float) -> FloatArray:
    keep = float(np.exp(-1.0 / (rate_hz * time_constant)))
    return np.asarray(
        signal.lfilter([1.0 - keep], [1.0, -keep], samples, zi=[keep * samples[0]])[0],
        dtype=np.float64,
    )
