"""Second stage: recordings at their native rate to recordings at an estimator's rate."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vehest.artefacts.artefact import Artefact, StagePlan
from vehest.data.resampling import resampled, transforms_of
from vehest.data.store import read_recording, write_recording
from vehest.run.versions import code_of

STAGE = "downsample"  # name of the stage


def plan_downsample(
    ingested: Artefact, rate_hz: float, options: Mapping[str, Any], output: Path
) -> StagePlan:
    """Plan the artefact of a data set's recordings at another rate.

    Parameters
    ----------
    ingested : Artefact
        Recordings at their native rate.
    rate_hz : float
        Rate of an estimator, or of the evaluation [Hz].
    options : mapping
        ``method`` (``polyphase`` or ``decimate``) and ``transforms``.
    output : Path
        Output root.

    Returns
    -------
    StagePlan
        Its inputs are the digests of the recordings.

    Raises
    ------
    ConfigurationError
        A rate, method or transform that makes no sense.
    """
    config = {
        "rate_hz": float(rate_hz),
        "method": options["method"],
        "transforms": list(options.get("transforms") or []),
    }
    transforms_of(config)
    return StagePlan(
        STAGE,
        f"{ingested.label}-{rate_hz:g}hz",
        config,
        dict(ingested.outputs),
        code_of(STAGE),
        output,
    )


def write_downsample(ingested: Artefact, config: Mapping[str, Any], folder: Path) -> None:
    """Transform and resample every ingested recording into ``folder``, as the plan's ``config``
    says.

    Raises
    ------
    DataError
        A recording lacks a channel that a transform reads, or is too slow or too short.
    """
    for name in ingested.outputs:
        write_recording(
            resampled(read_recording(ingested.folder / name), config["rate_hz"], config),
            folder / name,
        )
