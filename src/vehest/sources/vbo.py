"""Logs of Racelogic VBOX (.vbo): text in Latin-1, in sections; a recording a file.

The format as its files have it: ``[header]`` and ``[column names]`` name the columns, ``[channel units]`` the units of the last of them,
``[comments]`` hold the logger's settings, ``[data]`` rows of numbers, whose time is a clock time, hhmmss.ss.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc

from vehest.constants import FloatArray
from vehest.data.channels import channel
from vehest.data.errors import ConfigurationError, DataError, MissingError, printable
from vehest.data.limits import check_limit
from vehest.data.parquet import DAMAGE
from vehest.data.recording import Recording
from vehest.data.text_files import first_line
from vehest.sources.base import Source, matching_files, require_files
from vehest.sources.clocks import ClockPolicy, uniform_clock
from vehest.sources.columns import ChannelMap, ChannelNames, columns_from_config
from vehest.sources.text_tables import check_size
from vehest.sources.unit_spellings import require_unit

LONGEST_HEAD = 1 << 20  # bytes before the rows
DAY, HALF_A_DAY = 86_400.0, 43_200.0  # s
JUMP = 1.5  # intervals by which the last row may come late
KMH = 3.6
FASTEST_STILL, LEAST_TURN = 5.0, 0.05  # m/s, rad/s: below, slip at two wheels says nothing
FEWEST = 100  # samples that turn
LEAST_DIFFERENCE = 0.25  # of the slip angles' difference that the yaw rate makes between the axles
SLIP_CHECK = "slip_offsets"
OFFSETS = re.compile(r"Offsets Slip \((\w+)\)\s*:\s*\{\s*([-+]?[\d.]+)\s+([-+]?[\d.]+)\s*\}")


@dataclass(frozen=True)
class VboOptions:
    """Options of the source, by type; what is None is not said."""

    channels: ChannelMap
    path: str | None = None
    files: str = "*.[vV][bB][oO]"
    clock: ClockPolicy = "strict"
    gappy: ChannelNames | None = None


@dataclass(frozen=True)
class Log:
    """A file's rows and what it says of itself.

    Args:
        columns: name -> values in the file's unit, (T,).
        units: name -> unit as the file writes it; only of columns that have one.
        seconds: clock time since midnight, going on past it [s], (T,).
        offsets: point (``CoG``, ``FL``, …) -> lateral and longitudinal distance from the antenna at which slip is given [m].
        created: what the first line says.
        n_dropped: rows at the end that were cut off or came late.
    """

    columns: Mapping[str, FloatArray]
    units: Mapping[str, str]
    seconds: FloatArray
    offsets: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    created: str = ""
    n_dropped: int = 0


class VboSource(Source):
    """Logs, a recording each.

    Options: ``path`` and ``files`` (glob), ``channels``, ``clock`` (``strict`` or ``interpolate``), ``gappy``.
    """

    options_type = VboOptions
    keys = frozenset({"path", "files", "channels", "clock", "gappy"})

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        super().__init__(dataset)
        self.columns = columns_from_config(dataset["channels"], self.name)
        if not self.columns:
            raise ConfigurationError(f"data set '{self.name}': channels must map a channel to its column and unit")
        for name in dataset.get("gappy") or []:
            if name not in self.columns:
                raise ConfigurationError(f"data set '{self.name}': gappy names '{name}', which is not one of its channels")
        self.gappy = frozenset(dataset.get("gappy") or [])
        pattern = str(dataset.get("files", VboOptions.files))
        if not pattern or Path(pattern).is_absolute():
            raise ConfigurationError(f"data set '{self.name}': files must be a pattern inside path, such as '*.vbo', not '{pattern}'")

    def ids(self) -> list[str]:
        """Stems of the files, in alphabetical order."""
        return [file.stem for file in self._files()]

    def inputs(self) -> dict[str, str | Path]:
        """The logs."""
        return {file.name: file for file in self._files()}

    def read_raw(self, recording_id: str) -> Recording:
        """Read one log by its stem.

        Raises:
            MissingError: there is none of that name.
            DataError: see `read_file`.
        """
        for file in self._files():
            if file.stem == recording_id:
                return self.read_raw_file(file)
        raise MissingError(f"data set '{self.name}' has no recording '{recording_id}' (it has {', '.join(self.ids())})")

    def read_raw_file(self, file: Path) -> Recording:
        """Read a log wherever it is.

        Raises:
            MissingError: it is not there or empty.
            DataError: it is damaged, lacks a column, is in another unit than declared, its clock is uneven, or its slip angles were
                computed with offsets that change places (unless ``accept`` holds ``slip_offsets``).
        """
        require_files([file], self.name)
        log = read_log(file)
        for name, column in self.columns.items():
            if column.column not in log.columns:
                known = ", ".join(log.columns)
                raise DataError(
                    f"'{file}' has no column '{column.column}' (it has {known}); correct the map in conf/dataset/{self.name}.yaml"
                )
            where = f"'{file}': column '{column.column}', for channel '{name}',"
            require_unit(log.units.get(column.column, ""), column, channel(name).unit, where, "declare a factor")
        used = {column.column for column in self.columns.values()}
        if any(name.startswith(("Slip_", "Lat._Vel")) for name in used) and SLIP_CHECK not in (self.dataset.get("accept") or []):
            require_slip_offsets(log, f"'{file}'")
        clock = uniform_clock(log.seconds, f"'{file}'", self.dataset.get("clock", "strict"))
        channels = {
            name: clock.align(column.to_si(log.columns[column.column], channel(name).unit), gappy=name in self.gappy)
            for name, column in self.columns.items()
        }
        offsets = {point: list(pair) for point, pair in log.offsets.items()}
        try:
            return Recording(
                id=file.stem,
                vehicle=str(self.dataset.get("vehicle", "unknown")),
                rate_hz=clock.rate_hz,
                start_time=clock.start_time,
                channels=channels,
                kind=self.kind,
                gappy=self.gappy,
                provenance={
                    "dataset": self.name,
                    "source": "vbo",
                    "file": file.name,
                    "created": log.created,
                    "slip_offsets_lateral_longitudinal_m": offsets,
                    "rows_dropped_at_the_end": log.n_dropped,
                },
            )
        except DataError as error:
            raise DataError(f"'{file}': {error}") from None

    def _files(self) -> list[Path]:
        return matching_files(self.dataset, VboOptions.files)


def read_log(file: Path) -> Log:
    """Everything in a log.

    A last row that is cut off, or comes more than half an interval late, as loggers write when they are stopped, is left out.

    Raises:
        DataError: it is no such file, is damaged, or is more than the limits allow.
    """
    check_size(file, 1)
    content = file.read_bytes()
    head, mark, rows = content.partition(b"[data]")
    if not mark or len(head) > LONGEST_HEAD:
        raise DataError(f"'{file}' has no section [data]; is it a log of a VBOX?")
    sections = _sections(head.decode("latin-1"))
    names = " ".join(sections.get("column names", [])).split()
    if "time" not in names:
        raise DataError(f"'{file}' names no column 'time' under [column names]; is it a log of a VBOX?")
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled:
        raise DataError(f"'{file}' has {names.count(doubled[0])} columns called '{printable(doubled[0])}'; rename all but one")
    check_limit("columns", len(names), f"'{file}' has {len(names)} columns")
    check_size(file, len(names))
    values, n_dropped = _numbers(rows, len(names), file)
    columns = dict(zip(names, values, strict=True))
    seconds = _seconds(columns.pop("time"), file)
    if len(seconds) > 2 and seconds[-1] - seconds[-2] > JUMP * float(np.median(np.diff(seconds))):
        columns, seconds, n_dropped = {name: own[:-1] for name, own in columns.items()}, seconds[:-1], n_dropped + 1
    comments = "\n".join(sections.get("comments", []))
    offsets = {point: (float(lateral), float(longitudinal)) for point, lateral, longitudinal in OFFSETS.findall(comments)}
    created = printable(" ".join(sections.get("", [""])[0].split()))[:80]
    return Log(columns, _units(sections, names), seconds, offsets, created, n_dropped)


def require_slip_offsets(log: Log, where: str) -> None:
    """See that slip at two wheels of one side differs by what the yaw rate makes between the axles.

    The logger computes slip at points whose offsets from the antenna were entered as {lateral, longitudinal}. Where the two change places,
    front and rear wheel of a side have the same longitudinal offset, and the same slip.

    Raises:
        DataError: slip is the same at both though the car turns.
    """
    needed = ("Slip_FL", "Slip_RL", "YawRate", "velocity")
    if not {"FL", "RL"} <= set(log.offsets) or not set(needed) <= set(log.columns):
        return
    front, rear, yaw_rate, speed = (log.columns[name] for name in needed)
    yaw_rate, speed = np.radians(yaw_rate), speed / KMH
    turns = (speed > FASTEST_STILL) & (np.abs(yaw_rate) > LEAST_TURN)
    if turns.sum() < FEWEST:
        return
    apart = abs(log.offsets["FL"][1] - log.offsets["RL"][1])
    expected = float(np.sqrt(np.mean(np.square(np.degrees(apart * yaw_rate[turns] / speed[turns])))))
    found = float(np.sqrt(np.mean(np.square(front[turns] - rear[turns]))))
    if found < LEAST_DIFFERENCE * expected:
        raise DataError(
            f"{where}: slip at the front and the rear left wheel differs by {found:.2g}° (rms) where the yaw rate makes {expected:.2g}°: "
            "the offsets of the logger, {lateral, longitudinal}, changed places, and its slip and lateral velocity hold for other points "
            f"than it says; leave them out, or accept: [{SLIP_CHECK}]"
        )


def _sections(head: str) -> dict[str, list[str]]:
    """Name of each section -> its lines; what comes before the first one has no name."""
    sections: dict[str, list[str]] = {"": []}
    lines = sections[""]
    for line in head.splitlines():
        title = re.fullmatch(r"\[([^\]]+)\]\s*", line)
        if title:
            lines = sections.setdefault(title[1].strip().lower(), [])
        else:
            lines.append(line)
    return sections


def _units(sections: Mapping[str, list[str]], names: list[str]) -> dict[str, str]:
    """Units of the last columns, an empty line for one without; an empty line ends the section."""
    lines = [line.strip() for line in sections.get("channel units", [])]
    if lines and not lines[-1]:
        lines.pop()
    known = {"velocity": "km/h", "vert-vel": "km/h"} | ({"Longacc": "g", "Latacc": "g"})
    own = dict(zip(names[-len(lines) :], lines, strict=False)) if 0 < len(lines) <= len(names) else {}
    return {name: unit for name, unit in {**known, **own}.items() if unit}


def _numbers(rows: bytes, n_columns: int, file: Path) -> tuple[list[FloatArray], int]:
    """Columns of numbers, (T,) each, and how many rows at the end were cut off."""
    text = re.sub(rb"[ \t]+", b" ", rows.strip())
    text = re.sub(rb" ?\r?\n ?", b"\n", text)
    text = re.sub(rb"(^|[ \n])\+", rb"\1", text)  # pyarrow takes no plus sign
    if not text:
        raise DataError(f"'{file}' has no rows under [data]")
    last = text.rfind(b"\n") + 1
    cut_off = last > 0 and text.count(b" ", last) < n_columns - 1
    names = [str(number) for number in range(n_columns)]
    try:
        table = pc.read_csv(
            io.BytesIO(text[:last] if cut_off else text),
            pc.ReadOptions(column_names=names, encoding="latin-1"),
            pc.ParseOptions(delimiter=" "),
            pc.ConvertOptions(column_types=dict.fromkeys(names, pa.float64())),
        )
    except DAMAGE as error:
        raise DataError(
            f"'{file}' cannot be read as rows of {n_columns} numbers under [data] ({first_line(error)}); is it damaged?"
        ) from None
    return [table.column(name).to_numpy() for name in names], int(cut_off)


def _seconds(stamps: FloatArray, file: Path) -> FloatArray:
    """Clock times hhmmss.ss as seconds since midnight, going on past it."""
    milliseconds = np.rint(np.where(np.isfinite(stamps), stamps, -1.0) * 1000.0)  # hh mm ss.sss
    hours, minutes, seconds = milliseconds // 1e7, milliseconds // 1e5 % 100.0, milliseconds % 1e5 / 1000.0
    odd = np.flatnonzero(~((milliseconds >= 0.0) & (hours < 24.0) & (minutes < 60.0) & (seconds < 60.0)))
    if len(odd):
        raise DataError(f"'{file}': time {stamps[odd[0]]} in data row {odd[0] + 1} is no clock time hhmmss")
    since_midnight = 3600.0 * hours + 60.0 * minutes + seconds
    return since_midnight + DAY * np.concatenate([[0], np.cumsum(np.diff(since_midnight) < -HALF_A_DAY)])


SOURCE = VboSource
