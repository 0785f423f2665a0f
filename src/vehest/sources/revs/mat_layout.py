"""The official MAT files of Revs: structs of channels, each with its own clock."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.files import regular_file
from vehest.data.limits import check_limit
from vehest.sources.clocks import Clock, ClockPolicy, at_ticks, uniform_clock
from vehest.sources.columns import Column
from vehest.sources.limited import read_limited

READER = "vehest.sources.readers.mat_files:read_channels"
SLACK = 1e-2  # of an interval: as far as stamps may jitter


@dataclass(frozen=True)
class _Signal:
    """A column with its own times [s]; the last value holds for an interval."""

    name: str
    values: FloatArray
    stamps: FloatArray
    rate_hz: float

    @property
    def end(self) -> float:
        return float(self.stamps[-1]) + 1.0 / self.rate_hz


def read_mat_columns(
    file: Path,
    columns: Sequence[str],
    time: Column,
    rate_hz: float | None = None,
    policy: ClockPolicy = "strict",
    gappy: Collection[str] = (),
) -> tuple[Clock, dict[str, FloatArray], dict[str, float]]:
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

    Returns:
        The clock, columns in the units of the file, shape (T,), and the rate that each was recorded at [Hz].

    Raises:
        DataError: the file or a column cannot be used as it is.
    """
    reading = read_limited(READER, regular_file(file), columns=columns, time=time.column)
    signals = {}
    for column, name in reading.summary["names"].items():
        values, stamps = reading.arrays[f"{column}.value"], time.to_si(reading.arrays[f"{column}.time"], "s")
        signals[column] = _signal(f"'{file}': '{name}'", name, values, stamps, policy, column in gappy)
    slowest = min(signals.values(), key=lambda signal: signal.rate_hz)
    latest_start = max(signals.values(), key=lambda signal: float(signal.stamps[0]))
    earliest_end = min(signals.values(), key=lambda signal: signal.end)
    rate, origin = rate_hz or slowest.rate_hz, slowest.stamps[0]
    span = (earliest_end.end - origin) * rate
    check_limit("samples", span, f"'{file}' would become {span:.0f} samples at {rate:.6g} Hz")
    first = max(math.ceil((latest_start.stamps[0] - origin) * rate - SLACK), 0)
    n_samples = math.ceil(span - SLACK) - first
    if n_samples < 2:
        raise DataError(
            f"'{file}': '{earliest_end.name}' ends at {earliest_end.end:.12g} s, '{latest_start.name}' begins at "
            f"{latest_start.stamps[0]:.12g} s; there is no time in which all columns are measured"
        )
    ticks = origin + (first + np.arange(n_samples)) / rate
    held = {column: at_ticks(own.values, own.stamps, ticks, hold=True, slack=SLACK / own.rate_hz) for column, own in signals.items()}
    return Clock(float(ticks[0]), rate, n_samples), held, {column: own.rate_hz for column, own in signals.items()}


def _signal(where: str, name: str, values: FloatArray, stamps: FloatArray, policy: ClockPolicy, gappy: bool) -> _Signal:
    """A column from its first value on; a gappy one from its first sample on."""
    rate_hz = uniform_clock(stamps, where, policy).rate_hz
    if gappy:
        return _Signal(name, values, stamps, rate_hz)
    blank = np.isnan(values)
    first = int(np.argmin(blank))
    if blank[first:].any():
        missing = first + int(np.argmax(blank[first:]))
        what = f"holds NaN at {stamps[missing]:.12g} s; cut the range out, or declare its channel in 'gappy' if that means 'not measured'"
        raise DataError(f"{where} {what}")
    return _Signal(name, values[first:], stamps[first:], rate_hz)
