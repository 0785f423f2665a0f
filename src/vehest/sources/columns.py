"""From a file's columns to channels: units, signs and a uniform clock, all declared in conf/dataset."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from vehest.data.channels import CHANNELS, channel
from vehest.data.checks import checks_of_clock
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import FloatArray
from vehest.data.units import factor_to_si

ClockPolicy = Literal["strict", "interpolate"]

MOST_DRIFT = 0.01  # of an interval, over a whole recording, that may come from the resolution of the stamps
INTERPOLATED_TOLERANCE = 5e-3  # an interpolated clock may run at any rate: take a plain one this near


@dataclass(frozen=True)
class Column:
    """How a channel is found in a file.

    Args:
        column: the column's name in the file.
        unit: the unit its values have there.
        sign: 1, or -1 where the file counts the other way round than ISO 8855.
        factor: what the file's values must be multiplied with to be in ``unit``, such as 1 / wheel radius.
    """

    column: str
    unit: str
    sign: int = 1
    factor: float = 1.0

    def to_si(self, values: FloatArray, si_unit: str) -> FloatArray:
        """Values in SI units and ISO 8855 signs."""
        factor = self.sign * self.factor * factor_to_si(self.unit, si_unit)
        return values if factor == 1.0 else values * factor


def columns_from_config(entries: Mapping[str, Any], dataset: str) -> dict[str, Column]:
    """The map of channels that a data set declares.

    Raises:
        ConfigurationError: an unknown channel, unit or key.
    """
    if not isinstance(entries, Mapping):
        raise ConfigurationError(f"data set '{dataset}': channels must map a channel to its column and unit, not {entries}")
    columns = {}
    for name, entry in entries.items():
        where = f"data set '{dataset}': channel '{name}'"
        try:
            described = channel(str(name))
            column = column_from_config(entry, where)
            factor_to_si(column.unit, described.unit)
        except DataError as error:
            raise ConfigurationError(f"{where}: {error}") from None
        columns[str(name)] = column
    return columns


def column_from_config(entry: Any, where: str) -> Column:
    """One column's declaration.

    Raises:
        ConfigurationError: it does not say column and unit, or says something else too.
    """
    if not isinstance(entry, Mapping) or not {"column", "unit"} <= set(entry) or set(entry) - {"column", "unit", "sign", "factor"}:
        raise ConfigurationError(f"{where} must say column, unit and, if need be, sign and factor, not {entry}")
    if entry.get("sign", 1) not in (1, -1):
        raise ConfigurationError(f"{where}: sign must be 1 or -1, not {entry['sign']}")
    factor = entry.get("factor", 1.0)
    if isinstance(factor, bool) or not isinstance(factor, int | float) or not math.isfinite(factor) or factor == 0:
        raise ConfigurationError(f"{where}: factor must be a number other than 0, not {factor}")
    return Column(str(entry["column"]), str(entry["unit"]), int(entry.get("sign", 1)), float(factor))


def time_column_from_config(entry: Any, dataset: str) -> Column:
    """The declaration of the time column.

    Raises:
        ConfigurationError: it does not say column and unit, or the unit is none of time.
    """
    where = f"data set '{dataset}': time"
    column = column_from_config(entry, where)
    try:
        factor_to_si(column.unit, "s")
    except DataError as error:
        raise ConfigurationError(f"{where}: {error}") from None
    return column


def identity_columns(names: list[str]) -> dict[str, Column]:
    """Columns that already carry a channel's name and unit."""
    return {name: Column(name, CHANNELS[name].unit) for name in names if name in CHANNELS}


@dataclass(frozen=True)
class Clock:
    """A uniform clock, and how to bring samples onto it.

    Args:
        start_time: time of the first sample [s].
        rate_hz: sampling rate [Hz].
        stamps: the file's own time stamps, where samples must be interpolated [s].
        n_samples: samples on the uniform clock.
    """

    start_time: float
    rate_hz: float
    n_samples: int
    stamps: FloatArray | None = None

    def align(self, samples: FloatArray, gappy: bool = False) -> FloatArray:
        """Samples on the uniform clock, by linear interpolation where the file's own clock jitters.

        A gappy channel's samples go to the nearest tick instead: interpolation would lose every one that stands between two gaps.
        """
        if self.stamps is None:
            return samples
        elapsed = self.stamps - self.stamps[0]
        if not gappy:
            return np.interp(np.arange(self.n_samples) / self.rate_hz, elapsed, samples)
        aligned = np.full(self.n_samples, np.nan)
        measured = np.flatnonzero(~np.isnan(samples))
        aligned[np.clip(np.rint(elapsed[measured] * self.rate_hz).astype(np.int64), 0, self.n_samples - 1)] = samples[measured]
        return aligned


def uniform_clock(stamps: FloatArray, where: str, policy: ClockPolicy = "strict") -> Clock:
    """The uniform clock behind a file's time stamps.

    Args:
        stamps: time stamps [s], shape (T,).
        where: file, for messages.
        policy: ``strict`` refuses gaps, jitter above 1 % of an interval and drift, ``interpolate`` bridges them.

    Raises:
        DataError: stamps repeat or go backwards, or are not uniform and ``policy`` is strict.
    """
    for finding in checks_of_clock(stamps):
        if finding.level == "error" and (finding.check == "clock" or policy == "strict"):
            fix = "cut the range out or set clock: interpolate" if finding.check == "gap" else "repair, remove or sort the rows"
            raise DataError(f"{where}: {finding.message}; {fix}")
        if finding.check in {"jitter", "drift"} and policy == "strict":
            raise DataError(f"{where}: {finding.message}; set clock: interpolate to bring the samples to a uniform clock")
    elapsed = float(stamps[-1] - stamps[0])
    if policy == "interpolate":
        rate = plain_rate(1.0 / _interval(np.diff(stamps)), INTERPOLATED_TOLERANCE)
        return Clock(float(stamps[0]), rate, int(np.floor(elapsed * rate + 1e-3)) + 1, stamps)
    intervals = len(stamps) - 1
    rate = plain_rate(intervals / elapsed, min(MOST_DRIFT / intervals, 1e-4))
    return Clock(float(stamps[0]), rate, len(stamps))


def _interval(steps: FloatArray) -> float:
    """The sampling interval behind jittering time stamps [s]: the mean, a gap counting as the samples that it lacks."""
    interval = float(np.median(steps))
    for _ in range(3):
        interval = float(steps.sum() / np.maximum(np.rint(steps / interval), 1.0).sum())
    return interval


def plain_rate(rate: float, tolerance: float) -> float:
    """The rate that was meant: the nearest whole number of Hz, ms, mHz or µs, the coarse ones first.

    Time stamps carry the dust of their resolution (a double holds unix time to 0.24 µs), and the rate computed from them would
    not be a rational multiple of any other.

    Args:
        rate: as computed from time stamps [Hz].
        tolerance: relative deviation that is put down to the stamps.
    """
    for scale in (1.0, 1e3):
        hertz = round(rate * scale) / scale
        interval = round(1e3 * scale / rate) / (1e3 * scale)
        candidates = [candidate for candidate in (hertz, 1.0 / interval if interval else 0.0) if abs(candidate / rate - 1.0) <= tolerance]
        if candidates:
            return min(candidates, key=lambda candidate: abs(candidate - rate))
    return rate
