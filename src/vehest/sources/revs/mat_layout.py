"""The official MAT files of Revs: structs of channels, each with its own clock."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.limits import check_limit
from vehest.sources.clocks import ClockPolicy, uniform_clock
from vehest.sources.columns import Column
from vehest.sources.revs.mat_files import MatArray, read_mat_file

_VALUE = "value"
_SLACK = 1e-2  # of an interval: as far as stamps may jitter

_LATEST_TICK = 1e15

_Structs = dict[str, dict[str, MatArray | None]]


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
    structs = _structs(file, columns)
    signals = {column: _signal(file, structs, column, time, policy, column in set(gappy)) for column in columns}
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


def _structs(file: Path, columns: Iterable[str]) -> _Structs:
    """Names of all that stands in structs, with those arrays that may be wanted; what nothing is wanted of is not kept in memory."""
    wanted = {part for column in columns for part in (column, column.rsplit(".", 1)[-1], column.split(".", 1)[-1])}
    structs: _Structs = {}
    for name, array in read_mat_file(file).items():
        structs[name] = {inner: field if inner in wanted else None for inner, field in array.some_fields(wanted).items()}
    return structs


def _signal(file: Path, structs: _Structs, column: str, time: Column, policy: ClockPolicy, gappy: bool) -> _Signal:
    name, fields = _found(file, structs, column, time.column)
    arrays = {}
    for field in (_VALUE, time.column):
        if field not in fields:
            have = ", ".join(fields) or "none: it is no struct"
            raise DataError(f"'{file}': '{name}' has no field '{field}' (it has {have}); correct the map in conf/dataset")
        numbers = fields[field].numbers()
        if numbers is None:
            raise DataError(f"'{file}': '{name}.{field}' is no row or column of real numbers")
        arrays[field] = numbers
    values, stamps = arrays[_VALUE], time.to_si(arrays[time.column], "s")
    if len(values) != len(stamps):
        raise DataError(f"'{file}': '{name}' holds {len(values)} values and {len(stamps)} time stamps; fetch the file again")
    clock = uniform_clock(stamps, f"'{file}', '{name}'", policy)
    measured = np.flatnonzero(~np.isnan(values))
    if not len(measured):
        raise DataError(f"'{file}': '{name}' holds no number; leave its channel out of the map in conf/dataset")
    if not gappy and len(measured) < len(values) - measured[0]:
        missing = measured[0] + int(np.argmax(np.isnan(values[measured[0] :])))
        raise DataError(
            f"'{file}': '{name}' holds NaN at {stamps[missing]:.12g} s; cut the range out, or declare its channel in 'gappy' "
            f"if that means 'not measured'"
        )
    first = 0 if gappy else measured[0]
    return _Signal(name, stamps[first:], values[first:], clock.rate_hz)


def _found(file: Path, structs: _Structs, column: str, time: str) -> tuple[str, dict[str, MatArray]]:
    """A column's name with its struct, and its fields; parameters of the same name, which have no time, do not count."""
    inside = {f"{outer}.{inner}": array for outer, fields in structs.items() for inner, array in fields.items()}
    found = {name: array.fields() for name, array in inside.items() if array is not None and column in (name, name.split(".", 1)[1])}
    timed = {name: fields for name, fields in found.items() if time in fields} or found
    if len(timed) > 1:
        raise DataError(f"'{file}' has '{column}' more than once ({', '.join(timed)}); name its struct too, as in '{next(iter(timed))}'")
    if not timed:
        have = ", ".join(list(inside)[:12]) + (", …" if len(inside) > 12 else "") if inside else "no structs"
        raise DataError(f"'{file}' has no channel '{column}' (it has {have}); correct the map in conf/dataset")
    return next(iter(timed.items()))
