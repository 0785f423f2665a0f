"""The official MAT files of Revs: structs of channels, each with its own clock."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.files import regular_file
from vehest.data.limits import check_limit
from vehest.sources.clocks import ClockPolicy, uniform_clock
from vehest.sources.columns import Column
from vehest.sources.limited import read_limited

_VALUE = "value"
_SLACK = 1e-2  # of an interval: as far as stamps may jitter

_LATEST_TICK = 1e15


@dataclass(frozen=True)
class AlignedColumns:
    """Columns on one clock.

    Args:
        start_time: of the first sample [s].
        rate_hz: of all columns [Hz].
        values: column -> samples in the units of the file, shape (T,).
        native_rates_hz: column -> rate that it was recorded at [Hz].
    """

    start_time: float
    rate_hz: float
    values: dict[str, FloatArray]
    native_rates_hz: dict[str, float]


def read_mat_columns(
    file: Path,
    columns: Iterable[str],
    time: Column,
    rate_hz: float | None = None,
    policy: ClockPolicy = "strict",
    gappy: Iterable[str] = (),
) -> AlignedColumns:
    """Columns of a recording on one clock.

    A sample is the column's last value at or before its time: nothing is interpolated, and nothing comes from the future. The clock
    spans the time in which every column has a value.

    Args:
        file: a MAT file of version 5 to 7.
        columns: names, as ``vxCG`` or, where several structs have one of that name, ``insData.vxCG``.
        time: name and unit of the field of time stamps.
        rate_hz: of the result; None: that of the slowest column, whose samples then stay as they are.
        policy: ``strict`` refuses gaps, jitter and drift of a column's own clock, ``interpolate`` holds values across them.
        gappy: columns in which NaN is no error.

    Raises:
        DataError: the file or a column cannot be used as it is.
    """
    columns = list(columns)
    reader = "vehest.sources.readers.mat_files:read_channels"
    reading = read_limited(reader, regular_file(file), columns=columns, value=_VALUE, time=time.column)
    signals = {}
    for column in columns:
        values, stamps = reading.arrays[f"{column}.{_VALUE}"], reading.arrays[f"{column}.{time.column}"]
        where = f"'{file}': '{reading.summary['names'][column]}'"
        signals[column] = _signal(where, reading.summary["names"][column], values, time.to_si(stamps, "s"), policy, column in set(gappy))
    slowest = min(signals.values(), key=lambda signal: signal.rate_hz)
    rate = slowest.rate_hz if rate_hz is None else rate_hz
    origin = slowest.stamps[0]
    latest_start = max(signals.values(), key=lambda signal: float(signal.stamps[0]))
    earliest_end = min(signals.values(), key=_Signal.end)
    span = (earliest_end.end() - origin) * rate
    if not abs(span) < _LATEST_TICK:
        raise DataError(f"'{file}': '{earliest_end.name}' ends at {earliest_end.end():.6g} s, which no drive does; fetch the file again")
    check_limit("samples", span, f"'{file}' would become {span:.0f} samples at {rate:.6g} Hz")
    first = max(math.ceil((latest_start.stamps[0] - origin) * rate - _SLACK), 0)
    n_samples = math.ceil((earliest_end.end() - origin) * rate - _SLACK) - first
    if n_samples < 2:
        raise DataError(
            f"'{file}': '{earliest_end.name}' ends at {earliest_end.end():.12g} s, '{latest_start.name}' begins at "
            f"{latest_start.stamps[0]:.12g} s; there is no time in which all columns are measured"
        )
    ticks = origin + (first + np.arange(n_samples)) / rate
    return AlignedColumns(
        start_time=float(ticks[0]),
        rate_hz=rate,
        values={column: signal.held(ticks) for column, signal in signals.items()},
        native_rates_hz={column: signal.rate_hz for column, signal in signals.items()},
    )


@dataclass(frozen=True)
class _Signal:
    name: str
    stamps: FloatArray
    values: FloatArray
    rate_hz: float

    def end(self) -> float:
        """End of the last value's interval [s]."""
        return float(self.stamps[-1]) + 1.0 / self.rate_hz

    def held(self, ticks: FloatArray) -> FloatArray:
        """The last value at or before each tick."""
        return self.values[np.searchsorted(self.stamps, ticks + _SLACK / self.rate_hz, side="right") - 1]


def _signal(where: str, name: str, values: FloatArray, stamps: FloatArray, policy: ClockPolicy, gappy: bool) -> _Signal:
    clock = uniform_clock(stamps, where, policy)
    measured = np.flatnonzero(~np.isnan(values))
    if not len(measured):
        raise DataError(f"{where} holds no number; leave its channel out of the map in conf/dataset")
    if not gappy and len(measured) < len(values) - measured[0]:
        missing = measured[0] + int(np.argmax(np.isnan(values[measured[0] :])))
        raise DataError(
            f"{where} holds NaN at {stamps[missing]:.12g} s; cut the range out, or declare its channel in 'gappy' "
            f"if that means 'not measured'"
        )
    first = 0 if gappy else measured[0]
    return _Signal(name, stamps[first:], values[first:], clock.rate_hz)
