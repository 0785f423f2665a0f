"""Columns, clock and runs that a survey finds in a log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from vehest.constants import FloatArray


@dataclass(frozen=True, eq=False)
class RawColumn:
    """A column, signal or field of numbers.

    Args:
        name: for people; unique within its log.
        unit: as the file writes it, empty where it does not.
        values: in that unit, NaN where there is none, (N,).
        place: how a data set's entry of a channel names it, such as ``{"column": "Gyro"}``.
        stamps: its own times [s], (N,); None where the log has one clock for all.
        device: whether the file says that the car measured it, on its bus, or the reference did; empty where it does not.
    """

    name: str
    unit: str
    values: FloatArray
    place: Mapping[str, Any]
    stamps: FloatArray | None = None
    device: Literal["", "car", "reference"] = ""


@dataclass(frozen=True)
class Stamps:
    """A column that looks like a clock.

    Args:
        column: its name.
        unit: of time: ``s``, ``ms``, ``us`` or ``ns``.
        evidence: reasons for it, for people.
        asked: whether the unit is ambiguous.
    """

    column: str
    unit: str
    evidence: str
    asked: bool = False


@dataclass(frozen=True, eq=False)
class Log:
    """Columns of a file.

    Args:
        file: the file, or a bag's folder.
        source: that reads it.
        columns: without its clock.
        options: of the source, such as delimiter and decimal mark.
        clock: column of its times; None where there is none, or where the format has times of its own.
        seconds: times of the rows [s], (N,), from the clock; None where columns have their own or there is no clock.
        runs: rows of each uninterrupted run, the longest first; one of all where times never restart.
        skipped: parts that were not read, with the reason.
    """

    file: Path
    source: str
    columns: tuple[RawColumn, ...]
    options: Mapping[str, Any] = field(default_factory=dict)
    clock: Stamps | None = None
    seconds: FloatArray | None = None
    runs: tuple[slice, ...] = ()
    skipped: tuple[str, ...] = ()

    @property
    def has_clock(self) -> bool:
        """Whether its samples have times."""
        return self.seconds is not None or any(column.stamps is not None for column in self.columns)
