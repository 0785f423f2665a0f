"""Revs Vehicle Dynamics Database (Kegelman & Gerdes, Stanford Digital Repository).

Layouts: ``csv``, the official one, a file a recording; ``text``, a folder a recording and a text
file a channel, as re-laid by Leanza, Reina & Blanco-Claraco 2021.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from vehest.constants import FloatArray
from vehest.data.channels import channel
from vehest.data.errors import DataError, MissingError
from vehest.data.recording import Recording
from vehest.sources.base import existing_folder, require_files
from vehest.sources.clocks import ClockPolicy, uniform_clock
from vehest.sources.columns import ChannelMap, ChannelNames, column_from_config
from vehest.sources.file_source import FileSource
from vehest.sources.revs.csv_layout import read_csv, read_vehicle_parameters
from vehest.sources.tables import TextLayout, read_columns
from vehest.sources.unit_spellings import require_unit

SUFFIXES = {"csv": ".csv", "text": ""}  # layout -> ending of a recording's file


@dataclass(frozen=True)
class RevsOptions:
    """Options of the source; docs/sources/revs.md describes them."""

    layout: Literal["csv", "text"]  # layout of the files
    path: str | None = None  # folder of the recordings
    # names of the recordings; None: those whose files match ``files``
    recordings: tuple[str, ...] | None = None
    files: str | None = None  # pattern of the files
    vehicle_parameters: str | None = None  # name of the table of vehicle parameters
    time: dict[str, Any] | None = None  # declaration of the column of times
    channels: ChannelMap | None = None  # channel -> its column and unit
    clock: ClockPolicy = "strict"  # treatment of uneven time stamps
    gappy: ChannelNames | None = None  # channels that may have gaps
    # number of lines about the drive above the names
    preamble_lines: Annotated[int, Field(ge=0, le=100)] = 10
    # whether the units of the file are compared with the declared ones
    units_row: Literal["check", "ignore"] = "check"


class RevsSource(FileSource):
    """Recordings of the Revs database."""

    options_type = RevsOptions

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        super().__init__(dataset)
        options = self.options
        self.columns = self._declared(options.channels)
        self.time = column_from_config(options.time, f"{self.location}: time", "s")
        strict = {column.column for name, column in self.columns.items() if name not in self.gappy}
        self.column_names = list(dict.fromkeys(column.column for column in self.columns.values()))
        self.gappy_columns = set(self.column_names) - strict

    def ids(self) -> list[str]:
        """Recordings that the data set names, or else those whose files match ``files``, in
        alphabetical order.

        Raises
        ------
        MissingError
            The folder is not there, or nothing in it matches.
        """
        suffix = SUFFIXES[self.options.layout]
        if self.options.recordings is not None:
            return [name.removesuffix(suffix) for name in self.options.recordings]
        pattern = f"{self.options.files or '*'}{suffix}"
        names = [
            path.name.removesuffix(suffix)
            for path in sorted(self._folder().glob(pattern))
            if path.is_dir() == (not suffix) and path.name != self.options.vehicle_parameters
        ]
        if not names:
            raise MissingError(
                f"{self.location}: nothing in '{self._folder()}' matches '{pattern}'"
            )
        return names

    def inputs(self) -> dict[str, str | Path]:
        """Every file that is read."""
        folder = self._folder()
        files: dict[str, str | Path] = {
            file.relative_to(folder).as_posix(): file
            for name in self.ids()
            for file in self._files_of(name).values()
        }
        if parameters := self._parameters_file():
            files[parameters.name] = parameters
        return files

    def file_names(self) -> list[str]:
        """Files of the named recordings in the official layout, and the table of vehicle
        parameters.
        """
        suffix = SUFFIXES[self.options.layout]
        if not suffix or self.options.recordings is None:
            return []
        parameters = self.options.vehicle_parameters
        return [f"{name}{suffix}" for name in self.ids()] + (
            [str(parameters)] if parameters else []
        )

    def read_raw(self, recording_id: str) -> Recording:
        """Read one recording by its name, without transforms.

        Provenance has the layout, the lines above the table and the vehicle's parameters, where
        there are any.

        Raises
        ------
        MissingError
            A file is not there.
        DataError
            A table is damaged, lacks a column, contradicts a declared unit, or its clock is not as
            the option ``clock`` wants it.
        """
        files = self._files_of(recording_id)
        path = self._path(recording_id)
        options = self.options
        samples, origin = (
            self._read_csv(path) if options.layout == "csv" else (self._read_text(files), {})
        )
        clock = uniform_clock(
            self.time.to_si(samples[self.time.column], "s"), f"'{path}'", options.clock
        )
        channels = {
            name: column.to_si(
                clock.align(samples[column.column], column.column in self.gappy_columns),
                channel(name).unit,
            )
            for name, column in self.columns.items()
        }
        provenance = {"layout": options.layout, **origin}
        if parameters := self._parameters_file():
            provenance["vehicle_parameters"] = read_vehicle_parameters(parameters)
        return self._recording(recording_id, f"'{path}'", clock, channels, provenance)

    def _read_csv(self, file: Path) -> tuple[dict[str, FloatArray], dict[str, Any]]:
        """Columns of the official layout, whose units are compared unless ``units_row`` is
        ``ignore``.
        """
        columns = list(dict.fromkeys([self.time.column, *self.column_names]))
        values, units, about = read_csv(
            file, columns, self.gappy_columns, self.options.preamble_lines
        )
        if self.options.units_row == "check":
            for name, column in self.columns.items():
                location = f"'{file}': column '{column.column}'"
                unit = channel(name).unit
                require_unit(units[column.column], column, unit, location, "set units_row: ignore")
        return values, about

    def _read_text(self, files: Mapping[str, Path]) -> dict[str, FloatArray]:
        """Columns of text files with a number a line."""
        values = {
            name: read_columns(file, ["number"], TextLayout(names=("number",)))["number"]
            for name, file in files.items()
        }
        n_stamps = len(values[self.time.column])
        for name, samples in values.items():
            if len(samples) != n_stamps:
                raise DataError(
                    f"'{files[name]}' holds {len(samples)} samples, the time file {n_stamps}; the "
                    "copy is incomplete"
                )
        return values

    def _folder(self) -> Path:
        """Folder of the recordings; raises an error where it is not there."""
        return existing_folder(self.dataset.get("path"), self.name)

    def _path(self, recording_id: str) -> Path:
        """File of a recording in the official layout, its folder in the layout of text files."""
        return self._folder() / f"{recording_id}{SUFFIXES[self.options.layout]}"

    def _files_of(self, recording_id: str) -> dict[str, Path]:
        """The file of a recording; of the text layout column -> its file."""
        path = self._path(recording_id)
        files = {path.name: path}
        if self.options.layout == "text":
            existing_folder(path, self.name)
            files = {
                column: path / f"{column}.txt"
                for column in sorted({self.time.column, *self.column_names})
            }
        require_files(list(files.values()), self.name)
        return files

    def _parameters_file(self) -> Path | None:
        """The table of vehicle parameters, if one is declared and there."""
        name = self.options.vehicle_parameters
        file = self._folder() / str(name)
        return file if name and file.is_file() else None


SOURCE = RevsSource
