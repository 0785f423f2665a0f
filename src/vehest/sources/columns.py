"""From a file's columns to channels: units, signs and a uniform clock, all declared in conf/dataset."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np

from vehest.alignment.checks import checks_of_clock
from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS, channel
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.limits import check_limit
from vehest.data.schema import validated
from vehest.data.units import factor_to_si
from vehest.sources.stamps import uniform_times

ClockPolicy = Literal["strict", "interpolate", "uniform"]
ChannelMap = Annotated[dict[str, Any], "a mapping from a channel to its column and unit"]
ChannelNames = Annotated[tuple[str, ...], "a list of channels"]

MOST_STRETCH = 0.1  # of an interval, over a whole recording, by which a plain rate may differ from the one found
MOST_DRIFT = 0.01  # of an interval, over a whole recording, that may come from the resolution of the stamps
SHORTEST_INTERVAL = 1e-9  # s
LONGEST_INTERVAL = 86_400.0  # s
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
    factor: Annotated[float, "a number other than 0"] = 1.0

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
    if not isinstance(entry, Mapping):
        raise ConfigurationError(f"{where} must say column, unit and, if need be, sign and factor, not {str(entry)[:80]}")
    name = entry.get("column")
    named = {**entry, "column": str(name)} if type(name) is int else dict(entry)  # YAML reads a column called 3 as a number
    column = validated(Column, named, where, error=ConfigurationError)
    if column.sign not in (1, -1):
        raise ConfigurationError(f"{where}: sign must be 1 or -1, not {column.sign}")
    if column.factor == 0:
        raise ConfigurationError(f"{where}: factor must be a number other than 0")
    return column


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

    def times_of_rows(self) -> FloatArray:
        """When the file's rows were taken [s]."""
        return self.start_time + np.arange(self.n_samples) / self.rate_hz if self.stamps is None else self.stamps

    def ticks(self) -> FloatArray:
        """Times of the uniform clock [s]."""
        return self.start_time + np.arange(self.n_samples) / self.rate_hz

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


def uniform_clock(stamps: FloatArray, where: str, policy: ClockPolicy = "strict", *, n_channels: int = 1) -> Clock:
    """The uniform clock behind a file's time stamps.

    Args:
        stamps: time stamps [s], shape (T,).
        where: file, for messages.
        policy: ``strict`` refuses gaps, jitter above 1 % of an interval and drift, ``interpolate`` bridges them, ``uniform`` takes the rows
            as evenly sampled and only their stamps as late, and refuses missing rows.
        n_channels: how many are to be brought onto the clock.

    Raises:
        DataError: stamps repeat or go backwards, are not uniform and ``policy`` is strict, lie less than a nanosecond or more than a day
            apart, or a clock without their gaps would hold more samples than the limits allow.
    """
    if policy == "uniform" and len(stamps) > 1:
        return _clock_behind(stamps, where)
    for finding in checks_of_clock(stamps):
        if finding.level == "error" and (finding.check == "clock" or policy == "strict"):
            fix = "cut the range out or set clock: interpolate" if finding.check == "gap" else "repair, remove or sort the rows"
            raise DataError(f"{where}: {finding.message}; {fix}")
        if finding.check in {"jitter", "drift"} and policy == "strict":
            raise DataError(f"{where}: {finding.message}; set clock: interpolate to bring the samples to a uniform clock")
    elapsed = float(stamps[-1] - stamps[0])
    _require_interval(stamps, where)
    if policy == "interpolate":
        _require_length(stamps, 1.0 / float(np.median(np.diff(stamps))), n_channels, where)
        rate = plain_rate(1.0 / _interval(np.diff(stamps)), INTERPOLATED_TOLERANCE)
        _require_length(stamps, rate, n_channels, where)
        return Clock(float(stamps[0]), rate, int(np.floor(elapsed * rate + 1e-3)) + 1, stamps)
    intervals = len(stamps) - 1
    rate = plain_rate(intervals / elapsed, min(MOST_DRIFT / intervals, 1e-4))
    return Clock(float(stamps[0]), rate, len(stamps))


def _clock_behind(stamps: FloatArray, where: str) -> Clock:
    """The even clock behind stamps that say when software got round to the samples."""
    _require_interval(stamps, where)
    nominal = plain_rate(1.0 / float(np.median(np.diff(stamps))), INTERPOLATED_TOLERANCE)
    sampled = uniform_times(stamps, nominal, where, fix="leave rows out by drop_rows or set clock: interpolate")
    intervals = len(stamps) - 1
    return Clock(float(sampled.times[0]), plain_rate(float(sampled.rate_hz or 0.0), min(MOST_STRETCH / intervals, 1e-4)), len(stamps))


def _require_interval(stamps: FloatArray, where: str) -> None:
    """See that the time stamps lie as far apart as those of a recording can."""
    interval = float(np.median(np.diff(stamps)))
    if not SHORTEST_INTERVAL <= interval <= LONGEST_INTERVAL:
        raise DataError(
            f"{where}: the time stamps lie {interval:.6g} s apart (from {stamps[0]:.12g} s to {stamps[-1]:.12g} s); "
            f"correct the unit of time, which is declared in conf/dataset"
        )


def _require_length(stamps: FloatArray, rate: float, n_channels: int, where: str) -> None:
    """See that an even clock over the time stamps stays within the limits; where one gap makes it long, its stamps are named."""
    steps = np.diff(stamps)
    n_samples = math.floor(float(stamps[-1] - stamps[0]) * rate) + 1
    longest = int(np.argmax(steps))
    what = f"{where}: an even clock of {rate:.6g} Hz over {len(stamps)} time stamps would hold {n_samples} samples"
    if steps[longest] * rate > 0.5 * n_samples:
        what += (
            f" (most of them in the gap of {steps[longest]:.6g} s between data rows {longest + 1} ({stamps[longest]:.12g} s) and "
            f"{longest + 2} ({stamps[longest + 1]:.12g} s): remove the row with the stray stamp, or what lies on one side)"
        )
    check_limit("samples", n_samples, what)
    check_limit("memory", 8 * n_samples * n_channels, f"{what} of {n_channels} channels")


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
