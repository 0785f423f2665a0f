"""The official MAT files of Revs: structs of channels, each with its own clock."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
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


def read_mat_columns(
    file: Path,
    columns: Sequence[str],
    time: Column,
    rate_hz: float | None = None,
    policy: ClockPolicy = "strict",
    gappy: Collection[str] = (),
) -> tuple[Clock, dict[str, FloatArray], dict[str, float]]:
    """Columns of a recording on one clock; raises `DataError` where the file or a column cannot be used as it is.

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
    """
    reading = read_limited(READER, regular_file(file), columns=columns, time=time.column)
    values: dict[str, FloatArray] = {}
    stamps: dict[str, FloatArray] = {}
    rates: dict[str, float] = {}
    for column, name in reading.summary["names"].items():
        samples, times, where = reading.arrays[f"{column}.value"], time.to_si(reading.arrays[f"{column}.time"], "s"), f"'{file}': '{name}'"
        rates[column] = uniform_clock(times, where, policy).rate_hz
        blank = np.isnan(samples) & (column not in gappy)
        first = int(np.argmin(blank))
        if blank[first:].any():
            missing = times[first:][blank[first:]][0]
            what = f"holds NaN at {missing:.12g} s; cut the range out, or declare its channel in 'gappy' if that means 'not measured'"
            raise DataError(f"{where} {what}")
        values[column], stamps[column] = samples[first:], times[first:]
    slowest = min(rates, key=lambda column: rates[column])
    rate, origin = rate_hz or rates[slowest], float(stamps[slowest][0])
    start = max(float(own[0]) for own in stamps.values())
    end = min(float(own[-1]) + 1.0 / rates[column] for column, own in stamps.items())  # the last value holds for an interval
    check_limit("samples", (end - origin) * rate, f"'{file}' would become {(end - origin) * rate:.0f} samples at {rate:.6g} Hz")
    first = max(math.ceil((start - origin) * rate - SLACK), 0)
    n_samples = math.ceil((end - origin) * rate - SLACK) - first
    if n_samples < 2:
        raise DataError(f"'{file}': one column ends at {end:.12g} s, one begins at {start:.12g} s; nothing is common to all")
    ticks = origin + (first + np.arange(n_samples)) / rate
    held = {name: at_ticks(values[name], stamps[name], ticks, hold=True, slack=SLACK / rates[name]) for name in columns}
    return Clock(float(ticks[0]), rate, n_samples), held, rates
