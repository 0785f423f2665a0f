"""Revs Vehicle Dynamics Database (Kegelman & Gerdes, Stanford Digital Repository).

Layouts: ``csv`` and ``mat``, the official ones, a file a recording; ``text``, a folder a recording and a text file a channel, as re-laid
by Leanza, Reina & Blanco-Claraco 2021.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from vehest.constants import FloatArray
from vehest.data.channels import channel
from vehest.data.errors import ConfigurationError, MissingError
from vehest.data.recording import Recording
from vehest.sources.base import existing_folder, require_files
from vehest.sources.clocks import Clock, ClockPolicy, uniform_clock
from vehest.sources.columns import ChannelMap, ChannelNames, columns_from_config, time_column_from_config
from vehest.sources.file_source import FileSource
from vehest.sources.revs.csv_layout import read_csv_columns, read_csv_head
from vehest.sources.revs.mat_layout import read_mat_columns
from vehest.sources.revs.parameters import read_vehicle_parameters
from vehest.sources.revs.text_layout import read_text_columns, text_file
from vehest.sources.unit_spellings import require_unit

SUFFIXES = {"csv": ".csv", "mat": ".mat", "text": ""}


@dataclass(frozen=True)
class RevsOptions:
    """Options of the source; docs/sources/revs.md describes them."""

    layout: Literal["csv", "mat", "text"]
    path: str | None = None
    recordings: tuple[str, ...] | None = None
    files: str | None = None
    vehicle_parameters: str | None = None
    time: dict[str, Any] | None = None
    channels: ChannelMap | None = None
    extra_channels: dict[str, dict[str, Any] | None] | None = None
    clock: ClockPolicy = "strict"
    gappy: ChannelNames | None = None
    preamble_lines: int = 10
    units_row: Literal["check", "ignore"] = "check"
    rate_hz: float | None = None


class RevsSource(FileSource):
    """Recordings of the Revs database."""

    options_type = RevsOptions

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        super().__init__(dataset)
        options = self.options
        extra = options.extra_channels or {}
        if set(extra) - set(SUFFIXES):
            raise ConfigurationError(f"{self.where}: extra_channels must map a layout to channels, not {extra}")
        self.columns = columns_from_config({**(options.channels or {}), **(extra.get(options.layout) or {})}, self.name)
        if not self.columns:
            raise ConfigurationError(f"{self.where}: channels must map a channel to its column and unit")
        self.time = time_column_from_config(options.time, self.name)
        self.gappy = self._gappy_among(self.columns)
        if options.rate_hz is not None and options.layout != "mat":
            raise ConfigurationError(f"{self.where}: rate_hz is an option of layout mat; 'vehest downsample' brings others to another rate")
        if options.rate_hz is not None and not options.rate_hz > 0:
            raise ConfigurationError(f"{self.where}: rate_hz must be a positive number, not {options.rate_hz}")
        if not 0 <= options.preamble_lines <= 100:
            raise ConfigurationError(f"{self.where}: preamble_lines must be a whole number up to 100, not {options.preamble_lines}")

    def ids(self) -> list[str]:
        """The recordings that the data set names, or else those whose files match ``files``, in alphabetical order.

        Raises:
            MissingError: it names none and no file is there.
        """
        suffix = SUFFIXES[self.options.layout]
        named = self.options.recordings
        if named is not None:
            return [str(name).removesuffix(suffix) for name in named]
        pattern = f"{self.options.files or '*'}{suffix}"
        found = [path for path in sorted(self._folder().glob(pattern)) if (path.is_file() if suffix else path.is_dir())]
        names = [path.name.removesuffix(suffix) for path in found if path.name != self.options.vehicle_parameters]
        if not names:
            raise MissingError(f"{self.where}: nothing in '{self._folder()}' matches '{pattern}'")
        return names

    def inputs(self) -> dict[str, str | Path]:
        """Every file that is read."""
        folder = self._folder()
        files = {file.relative_to(folder).as_posix(): file for name in self.ids() for file in self._files_of(name)}
        parameters = self._parameters_file()
        return dict(files) if parameters is None else {**files, parameters.name: parameters}

    def file_names(self) -> list[str]:
        """Files of the named recordings in the official layouts, and the table of vehicle parameters."""
        suffix = SUFFIXES[self.options.layout]
        if not suffix or self.options.recordings is None:
            return []
        parameters = self.options.vehicle_parameters
        return [f"{name}{suffix}" for name in self.ids()] + ([str(parameters)] if parameters else [])

    def read_raw(self, recording_id: str) -> Recording:
        """Read one recording by its name."""
        self._files_of(recording_id)
        reading = {"csv": self._read_csv, "mat": self._read_mat, "text": self._read_text}
        clock, values, origin = reading[self.options.layout](recording_id)
        channels = {name: column.to_si(values[column.column], channel(name).unit) for name, column in self.columns.items()}
        del values
        provenance = {"layout": self.options.layout, **origin}
        parameters = self._parameters_file()
        if parameters is not None:
            provenance["vehicle_parameters"] = read_vehicle_parameters(parameters)
        return self._recording(recording_id, f"'{self._path(recording_id)}'", clock, channels, provenance)

    def _read_csv(self, recording_id: str) -> tuple[Clock, dict[str, FloatArray], dict[str, Any]]:
        file, columns = self._path(recording_id), self._column_names()
        head = read_csv_head(file, [self.time.column, *columns], self.options.preamble_lines)
        if self.options.units_row == "check":
            for name, column in self.columns.items():
                where = f"'{file}': column '{column.column}'"
                require_unit(head.unit_of(column.column), column, channel(name).unit, where, "set units_row: ignore")
        values, dropped = read_csv_columns(file, head, self.time.column, columns, self._gappy_columns())
        clock, aligned = self._aligned(values, f"'{file}'")
        return clock, aligned, {"file": file.name, "preamble": list(head.preamble), "rows_dropped_at_the_head": dropped}

    def _read_mat(self, recording_id: str) -> tuple[Clock, dict[str, FloatArray], dict[str, Any]]:
        file, options = self._path(recording_id), self.options
        aligned = read_mat_columns(file, self._column_names(), self.time, options.rate_hz, options.clock, self._gappy_columns())
        clock = Clock(aligned.start_time, aligned.rate_hz, len(next(iter(aligned.values.values()))))
        return clock, aligned.values, {"file": file.name, "native_rates_hz": aligned.native_rates_hz}

    def _read_text(self, recording_id: str) -> tuple[Clock, dict[str, FloatArray], dict[str, Any]]:
        folder = self._path(recording_id)
        values = read_text_columns(folder, self._column_names(), self.time.column)
        return *self._aligned(values, f"'{text_file(folder, self.time.column)}'"), {}

    def _aligned(self, values: Mapping[str, FloatArray], where: str) -> tuple[Clock, dict[str, FloatArray]]:
        """Uniform clock of the time column, and the other columns on it."""
        clock = uniform_clock(self.time.to_si(values[self.time.column], "s"), where, self.options.clock)
        return clock, {name: clock.align(values[name], name in self._gappy_columns()) for name in self._column_names()}

    def _column_names(self) -> list[str]:
        return list(dict.fromkeys(column.column for column in self.columns.values()))

    def _gappy_columns(self) -> set[str]:
        """Columns that gappy channels alone are made of."""
        strict = {column.column for name, column in self.columns.items() if name not in self.gappy}
        return {self.columns[name].column for name in self.gappy} - strict

    def _folder(self) -> Path:
        return existing_folder(self.dataset.get("path"), self.name)

    def _path(self, recording_id: str) -> Path:
        return self._folder() / f"{recording_id}{SUFFIXES[self.options.layout]}"

    def _files_of(self, recording_id: str) -> list[Path]:
        path = self._path(recording_id)
        if self.options.layout == "text":
            existing_folder(path, self.name)
            files = [text_file(path, column) for column in sorted({self.time.column, *self._column_names()})]
        else:
            files = [path]
        require_files(files, self.name)
        return files

    def _parameters_file(self) -> Path | None:
        """The table of vehicle parameters, if one is declared and there."""
        name = self.options.vehicle_parameters
        file = self._folder() / str(name)
        return file if name and file.is_file() else None


SOURCE = RevsSource
