"""From a file's columns to channels: units, signs and a uniform clock, all declared in conf/dataset."""

from __future__ import annotations

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


@dataclass(frozen=True)
class Column:
    """How a channel is found in a file.

    Args:
        column: the column's name in the file.
        unit: the unit its values have there.
        sign: 1, or -1 where the file counts the other way round than ISO 8855.
    """

    column: str
    unit: str
    sign: int = 1

    def to_si(self, values: FloatArray, si_unit: str) -> FloatArray:
        """Values in SI units and ISO 8855 signs."""
        factor = self.sign * factor_to_si(self.unit, si_unit)
        return values if factor == 1.0 else values * factor


def columns_from_config(entries: Mapping[str, Any], dataset: str) -> dict[str, Column]:
    """The map of channels that a data set declares.

    Raises:
        ConfigurationError: an unknown channel, unit or key.
    """
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
    if not isinstance(entry, Mapping) or not {"column", "unit"} <= set(entry) or set(entry) - {"column", "unit", "sign"}:
        raise ConfigurationError(f"{where} must say column, unit and, if need be, sign, not {entry}")
    if entry.get("sign", 1) not in (1, -1):
        raise ConfigurationError(f"{where}: sign must be 1 or -1, not {entry['sign']}")
    return Column(str(entry["column"]), str(entry["unit"]), int(entry.get("sign", 1)))


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

    def align(self, samples: FloatArray) -> FloatArray:
        """Samples on the uniform clock, by linear interpolation where the file's own clock jitters."""
        if self.stamps is None:
            return samples
        return np.interp(self.start_time + np.arange(self.n_samples) / self.rate_hz, self.stamps, samples)


def uniform_clock(stamps: FloatArray, where: str, policy: ClockPolicy = "strict") -> Clock:
    """The uniform clock behind a file's time stamps.

    Args:
        stamps: time stamps [s], shape (T,).
        where: file, for messages.
        policy: ``strict`` refuses gaps and jitter above 1 % of an interval, ``interpolate`` bridges them.

    Raises:
        DataError: stamps repeat or go backwards, or are not uniform and ``policy`` is strict.
    """
    for finding in checks_of_clock(stamps):
        if finding.level == "error" and (finding.check == "clock" or policy == "strict"):
            fix = "cut the range out or set clock: interpolate" if finding.check == "gap" else "remove or sort the rows"
            raise DataError(f"{where}: {finding.message}; {fix}")
        if finding.check == "jitter" and policy == "strict":
            raise DataError(f"{where}: {finding.message}; set clock: interpolate to bring the samples to a uniform clock")
    if policy == "interpolate":
        interval = float(np.median(np.diff(stamps)))
        rate = _rounded(1.0 / interval)
        return Clock(float(stamps[0]), rate, int(np.floor((stamps[-1] - stamps[0]) * rate + 1e-6)) + 1, stamps)
    rate = _rounded((len(stamps) - 1) / (stamps[-1] - stamps[0]))
    return Clock(float(stamps[0]), rate, len(stamps))


def _rounded(rate: float) -> float:
    """The rate without the dust of floating point, for example 100.0 for 99.99999999999999."""
    return float(f"{rate:.9g}")
