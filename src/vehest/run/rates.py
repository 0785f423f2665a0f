"""Lowers rates of estimators and of the evaluation to those of a split's recordings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from vehest.data.contents import Contents
from vehest.data.errors import ConfigurationError, DataError
from vehest.run.config import GIVEN, Config
from vehest.run.train import new_estimator

TOLERANCE = 1e-9  # relative, between two rates that are the same

Note = tuple[str, str]
"""An estimator, or ``evaluation``, whose rate was lowered, and the sentence that goes on from there."""


def slowest(contents: Mapping[str, Sequence[Contents]]) -> Contents:
    """The recording with the lowest rate of all data sets."""
    return min((recording for recordings in contents.values() for recording in recordings), key=lambda recording: recording.rate_hz)


def lower_rate(config: Config, group: str, limit: Contents) -> tuple[Config, list[Note]]:
    """A configuration whose ``GROUP.rate_hz`` is no higher than that of a recording, and a note if it was.

    Args:
        config: as composed for ``train`` or ``eval``.
        group: ``estimator`` or ``evaluation``.
        limit: the recording with the lowest rate.

    Raises:
        DataError: an override asks for a higher rate, or a setting makes no sense at that of the recordings.
        ConfigurationError: a setting makes no sense.
    """
    rate, key, lowest = config.get(group, {}).get("rate_hz"), f"{group}.rate_hz", limit.rate_hz
    if not isinstance(rate, int | float) or isinstance(rate, bool) or rate <= lowest * (1.0 + TOLERANCE):
        return config, []
    name = group if group == "evaluation" else new_estimator(config["estimator"]).name
    sampled = f"recording '{limit.id}' is sampled at {lowest:g} Hz"
    if key in config.get(GIVEN, ()):
        who = "the evaluation" if group == "evaluation" else f"'{name}'"
        raise DataError(f"{key} asks for {rate:g} Hz, and {sampled}; give {key}={lowest:g} or less, or leave it out and {who} takes that")
    lowered = {**config, group: {**config[group], "rate_hz": lowest}}
    if group == "evaluation":
        return lowered, [(name, f"reads estimates at {lowest:g} Hz instead of {rate:g} Hz, since {sampled}")]
    try:
        new_estimator(lowered["estimator"])
    except ConfigurationError as error:
        raise DataError(f"estimator '{name}' cannot run at {lowest:g} Hz, and {sampled}: {error}") from None
    lengths = [
        f"; {key} of {number} samples lasts {number / lowest:.3g} s instead of {number / rate:.3g} s "
        f"({key}={max(1, round(number * lowest / rate))} keeps that)"
        for key, number in _lengths(lowered)
    ]
    return lowered, [(name, f"runs at {lowest:g} Hz instead of its {rate:g} Hz, since {sampled}{''.join(lengths)}")]


def _lengths(config: Config) -> Iterator[tuple[str, int]]:
    """Settings of estimator and training that count samples, and so last longer at a lower rate."""
    window = getattr(new_estimator(config["estimator"]).settings, "window", None)
    if isinstance(window, int):  # a float counts seconds
        yield "estimator.window", window
    for key, value in config["training"].items():
        if (key == "steps" or key.endswith("_steps")) and isinstance(value, int) and value > 0:
            yield f"training.{key}", value
