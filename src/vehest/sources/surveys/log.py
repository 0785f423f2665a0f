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
    """A column, signal or field of numbers."""

    name: str  # for people; unique within its log
    unit: str  # as the file writes it, empty where it does not
    values: FloatArray  # in that unit, NaN where there is none, (N,)
    place: Mapping[
        str, Any
    ]  # how a data set's entry of a channel names it, such as ``{"column": "Gyro"}``
    stamps: FloatArray | None = (
        None  # its own times [s], (N,); None where the log has one clock for all
    )
    # whether the file says that the car measured it, on its bus, or the reference did; empty where
    # it does not
    device: Literal["", "car", "reference"] = ""
    # scale and offset of raw values, by which a data set of a bus declares those that mean nothing
    scaling: tuple[float, float] | None = None

    def written(self, value: float) -> float:
        """A value as a data set declares it: as it stands in the file, whole where it is raw."""
        if self.scaling is None:
            return value
        scale, offset = self.scaling
        return round((value - offset) / scale)


@dataclass(frozen=True)
class Stamps:
    """A column that looks like a clock."""

    column: str  # its name
    unit: str  # of time, such as ``s``, ``ms``, ``us`` or ``ns``
    evidence: str  # reasons for it, for people
    asked: bool = False  # whether the unit is ambiguous
    is_stated: bool = False  # whether the header has a unit of time
    repair: Mapping[str, Any] = field(default_factory=dict)  # options that put times in order


@dataclass(frozen=True, eq=False)
class Log:
    """Columns of a file."""

    file: Path  # the file, or a bag's folder
    source: str  # that reads it
    columns: tuple[RawColumn, ...]  # without its clock
    options: Mapping[str, Any] = field(
        default_factory=dict
    )  # of the source, such as delimiter and decimal mark
    clock: Stamps | None = (
        # column of its times; None where there is none, or where the format has times of its own
        None
    )
    seconds: FloatArray | None = (
        # times of the rows [s], (N,), from the clock; None where columns have their own or there is
        # no clock
        None
    )
    runs: tuple[
        slice, ...
        # rows of each uninterrupted run, the longest first; one of all where times never restart
    ] = ()
    skipped: tuple[str, ...] = ()  # parts that were not read, with the reason
    repeated_names: tuple[int, ...] = ()  # rows of texts, from 1, which are in no column
    rate_hz: float | None = None  # of the rows, where the file states it beside their times
    rate_source: str = ""  # that states it, for people

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
