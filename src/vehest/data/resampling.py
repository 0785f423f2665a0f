"""Recordings at the rate of an estimator: transforms of a preparation, then resampling.

recording, or its parts -> transforms at the native rate -> `Resample` -> recording at another rate
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from fractions import Fraction
from typing import Any

from vehest.data.errors import DataError
from vehest.data.recording import PART, Recording, joined
from vehest.data.transforms import Resample, Transform, transform_from_config


def resampled(
    recording: Recording,
    rate_hz: float,
    preparation: Mapping[str, Any],
    *,
    slowest_hz: float = math.inf,
) -> Recording:
    """A recording, after the transforms of a preparation and by its method, at another rate.

    Raises
    ------
    DataError
        A rate that is higher than the recording's, unless this is sampled at ``slowest_hz`` or
        faster.
    """
    if recording.rate_hz < min(rate_hz * (1 - 1e-9), slowest_hz):
        raise DataError(
            f"recording '{recording.id}' is sampled at {recording.rate_hz:g} Hz, below the "
            f"{rate_hz:g} Hz needed; record or export it at {min(rate_hz, slowest_hz):g} Hz or "
            "more, since it does not show what the car does between slower samples"
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
    """`resampled` for a recording that comes in parts, to the same bits.

    A preparation with other transforms needs it whole.

    Parameters
    ----------
    parts : iterable of Recording
        Parts that follow one another, each with its number and that of all parts in its provenance;
        one without is the last.
    rate_hz : float
        Rate of the outcome [Hz].
    preparation : mapping
        As of `resampled`.
    slowest_hz : float
        As of `resampled` [Hz].

    Yields
    ------
    Recording
        Parts of the outcome that follow one another, perhaps of other lengths than those that came.
    """
    if preparation["transforms"]:
        parts = [joined(list(parts))]
    pending: list[Recording] = []
    done = 0  # samples at the start of the outcome that are out already
    for part in parts:
        segment = joined([*pending, part])
        outcome = resampled(segment, rate_hz, preparation, slowest_hz=slowest_hz)
        ratio = (Fraction(outcome.rate_hz) / Fraction(segment.rate_hz)).limit_denominator(1000)
        reach = Resample.reach(ratio)
        begin = (len(segment) - 2 * reach) // ratio.denominator * ratio.denominator
        number, last = part.provenance.get(PART, (1, 1))
        if number == last:
            yield outcome.part(slice(done, len(outcome)))
        elif begin > 0:
            yield outcome.part(slice(done, int((begin + reach) * ratio)))
            segment = segment.part(slice(begin, len(segment)))
            done = int(reach * ratio)
        pending = [segment]


def transforms_of(config: Mapping[str, Any]) -> list[Transform]:
    """The transforms of a downsampling, in order."""
    return [
        *map(transform_from_config, config["transforms"]),
        Resample(float(config["rate_hz"]), config["method"]),
    ]
