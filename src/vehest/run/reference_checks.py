"""Findings about references, which estimators are trained on and scored against: a wrong one makes
every score wrong.
"""

from __future__ import annotations

from collections.abc import Iterator

from vehest.alignment.checks import checks_of_recording
from vehest.alignment.findings import Finding
from vehest.data.channels import REFERENCE_SUFFIX
from vehest.data.recording import Recording

CHECKS_OF_SIGNS_AND_UNITS = ("impossible", "sign", "unit", "stuck")
"""Checks of how a channel was written, whose findings on references are warned of.

Departures of a reference from the kinematics are left to `vehest data check`.
"""


def reference_findings(recording: Recording) -> Iterator[Finding]:
    """Findings that a reference of a recording has another sign or unit, is stuck or impossible,
    accepted errors included.

    Parameters
    ----------
    recording : Recording
        Without a reference there is nothing to check.
    """
    if any(name.endswith(REFERENCE_SUFFIX) for name in recording.channels):
        for finding in checks_of_recording(recording):
            concerned = (finding.channel, *finding.suspects)
            if (
                finding.level != "note"
                and finding.check in CHECKS_OF_SIGNS_AND_UNITS
                and any(name.endswith(REFERENCE_SUFFIX) for name in concerned)
            ):
                yield finding
