"""Slow channels that a table repeats from row to row until their next sample: the samples, and straight lines between them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.schema import validated

FEWEST = 2


@dataclass(frozen=True)
class HeldOptions:
    """What a data set says of its held channels."""

    channels: Annotated[tuple[str, ...], "a list of channels"]
    updated: str | int | None = None
    delay: float | dict[str, float] = 0.0


@dataclass(frozen=True)
class Held:
    """Channels whose values stand in every row, though they are new in few.

    Args:
        channels: their names.
        updated: column that changes with every new sample, such as a time stamp of the sensors' own; None: a sample is new in the rows
            in which any of the channels changes.
        delay: channel -> how much later than it was taken a sample first stands in a row [s].
    """

    channels: tuple[str, ...]
    updated: str | None
    delay: Mapping[str, float]

    def description(self, rate_hz: float) -> dict[str, Any]:
        """What was made of them, for the provenance."""
        return {"channels": list(self.channels), "rate_hz": round(rate_hz, 3), "delay": dict(self.delay)}


def held_from_config(entry: Any, known: Sequence[str], where: str) -> Held:
    """A data set's declaration of held channels.

    Raises:
        ConfigurationError: it names a channel that the data set does not have, or says something else.
    """
    options = validated(HeldOptions, entry, where, error=ConfigurationError)
    for name in options.channels:
        if name not in known:
            raise ConfigurationError(f"{where} names '{name}', which is not one of the data set's channels")
    delays = options.delay if isinstance(options.delay, dict) else dict.fromkeys(options.channels, options.delay)
    for name in delays:
        if name not in options.channels:
            raise ConfigurationError(f"{where}: delay names '{name}', which is not one of its channels")
    updated = None if options.updated is None else str(options.updated)
    return Held(options.channels, updated, {name: float(delays.get(name, 0.0)) for name in options.channels})


def new_samples(columns: Sequence[FloatArray], where: str) -> NDArray[np.int64]:
    """Rows, counted from 0, in which any column differs from the row before; what the first row holds may be older.

    Raises:
        DataError: there are fewer than two.
    """
    changed = np.zeros(len(columns[0]) - 1, dtype=np.bool_)
    for column in columns:
        changed |= np.diff(column) != 0
    rows: NDArray[np.int64] = np.flatnonzero(changed).astype(np.int64) + 1
    if len(rows) < FEWEST:
        raise DataError(f"{where}: the held channels change in {len(rows)} rows; was their sensor connected? leave the file out")
    return rows


def between_samples(samples: FloatArray, times: FloatArray, delay: float, grid: FloatArray) -> FloatArray:
    """A held channel on another clock: straight lines between its samples, which look ahead by up to one interval; NaN outside."""
    return np.interp(grid, times - delay, samples, left=np.nan, right=np.nan)


def with_repeats(samples: FloatArray, times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Samples and times where no column tells of an update: a value that stays was sampled again, up to an interval before the next change.

    The interval is the median one between changes. Without this a straight line would be drawn through all of a standstill.
    """
    intervals = np.diff(times)
    typical = float(np.median(intervals))
    late = np.flatnonzero(intervals > 1.5 * typical)
    return np.insert(samples, late + 1, samples[late]), np.insert(times, late + 1, times[late + 1] - typical)
