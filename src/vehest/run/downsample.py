"""Second stage: recordings at their native rate to recordings at an estimator's rate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vehest.data.errors import DataError
from vehest.data.store import read_recording, write_recording
from vehest.data.transforms import Resample, Transform, transform_from_config
from vehest.run.artefacts import Artefact, StagePlan

STAGE = "downsample"
VERSION = "1"


def plan_downsample(ingested: Artefact, rate_hz: float, options: Mapping[str, Any], output: Path) -> StagePlan:
    """What a downsampling would make.

    Args:
        ingested: what the ingest stage made.
        rate_hz: new rate [Hz].
        options: ``downsample`` of the configuration.
        output: the output root.

    Raises:
        ConfigurationError: a rate, method or transform that makes no sense.
    """
    config = {"rate_hz": float(rate_hz), "method": options["method"], "transforms": list(options.get("transforms") or [])}
    transforms_of(config)
    return StagePlan(
        stage=STAGE,
        label=f"{ingested.label}-{rate_hz:g}hz",
        config=config,
        inputs=dict(ingested.outputs),
        code=code_of_downsampling(),
        output=output,
    )


def code_of_downsampling() -> str:
    """Version of what a downsampling runs."""
    return f"downsample={VERSION}"


def write_downsample(ingested: Artefact, config: Mapping[str, Any], folder: Path) -> None:
    """Transform and resample every recording into ``folder``.

    Raises:
        DataError: a recording cannot be brought to that rate.
    """
    transforms = transforms_of(config)
    for name in ingested.outputs:
        recording = read_recording(ingested.folder / name)
        if config["rate_hz"] > recording.rate_hz * (1 + 1e-9):
            raise DataError(
                f"recording '{recording.id}' is sampled at {recording.rate_hz:g} Hz, below the {config['rate_hz']:g} Hz asked for"
            )
        for transform in transforms:
            recording = transform(recording)
        write_recording(recording, folder / name)


def transforms_of(config: Mapping[str, Any]) -> Sequence[Transform]:
    """The transforms that a downsampling applies, in order."""
    first = [transform_from_config(entry) for entry in config["transforms"]]
    return [*first, Resample(float(config["rate_hz"]), config["method"])]
