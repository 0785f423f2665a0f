"""Rates of estimators and of the evaluation, fitted to what the recordings of a split are sampled at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vehest.data.contents import Contents
from vehest.data.errors import ConfigurationError, DataError
from vehest.run.config import GIVEN, Config
from vehest.run.train import new_estimator

TOLERANCE = 1e-9  # relative, between two rates that are the same


@dataclass(frozen=True)
class Note:
    """What is said of a rate that was lowered.

    Args:
        what: runs more slowly: an estimator, or the evaluation.
        text: a sentence that goes on from there.
        advice: how to choose another.
    """

    what: str
    text: str
    advice: str


def slowest(contents: Mapping[str, Sequence[Contents]]) -> Contents:
    """The recording with the lowest rate of all data sets."""
    return min((recording for recordings in contents.values() for recording in recordings), key=lambda recording: recording.rate_hz)


def at_evaluation_rate(config: Config, limit: Contents) -> tuple[Config, tuple[Note, ...]]:
    """A configuration whose evaluation grid is no finer than recordings are sampled.

    Args:
        config: as composed for ``train`` or ``eval``.
        limit: the recording with the lowest rate.

    Returns:
        The same, or with another ``evaluation.rate_hz``, and what is to be said of that.

    Raises:
        DataError: an override asks for a finer grid.
    """
    rate = config.get("evaluation", {}).get("rate_hz")
    if not _exceeds(rate, limit):
        return config, ()
    if "evaluation.rate_hz" in config.get(GIVEN, ()):
        raise DataError(_refusal("evaluation.rate_hz", "the evaluation", rate, limit))
    lowered = {**config, "evaluation": {**config["evaluation"], "rate_hz": limit.rate_hz}}
    told = f"reads estimates at {limit.rate_hz:g} Hz instead of {rate:g} Hz, since {_sampled(limit)}"
    return lowered, (Note("evaluation", told, "evaluation.rate_hz=… chooses a lower rate"),)


def at_estimator_rate(config: Config, limit: Contents) -> tuple[Config, tuple[Note, ...]]:
    """A configuration whose estimator runs no faster than recordings are sampled; see `at_evaluation_rate`.

    Raises:
        DataError: an override asks for a higher rate, or a setting makes no sense at that of the recordings.
        ConfigurationError: a setting makes no sense.
    """
    rate = config["estimator"].get("rate_hz")
    if not _exceeds(rate, limit):
        return config, ()
    name = new_estimator(config["estimator"]).name
    if "estimator.rate_hz" in config.get(GIVEN, ()):
        raise DataError(_refusal("estimator.rate_hz", f"'{name}'", rate, limit))
    lowered = {**config, "estimator": {**config["estimator"], "rate_hz": limit.rate_hz}}
    try:
        new_estimator(lowered["estimator"])
    except ConfigurationError as error:
        raise DataError(f"estimator '{name}' cannot run at {limit.rate_hz:g} Hz, and {_sampled(limit)}: {error}") from None
    lengths = [
        f"{key} of {number} samples lasts {number / limit.rate_hz:.3g} s instead of {number / rate:.3g} s "
        f"({key}={max(1, round(number * limit.rate_hz / rate))} keeps that)"
        for key, number in _lengths(lowered)
    ]
    told = "; ".join([f"runs at {limit.rate_hz:g} Hz instead of its {rate:g} Hz, since {_sampled(limit)}", *lengths])
    return lowered, (Note(name, told, "estimator.rate_hz=… chooses a lower rate"),)


def _exceeds(rate: Any, limit: Contents) -> bool:
    """Whether a rate is one, and above that of a recording."""
    return isinstance(rate, int | float) and not isinstance(rate, bool) and rate > limit.rate_hz * (1.0 + TOLERANCE)


def _refusal(key: str, who: str, rate: float, limit: Contents) -> str:
    return f"{key} asks for {rate:g} Hz, and {_sampled(limit)}; give {key}={limit.rate_hz:g} or less, or leave it out and {who} takes that"


def _sampled(limit: Contents) -> str:
    return f"recording '{limit.id}' is sampled at {limit.rate_hz:g} Hz"


def _lengths(config: Config) -> list[tuple[str, int]]:
    """Lengths that settings of estimator and training count in samples, so that they last longer at a lower rate."""
    window = getattr(new_estimator(config["estimator"]).settings, "window", None)
    found = [("estimator.window", window)] if isinstance(window, int) else []  # where it is a float, it counts seconds
    for key, value in config["training"].items():
        if (key == "steps" or key.endswith("_steps")) and isinstance(value, int) and value > 0:
            found.append((f"training.{key}", value))
    return found
