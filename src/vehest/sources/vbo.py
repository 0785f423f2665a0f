"""Logs of Racelogic VBOX (.vbo): text in Latin-1, in sections; a recording a file, or one for each
part between pauses.

The format as its files have it: ``[header]`` and ``[column names]`` name the columns, ``[channel
units]`` the units of the last of them, ``[comments]`` hold the logger's settings, ``[data]`` rows
of numbers, whose time is a clock time, hhmmss.ss.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from vehest.alignment.motion import rms
from vehest.constants import FloatArray
from vehest.data.channels import channel
from vehest.data.errors import DataError, printable
from vehest.data.files import regular_file
from vehest.data.recording import Recording
from vehest.data.units import factor_to_si
from vehest.sources.base import require_files
from vehest.sources.clock_times import past_midnight
from vehest.sources.clocks import ClockPolicy, bridged, uniform_clock
from vehest.sources.columns import (
    ChannelMap,
    ChannelNames,
    Positive,
    SampledColumn,
    names_read,
)
from vehest.sources.file_source import FileSource
from vehest.sources.table_rows import timed_runs
from vehest.sources.tables import TextLayout, read_columns, require_columns
from vehest.sources.unit_spellings import plain_unit, require_unit

LONGEST_HEAD = 1 << 20  # largest number of bytes before the rows
# column -> unit, where the file states none
UNITS = {
    "velocity": "km/h",
    "vert-vel": "km/h",
    "Longacc": "g",
    "Latacc": "g",
}
# matches lines of [header] that state the unit of the logger's own speeds
SPEED_IN_HEADER = re.compile(r"(?mi)^(vertical )?velocity[ \t(\[]+([^\s()\[\]]+)[ \t)\]]*$")
MAX_SATS = 255.0  # largest value of sats, which has eight bits; larger ones are clipped to this
SATELLITES = 63  # bits of sats that count satellites; others mark a trigger and a differential fix
# matches columns that are measured by satellites; they are 0 where there are none
OF_SATELLITES = re.compile(
    r"lat|long|velocity|heading|height|vert-vel|Longacc|Latacc|True_Head|Slip_\w+|L(at|ng)\._Vel\."
)
JUMP = 1.5  # longest step to a last row, in intervals; a row that comes later is left out
# slower or straighter samples do not show whether the logger's slip offsets changed places
# m/s, lowest speed of samples that show whether the logger's slip offsets changed places
MIN_TURNING_SPEED = 5.0
MIN_TURNING_YAW_RATE = 0.05  # rad/s, smallest yaw rate of these samples
# smallest number of these samples; with fewer the slip angles are not checked
MIN_TURNING_SAMPLES = 100
# smallest difference of the slip angles over that which the yaw rate makes between the axles
MIN_DIFFERENCE_SHARE = 0.25
SLIP_CHECK = "slip_offsets"  # name of this check, by which a data set accepts its finding
# matches columns of slip at entered points; Slip_Angle, Lat._Vel. and Lng._Vel. are those at the
# antenna
SLIP_AT_A_POINT = re.compile(r"Slip_(COG|[FR][LR])")
# matches a line of offsets: point, lateral and longitudinal distance
OFFSETS = re.compile(
    r"Offsets Slip \((\w+)\)\s*:\s*\{\s*([-+]?\d+(?:\.\d*)?)\s+([-+]?\d+(?:\.\d*)?)\s*\}"
)


@dataclass(frozen=True)
class VboOptions:
    """Options of the source; docs/sources/vbo.md describes them."""

    channels: ChannelMap  # channel -> its column and unit
    path: str | None = None  # folder of the logs
    files: str = "*.[vV][bB][oO]"  # pattern of the logs
    max_gap: Positive | None = None  # longest pause within a recording [s]
    run: Annotated[int, Field(ge=0)] | None = None  # number of the one part that is read
    clock: ClockPolicy = "strict"  # treatment of uneven time stamps
    gappy: ChannelNames | None = None  # channels that may have gaps


@dataclass(frozen=True)
class Log:
    """Columns and settings of a log."""

    columns: Mapping[str, FloatArray]  # name -> values in the file's unit, (T,)
    units: Mapping[str, str]  # name -> unit as the file writes it; only of columns that have one
    seconds: FloatArray  # clock time since midnight, going on past it [s], (T,)
    # column -> module of the logger that it comes from; only of columns that have one
    modules: Mapping[str, str]
    # point, such as FL -> lateral and longitudinal distance from the antenna [m]
    offsets: Mapping[str, tuple[float, float]]
    provenance: Mapping[str, Any]  # first line, offsets, and numbers of rows that were left out


class VboSource(FileSource):
    """Logs of a VBOX, a recording each, or one for each part between pauses."""

    options_type = VboOptions

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        super().__init__(dataset)
        self.columns = self._declared(self.options.channels, SampledColumn)
        self._require_pattern()
        self._log = lru_cache(1)(read_log)

    def runs_in(self, file: Path) -> Mapping[int | None, slice]:
        """Rows between pauses."""
        require_files([file], self.name)
        max_gap = self.options.max_gap
        if max_gap is None:
            return super().runs_in(file)
        log = self._log(file)
        require_columns(file, list(log.columns), names_read(self.columns))
        columns = (
            column.measured(file, log.columns)
            for name, column in self.columns.items()
            if name not in self.gappy
        )
        return timed_runs(log.seconds, max_gap, restarts=False, columns=columns)

    def _read(self, file: Path, run: int | None) -> Recording:
        """Read a log.

        Raises
        ------
        MissingError
            There is no such file.
        DataError
            It is damaged, lacks a column, contradicts a declared unit, or its clock or the offsets
            of its slip angles are wrong.
        """
        log = self._log(file)
        rows = self._runs_of(file)[run]
        number = {} if run is None else {"run": run}
        used_columns = names_read(self.columns)
        require_columns(file, list(log.columns), used_columns)
        if any(map(SLIP_AT_A_POINT.fullmatch, used_columns)) and SLIP_CHECK not in (
            self.dataset.get("accept") or []
        ):
            require_slip_offsets(log, f"'{file}'")
        clock = uniform_clock(log.seconds[rows], f"'{file}'", self.options.clock)
        channels = {}
        for name, column in self.columns.items():
            unit = channel(name).unit
            location = f"'{file}': column '{column.column}', for channel '{name}',"
            require_unit(
                log.units.get(column.column, ""), column, unit, location, "declare a factor"
            )
            samples = column.measured(file, log.columns)[rows]
            if self.options.max_gap is not None and name not in self.gappy:
                samples = bridged(samples, log.seconds[rows], self.options.max_gap)
            channels[name] = clock.align(column.to_si(samples, unit), gappy=name in self.gappy)
        provenance = {"file": file.name, **number, **log.provenance}
        return self._recording(self._name_of(file, run), f"'{file}'", clock, channels, provenance)


def read_log(file: Path) -> Log:
    """Everything in a log.

    A last row that is cut off, or comes more than half an interval late, as loggers write when they
    are stopped, is left out, and so are rows whose time repeats that of the row before.

    Raises
    ------
    MissingError
        There is no such file.
    DataError
        It has no section of rows, is damaged, or holds more than the limits allow.
    """
    content = regular_file(file).read_bytes()
    mark = re.compile(rb"^\[data\]\s*$", re.MULTILINE).search(content, 0, LONGEST_HEAD)
    if mark is None:
        raise DataError(f"'{file}' has no section [data]; is it a log of a VBOX?")
    head = content[: mark.start()]
    rows = content[mark.end() :].replace(b",", b".")  # blanks separate the columns
    lines = "\n".join(head.decode("latin-1").splitlines())
    first, *parts = re.split(r"^\[([^\]\n]+)\]\s*?$", lines, flags=re.MULTILINE)
    sections = {
        title.strip().lower(): text for title, text in zip(parts[::2], parts[1::2], strict=True)
    }
    names = sections.get("column names", "").split()
    if not names:
        raise DataError(
            f"'{file}' has no section [column names]; write one above [data], with the names of "
            "the columns in one line, such as: sats time lat long velocity"
        )
    text = re.sub(rb" ?\r?\n ?", b"\n", re.sub(rb"[ \t]+", b" ", rows.strip()))
    last = text.rfind(b"\n") + 1
    cut_off = last > 0 and text.count(b" ", last) < len(names) - 1
    columns = read_columns(
        file,
        list(dict.fromkeys(["time", *names])),
        TextLayout(delimiter=" ", names=tuple(names)),
        text=text[:last] if cut_off else text,
    )
    seconds = _seconds(columns.pop("time"), file)
    columns = _without_lost_fixes(columns)
    late = len(seconds) > 2 and bool(seconds[-1] - seconds[-2] > JUMP * np.median(np.diff(seconds)))
    is_repeated = np.r_[False, np.diff(seconds) == 0.0]
    is_used = ~is_repeated
    is_used[-1] &= not late
    if not is_used.all():
        columns = {name: samples[is_used] for name, samples in columns.items()}
        seconds = seconds[is_used]

    units, modules = (
        _of_last_columns(names, sections.get(title, ""))
        for title in ("channel units", "module information")
    )
    speeds = {
        "vert-vel" if vertical else "velocity": unit
        for vertical, written in SPEED_IN_HEADER.findall(sections.get("header", ""))
        if (unit := plain_unit(written)) is not None
    }
    offsets = {
        point: (float(lateral), float(longitudinal))
        for point, lateral, longitudinal in OFFSETS.findall(sections.get("comments", ""))
    }
    provenance = {
        "created": printable(" ".join(first.partition("\n")[0].split()))[:80],
        "slip_offsets_lateral_longitudinal_m": {
            point: list(pair) for point, pair in offsets.items()
        },
        "rows_dropped_at_the_end": cut_off + late,
    }
    if is_repeated.any():
        provenance["rows_dropped_with_repeated_times"] = int(is_repeated.sum())
    return Log(
        columns,
        {name: unit for name, unit in {**UNITS, **speeds, **units}.items() if unit},
        seconds,
        modules,
        offsets,
        provenance,
    )


def _without_lost_fixes(columns: dict[str, FloatArray]) -> dict[str, FloatArray]:
    """The columns with NaN for the zeros that the logger writes where it has no satellites;
    unchanged where it never has any.
    """
    sats = np.nan_to_num(np.clip(columns.get("sats", np.empty(0)), 0.0, MAX_SATS))
    has_fix = sats.astype(int) & SATELLITES > 0
    if not has_fix.any():
        return columns
    return {
        name: np.where(~has_fix & (samples == 0.0), np.nan, samples)
        if OF_SATELLITES.fullmatch(name)
        else samples
        for name, samples in columns.items()
    }


def _of_last_columns(names: Sequence[str], section: str) -> dict[str, str]:
    """Name of a column -> its line of a section that has a line for each of the last columns.

    An empty line for none.
    """
    lines = [line.strip() for line in section.splitlines()[1:]]
    while lines and not lines[-1]:
        lines.pop()
    if len(lines) > len(names):
        return {}
    return dict(zip(names[len(names) - len(lines) :], lines, strict=True))


def require_slip_offsets(log: Log, location: str) -> None:
    """Raise an error unless slip at two wheels of one side differs by what the yaw rate makes
    between the axles.

    The logger computes slip at points whose offsets from the antenna were entered as {lateral,
    longitudinal}. Where the two change places, front and rear wheel of a side have the same
    longitudinal offset, and the same slip. Without these columns and offsets, or with few samples
    in turns, nothing is checked.

    Parameters
    ----------
    log : Log
        The log.
    location : str
        The file, for messages.

    Raises
    ------
    DataError
        In turns the slip angles differ by less than a quarter of that (root mean squares).
    """
    required = ("Slip_FL", "Slip_RL", "YawRate", "velocity")
    if not {"FL", "RL"} <= set(log.offsets) or not set(required) <= set(log.columns):
        return
    front, rear, yaw_rate, speed = (log.columns[name] for name in required)
    yaw_rate = np.radians(yaw_rate)
    speed = factor_to_si(plain_unit(log.units["velocity"]) or "km/h", "m/s") * speed
    turns = (speed > MIN_TURNING_SPEED) & (np.abs(yaw_rate) > MIN_TURNING_YAW_RATE)
    if turns.sum() < MIN_TURNING_SAMPLES:
        return
    axle_distance = abs(log.offsets["FL"][1] - log.offsets["RL"][1])
    expected = rms(np.degrees(axle_distance * yaw_rate[turns] / speed[turns]))
    measured = rms(front[turns] - rear[turns])
    if measured < MIN_DIFFERENCE_SHARE * expected:
        raise DataError(
            f"{location}: slip at the front and the rear left wheel differs by {measured:.2g}° "
            f"(rms) where the yaw rate makes {expected:.2g}°: the offsets of the logger, "
            "{lateral, longitudinal}, changed places, and Slip_COG, Slip_FL … apply to other "
            "points than it says; take Slip_Angle or Lat._Vel., which apply to the antenna, or "
            f"accept: [{SLIP_CHECK}]"
        )


def _seconds(stamps: FloatArray, file: Path) -> FloatArray:
    """Clock times hhmmss.ss as seconds since midnight, going on past it."""
    milliseconds = np.rint(np.where(np.isfinite(stamps), stamps, -1.0) * 1000.0)  # hh mm ss.sss
    hours = milliseconds // 1e7
    minutes = milliseconds // 1e5 % 100.0
    seconds = milliseconds % 1e5 / 1000.0
    odd = np.flatnonzero(
        ~((milliseconds >= 0.0) & (hours < 24.0) & (minutes < 60.0) & (seconds < 60.0))
    )
    if len(odd):
        raise DataError(
            f"'{file}': time {stamps[odd[0]]} in data row {odd[0] + 1} is no clock time hhmmss"
        )
    return past_midnight(3600.0 * hours + 60.0 * minutes + seconds)


SOURCE = VboSource
