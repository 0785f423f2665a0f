"""Which channels of a recording are late, as its checks find it."""

from __future__ import annotations

import re
from dataclasses import dataclass

from vehest.alignment.bandwidth import low_passed
from vehest.alignment.delays import delay_findings, delays_of, spectra_of
from vehest.alignment.motion import motion_of
from vehest.data.recording import Recording

_REMEDY = re.compile(r"delay: (?P<delay>[\d.]+), channels: \[(?P<channels>[^\]]*)\]")


@dataclass(frozen=True)
class Late:
    """A channel that is late.

    Args:
        delay: by how much [s].
        evidence: for people.
    """

    delay: float
    evidence: str


def late_channels(recording: Recording) -> dict[str, Late]:
    """Channel -> by how much it is late; the transform that a finding proposes says it, so that both always agree."""
    motion = motion_of(recording)
    spectra = spectra_of(motion)
    if spectra is None:
        return {}
    found: dict[str, Late] = {}
    for finding in delay_findings(delays_of(motion, spectra, frozenset(low_passed(motion, spectra)))):
        told = _REMEDY.search(finding.message)
        if told is not None:
            text = finding.message.split("; {name:")[0]
            found |= {name.strip(): Late(float(told["delay"]), text) for name in told["channels"].split(",")}
    return found
