"""Columns, clock and runs that a survey finds in a log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from vehest.constants import FloatArray


@dataclass(frozen=True, eq=False)
class RawColumn:
    """A column, signal or field of numbers that a survey has found."""

    name: str  # name for people; unique within its log
    unit: str  # unit as the file writes it; empty where it does not
    values: FloatArray  # values in that unit, NaN where there is none, (N,)
    # entry by which a data set names it, such as ``{"column": "Gyro"}``
    place: Mapping[str, Any]
    # times of its samples [s], (N,); None where the log has one clock for all
    stamps: FloatArray | None = None
    # whether the file says that the car measured it, on its bus, or the reference did; empty where
    # it does not
    device: Literal["", "car", "reference"] = ""
    # scale and offset of raw values, by which a data set of a bus declares those that mean nothing
    scaling: tuple[float, float] | None = None

    def written(self, value: float) -> float:
        """A value as a data set declares it: as in the file, whole where it is raw."""
        if self.scaling is None:
            return value
        scale, offset = self.scaling
        return round((value - offset) / scale)


@dataclass(frozen=True)
class Stamps:
    """A column that looks like a clock, and its unit."""

    column: str  # name of the column
    unit: str  # unit of time, such as ``s``, ``ms``, ``us`` or ``ns``
    evidence: str  # reasons to take it as the clock, for people
    asked: bool = False  # whether the unit is ambiguous, so that the user is asked
    is_stated: bool = False  # whether the header states a unit of time
    repair: Mapping[str, Any] = field(default_factory=dict)  # options that put times in order


@dataclass(frozen=True, eq=False)
class Log:
    """Columns of a file, its clock and its runs."""

    file: Path  # the file, or a bag's folder
    source: str  # name of the source that reads it
    columns: tuple[RawColumn, ...]  # columns without the clock
    # options of the source, such as delimiter and decimal mark
    options: Mapping[str, Any] = field(default_factory=dict)
    # column of times; None where there is none, or where the format has times of its own
    clock: Stamps | None = None
    # times of the rows [s], (N,), from the clock; None where columns have their own or there is no
    # clock
    seconds: FloatArray | None = None
    # rows of each uninterrupted run, the longest first; one of all where times never restart
    runs: tuple[slice, ...] = ()
    skipped: tuple[str, ...] = ()  # parts that were not read, with the reason
    # rows of texts, from 1, such as repeated names; they are in no column
    repeated_names: tuple[int, ...] = ()
    # rate of the rows [Hz], where the file states it beside their times
    rate_hz: float | None = None
    rate_source: str = ""  # place where it is stated, for people

    @cached_property
    def by_name(self) -> dict[str, RawColumn]:
        """Name -> column."""
        return {column.name: column for column in self.columns}

    def file_row(self, place: int) -> int:
        """Number among the file's data rows, from 1, of a row of the columns, from 0.

        Rows of texts, such as repeated names, are counted in the file, but are in no column.
        """
        row = place + 1
        for repeated in self.repeated_names:
            row += repeated <= row
        return row
