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
from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.recording import Recording
from vehest.sources.base import Source, existing_folder, require_files
from vehest.sources.clocks import ClockPolicy, uniform_clock
from vehest.sources.columns import ChannelMap, ChannelNames, columns_from_config, time_column_from_config
from vehest.sources.revs.csv_layout import read_csv_columns, read_csv_head
from vehest.sources.revs.mat_layout import read_mat_columns
from vehest.sources.revs.parameters import read_vehicle_parameters
from vehest.sources.revs.text_layout import read_text_columns, text_file
from vehest.sources.unit_spellings import require_unit

SUFFIXES = {"csv": ".csv", "mat": ".mat", "text": ""}
PREAMBLE_LINES = 10


@dataclass(frozen=True)
class RevsOptions:
    """Options of the source, by type; what is None is not said."""

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


class RevsSource(Source):
    """Recordings of the Revs database.

    Options: ``path`` (folder), ``layout``, ``recordings`` or ``files`` (glob), ``vehicle_parameters`` (file), ``time``, ``channels`` and
    ``extra_channels`` (columns, units, signs), ``clock``, ``gappy``, ``preamble_lines`` and ``units_row`` (csv), ``rate_hz`` (mat).
    """

    options_type = RevsOptions
    keys = frozenset(
        {"path", "layout", "recordings", "files", "vehicle_parameters", "time", "channels", "extra_channels"}
        | {"clock", "gappy", "preamble_lines", "units_row", "rate_hz"}
    )

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        super().__init__(dataset)
        self.layout = str(dataset["layout"])
        extra = dataset.get("extra_channels") or {}
        if set(extra) - set(SUFFIXES):
            raise ConfigurationError(f"data set '{self.name}': extra_channels must map a layout to channels, not {extra}")
        self.columns = columns_from_config(dataset.get("channels") or {}, self.name)
        self.columns |= columns_from_config(extra.get(self.layout) or {}, self.name)
        if not self.columns:
            raise ConfigurationError(f"data set '{self.name}': channels must map a channel to its column and unit")
        self.time = time_column_from_config(dataset.get("time"), self.name)
        self._require_options()
        self.gappy = frozenset(dataset.get("gappy") or [])

    def ids(self) -> list[str]:
        """The recordings that the data set names, or else those whose files match ``files``, in alphabetical order.

        Raises:
            MissingError: it names none and no file is there.
        """
        suffix = SUFFIXES[self.layout]
        named = self.dataset.get("recordings")
        if named is not None:
            return [str(name).removesuffix(suffix) for name in named]
        pattern = f"{self.dataset.get('files') or '*'}{suffix}"
        found = [path for path in sorted(self._folder().glob(pattern)) if (path.is_file() if suffix else path.is_dir())]
        names = [path.name.removesuffix(suffix) for path in found if path.name != self.dataset.get("vehicle_parameters")]
        if not names:
            raise MissingError(f"data set '{self.name}': nothing in '{self._folder()}' matches '{pattern}'")
        return names

    def inputs(self) -> dict[str, str | Path]:
        """Every file that is read."""
        folder = self._folder()
        files = {file.relative_to(folder).as_posix(): file for name in self.ids() for file in self._files(name)}
        parameters = self._parameters_file()
        return dict(files) if parameters is None else {**files, parameters.name: parameters}

    def file_names(self) -> list[str]:
        """Files of the named recordings in the official layouts, and the table of vehicle parameters."""
        suffix = SUFFIXES[self.layout]
        if not suffix or self.dataset.get("recordings") is None:
            return []
        parameters = self.dataset.get("vehicle_parameters")
        return [f"{name}{suffix}" for name in self.ids()] + ([str(parameters)] if parameters else [])

    def read_raw(self, recording_id: str) -> Recording:
        """Read one recording by its name."""
        self._files(recording_id)
        reading = {"csv": self._read_csv, "mat": self._read_mat, "text": self._read_text}
        start_time, rate_hz, values, origin = reading[self.layout](recording_id)
        channels = {name: column.to_si(values[column.column], channel(name).unit) for name, column in self.columns.items()}
        del values
        provenance = {"dataset": self.name, "source": "revs", "layout": self.layout, **origin}
        parameters = self._parameters_file()
        if parameters is not None:
            provenance["vehicle_parameters"] = read_vehicle_parameters(parameters)
        try:
            return Recording(
                id=recording_id,
                vehicle=str(self.dataset.get("vehicle", "unknown")),
                rate_hz=rate_hz,
                start_time=start_time,
                channels=channels,
                kind=self.kind,
                gappy=self.gappy,
                provenance=provenance,
            )
        except DataError as error:
            raise DataError(f"'{self._path(recording_id)}': {error}") from None

    def _read_csv(self, recording_id: str) -> tuple[float, float, dict[str, FloatArray], dict[str, Any]]:
        file, columns = self._path(recording_id), self._column_names()
        head = read_csv_head(file, [self.time.column, *columns], int(self.dataset.get("preamble_lines", PREAMBLE_LINES)))
        if self.dataset.get("units_row", "check") == "check":
            for name, column in self.columns.items():
                where = f"'{file}': column '{column.column}'"
                require_unit(head.unit_of(column.column), column, channel(name).unit, where, "set units_row: ignore")
        values, dropped = read_csv_columns(file, head, self.time.column, columns, self._gappy_columns())
        stamps, policy = self.time.to_si(values[self.time.column], "s"), self.dataset.get("clock", "strict")
        clock = uniform_clock(stamps, f"'{file}'", policy)
        aligned = {name: clock.align(values[name], name in self._gappy_columns()) for name in columns}
        origin = {"file": file.name, "preamble": list(head.preamble), "rows_dropped_at_the_head": dropped}
        return clock.start_time, clock.rate_hz, aligned, origin

    def _read_mat(self, recording_id: str) -> tuple[float, float, dict[str, FloatArray], dict[str, Any]]:
        file = self._path(recording_id)
        policy, rate = self.dataset.get("clock", "strict"), self.dataset.get("rate_hz")
        aligned = read_mat_columns(file, self._column_names(), self.time, rate, policy, self._gappy_columns())
        return aligned.start_time, aligned.rate_hz, aligned.values, {"file": file.name, "native_rates_hz": aligned.native_rates_hz}

    def _read_text(self, recording_id: str) -> tuple[float, float, dict[str, FloatArray], dict[str, Any]]:
        folder, columns = self._path(recording_id), self._column_names()
        values = read_text_columns(folder, columns, self.time.column)
        where = f"'{text_file(folder, self.time.column)}'"
        stamps, policy = self.time.to_si(values[self.time.column], "s"), self.dataset.get("clock", "strict")
        clock = uniform_clock(stamps, where, policy)
        aligned = {name: clock.align(values[name], name in self._gappy_columns()) for name in columns}
        return clock.start_time, clock.rate_hz, aligned, {}

    def _column_names(self) -> list[str]:
        return list(dict.fromkeys(column.column for column in self.columns.values()))

    def _gappy_columns(self) -> set[str]:
        """Columns that gappy channels alone are made of."""
        strict = {column.column for name, column in self.columns.items() if name not in self.gappy}
        return {self.columns[name].column for name in self.gappy} - strict

    def _folder(self) -> Path:
        return existing_folder(self.dataset.get("path"), self.name)

    def _path(self, recording_id: str) -> Path:
        return self._folder() / f"{recording_id}{SUFFIXES[self.layout]}"

    def _files(self, recording_id: str) -> list[Path]:
        path = self._path(recording_id)
        if self.layout == "text":
            existing_folder(path, self.name)
            files = [text_file(path, column) for column in sorted({self.time.column, *self._column_names()})]
        else:
            files = [path]
        require_files(files, self.name)
        return files

    def _parameters_file(self) -> Path | None:
        """The table of vehicle parameters, if one is declared and there."""
        name = self.dataset.get("vehicle_parameters")
        file = self._folder() / str(name)
        return file if name and file.is_file() else None

    def _require_options(self) -> None:
        where = f"data set '{self.name}'"
        unknown = sorted(set(self.dataset.get("gappy") or []) - set(self.columns))
        if unknown:
            raise ConfigurationError(f"{where}: gappy names '{unknown[0]}', which is not one of its channels")
        rate, lines = self.dataset.get("rate_hz"), self.dataset.get("preamble_lines", PREAMBLE_LINES)
        if rate is not None and self.layout != "mat":
            raise ConfigurationError(f"{where}: rate_hz is an option of layout mat; 'vehest downsample' brings others to another rate")
        if rate is not None and not rate > 0:
            raise ConfigurationError(f"{where}: rate_hz must be a positive number, not {rate}")
        if not 0 <= lines <= 100:
            raise ConfigurationError(f"{where}: preamble_lines must be a whole number up to 100, not {lines}")


SOURCE = RevsSource
