"""Second stage: recordings at their native rate to recordings at an estimator's rate."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

from vehest.data.errors import DataError
from vehest.data.recording import PART, Recording, joined
from vehest.data.store import read_recording, write_recording
from vehest.data.transforms import Resample, Transform, transform_from_config
from vehest.run.artefacts import Artefact, StagePlan
from vehest.run.versions import code_of

STAGE = "downsample"


def plan_downsample(
    ingested: Artefact, rate_hz: float, options: Mapping[str, Any], output: Path
) -> StagePlan:
    """The artefact of a downsampling; raises `ConfigurationError` for a rate, method or transform that makes no sense."""
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
    """Transform and resample every recording into ``folder``."""
    for name in ingested.outputs:
        write_recording(
            resampled(read_recording(ingested.folder / name), config["rate_hz"], config),
            folder / name,
        )


def resampled(
    recording: Recording,
    rate_hz: float,
    preparation: Mapping[str, Any],
    *,
    slowest_hz: float = math.inf,
) -> Recording:
    """A recording, after the transforms of a preparation and by its method, at another rate.

    Raises `DataError` for a rate that is higher than the recording's, unless this is sampled at
    ``slowest_hz`` or faster.
    """
    if recording.rate_hz < min(rate_hz * (1 - 1e-9), slowest_hz):
        raise DataError(
            f"recording '{recording.id}' is sampled at {recording.rate_hz:g} Hz, below the {rate_hz:g} Hz needed"
        )
    for transform in transforms_of({**preparation, "rate_hz": rate_hz}):
        recording = transform(recording)
    return recording


def resampled_parts(
    parts: Iterable[Recording],
    rate_hz: float,
    preparation: Mapping[str, Any],
    *,
    slowest_hz: float = math.inf,
) -> Iterator[Recording]:
    """`resampled` for a recording that comes in parts, to the same bits; a preparation with other transforms needs it whole."""
    if preparation["transforms"]:
        parts = [joined(list(parts))]
    kept: list[Recording] = []
    done = 0  # samples at the start of the outcome that are out already
    for part in parts:
        whole = joined([*kept, part])
        found = resampled(whole, rate_hz, preparation, slowest_hz=slowest_hz)
        ratio = (Fraction(found.rate_hz) / Fraction(whole.rate_hz)).limit_denominator(1000)
        reach = Resample.reach(ratio)
        begin = (len(whole) - 2 * reach) // ratio.denominator * ratio.denominator
        number, last = part.provenance.get(PART, (1, 1))
        if number == last:
            yield found.part(slice(done, len(found)))
        elif begin > 0:
            yield found.part(slice(done, int((begin + reach) * ratio)))
            whole = whole.part(slice(begin, len(whole)))
            done = int(reach * ratio)
        kept = [whole]


def transforms_of(config: Mapping[str, Any]) -> list[Transform]:
    """The transforms of a downsampling, in order."""
    return [
        *map(transform_from_config, config["transforms"]),
        Resample(float(config["rate_hz"]), config["method"]),
    ]
