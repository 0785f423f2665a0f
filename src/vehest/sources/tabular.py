"""Source of tables (CSV, Parquet, MAT-files) with a column a channel.

Names, units and signs are declared in conf/dataset.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, cast

from pydantic import AfterValidator, Field

from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS, channel
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import MISSING, PART, Recording
from vehest.data.store import is_stored_recording, read_recording
from vehest.sources.base import open_source, require_files
from vehest.sources.clocks import Clock, ClockPolicy, bridged, uniform_clock
from vehest.sources.columns import (
    ChannelMap,
    ChannelNames,
    Column,
    ColumnName,
    Positive,
    RunNumber,
    SampledColumn,
    column_from_config,
    columns_from_config,
    measured_columns,
    names_read,
)
from vehest.sources.file_source import FileSource
from vehest.sources.sample_and_hold import sample_and_hold_from_config
from vehest.sources.table_parts import even_parts, is_large
from vehest.sources.table_pose import table_pose_from_config
from vehest.sources.table_rows import (
    Runs,
    TimeColumn,
    counted_runs,
    dropped_rows_from_config,
    remaining_files,
    remaining_rows,
    timed_runs,
)
from vehest.sources.tables import (
    TextLayout,
    column_names,
    cut_end,
    listed,
    read_columns,
)


def _encoding(name: str) -> str:
    """An encoding's name; raises `ValueError` for one that Python does not know."""
    try:
        "0,1".encode(name).decode(name)  # which codecs that are none of text refuse
    except (LookupError, ValueError):
        raise ValueError(f"'{name}' is not known; use for example utf8 or latin-1") from None
    return name


Character = Annotated[str, Field(min_length=1, max_length=1)]  # a single character


@dataclass(frozen=True)
class TabularOptions:
    """Options of the source; docs/sources/tabular.md describes them."""

    path: str | None = None  # folder of the tables
    files: str = "*.csv"  # pattern of the tables
    # patterns of the stems of tables that are left out
    exclude: Annotated[tuple[str, ...], "a list of patterns over the files' stems"] | None = None
    # stem of a table -> rows that are left out
    drop_rows: (
        Annotated[
            dict[str, tuple[int | str, ...]], "a mapping from a file's stem to a list of rows"
        ]
        | None
    ) = None
    runs: ColumnName | None = None  # column that counts runs
    time_restarts: bool = False  # whether a run begins where times go backwards
    max_gap: Positive | None = None  # longest time without a row, or a sample, within a run [s]
    run: RunNumber | None = None  # number of the one run that is read
    time: dict[str, Any] | None = None  # declaration of the column of times
    rate_hz: Positive | None = None  # rate of the rows where there is no column of times [Hz]
    clock: ClockPolicy = "strict"  # treatment of uneven time stamps
    channels: ChannelMap | None = None  # channel -> its column and unit
    gappy: ChannelNames | None = None  # channels that may have gaps
    held: dict[str, Any] | None = None  # channels whose samples the table repeats in every row
    pose: dict[str, Any] | None = None  # columns of poses from which reference channels are made
    delimiter: Character = ","  # character between cells
    decimal: Character = "."  # decimal mark
    # encoding of the text, by Python's name
    encoding: Annotated[str, AfterValidator(_encoding)] = "utf8"
    skip_rows: Annotated[int, Field(ge=0, le=10_000)] = 0  # number of lines above the names

    def __post_init__(self) -> None:
        if self.time is None and self.rate_hz is None:
            raise ValueError("without a time column, rate_hz must be given")
        is_cut = self.time_restarts or self.max_gap is not None
        if is_cut and (self.runs is not None or self.time is None):
            raise ValueError(
                "time_restarts and max_gap need a time column, and no column that counts runs"
            )


class TabularSource(FileSource):
    """Tables, a recording each, or one for each uninterrupted run that a column of them counts."""

    options_type = TabularOptions

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        super().__init__(dataset)
        options = self.options
        self.columns = (
            None
            if options.channels is None
            else columns_from_config(options.channels, self.name, SampledColumn)
        )
        self.time: TimeColumn | None = (
            None
            if options.time is None
            else cast(
                TimeColumn,
                column_from_config(options.time, f"{self.location}: time", "s", TimeColumn),
            )
        )
        self._cuts = options.time_restarts or options.max_gap is not None
        self.dropped = dropped_rows_from_config(options.drop_rows or {}, self.location)
        self.gappy = self._gappy_among(CHANNELS if self.columns is None else self.columns)
        self.held = (
            None
            if options.held is None
            else sample_and_hold_from_config(
                options.held, list(self.columns or ()), f"{self.location}: held"
            )
        )
        self.pose = (
            None
            if options.pose is None
            else table_pose_from_config(options.pose, f"{self.location}: pose")
        )
        doubled = sorted(set(self.columns or ()) & set(self.pose.channels if self.pose else ()))
        if doubled:
            raise ConfigurationError(
                f"{self.location}: channel '{doubled[0]}' comes both from channels and from pose; "
                "leave one out"
            )
        self._require_pattern()
        self.layout = TextLayout(
            options.delimiter, options.decimal, options.encoding, options.skip_rows
        )

    def file_parts(self, file: Path) -> Iterator[Recording]:
        """`read_file` in parts, of a large table whose clock is even and whose rows can be read one
        after another.
        """
        require_files([file], self.name)
        time = self._time_of_parts(file)
        if time is None:
            yield self.read_file(file)
            return
        columns = self._columns_of(file)
        selected = names_read(columns)
        number = 0
        try:
            layout = self._layout_of(file)
            for values, clock, part in even_parts(file, time, selected, layout):
                number, _ = part
                measured = measured_columns(file, columns, values)
                yield self._prepared(self._recording_of(file, None, columns, measured, clock, part))
        except DataError:
            self.read_file(file)  # whose errors are of all its rows
            raise
        if not number:
            yield self.read_file(file)

    def _time_of_parts(self, file: Path) -> TimeColumn | None:
        """The column of times of a large table in which no row needs all others; None of another
        table.
        """
        time = self.time
        needing_all_rows = (self._cuts, self.options.runs, self.held, self.pose, self.dropped)
        needs_all_rows = any((*needing_all_rows, self.transforms, self.reference_point))
        if time is None or needs_all_rows or time.wraps_at or time.sort:
            return None
        is_strict = self.options.clock == "strict"
        return time if is_strict and is_large(file) and not is_stored_recording(file) else None

    def _read(self, file: Path, run: int | None) -> Recording:
        """A table, or one run of it."""
        require_files([file], self.name)
        if is_stored_recording(file):
            return read_recording(file)
        columns = self._columns_of(file)
        values = self.column_values(file, self.columns_read(column_names(file, self.layout)))
        rows = self._runs_of(file)[run]
        return self._recording_of(
            file, run, columns, {name: samples[rows] for name, samples in values.items()}
        )

    def columns_read(self, names: Sequence[str]) -> list[str]:
        """Columns read of a table with columns of these names: of channels, poses, times, runs."""
        poses = self.pose.columns if self.pose else {}
        columns = [
            *names_read(self.columns_of(names)),
            *(column.column for column in poses.values()),
        ]
        updated = self.held and self.held.updated
        others = (self.time and self.time.column, self.options.runs, updated)
        return list(dict.fromkeys([*columns, *(str(name) for name in others if name is not None)]))

    def recording_of(self, table: Mapping[str, FloatArray], name: str) -> Recording:
        """A recording of columns in memory, (T,) each.

        Raises
        ------
        ConfigurationError
            The data set has runs, or rows that are left out.
        """
        if self._cuts or self.options.runs or self.dropped:
            raise ConfigurationError(
                f"{self.location}: a table in memory is one run; leave out runs, time_restarts, "
                "max_gap and drop_rows"
            )
        if self.time is not None:
            table = self.time.in_order(table)
        columns = self.columns_of(list(table))
        values = measured_columns(Path(name), columns, table)
        return self._prepared(self._recording_of(Path(name), None, columns, values))

    def columns_of(self, names: Sequence[str]) -> Mapping[str, Column]:
        """Column of each channel: of the data set, else those that are named like channels."""
        if self.columns is not None:
            return self.columns
        return {name: Column(name, CHANNELS[name].unit) for name in names if name in CHANNELS}

    def _columns_of(self, file: Path) -> Mapping[str, Column]:
        """The columns of a file's channels; raises `DataError` where there is none."""
        names = column_names(file, self.layout)
        columns = self.columns_of(names)
        if not columns:
            raise DataError(
                f"'{file}' has no column that is named like a channel (it has {listed(names)}); "
                f"describe them by 'vehest new NAME {file.name}', then add dataset=NAME"
            )
        return columns

    def column_values(self, file: Path, selected: list[str]) -> dict[str, FloatArray]:
        """Columns in the order of their times, without the rows that the data set leaves out."""
        time = self.time
        sorting = [time.column] if time is not None and time.sort else []
        names = list(dict.fromkeys([*selected, *sorting]))
        values = read_columns(file, names, self._layout_of(file))
        if time is not None and time.column in values:
            values = time.in_order(values)
        values = measured_columns(file, self.columns or {}, values)
        dropped = self.dropped.get(file.stem)
        if dropped is None:
            return values
        is_remaining = remaining_rows(len(next(iter(values.values()))), dropped, file)
        return {name: samples[is_remaining] for name, samples in values.items()}

    def _layout_of(self, file: Path) -> TextLayout:
        """The layout of a file's rows, without an end that is cut short."""
        end = cut_end(file, self.layout)
        return self.layout if end is None else replace(self.layout, n_bytes=end[0])

    def _recording_of(
        self,
        file: Path,
        run: int | None,
        columns: Mapping[str, Column],
        values: Mapping[str, FloatArray],
        clock: Clock | None = None,
        part: Sequence[int] = (1, 1),
    ) -> Recording:
        """The recording of a file's columns, or of one run of them, or of a part by its number,
        that of all parts and its clock.
        """
        n_rows = len(next(iter(values.values())))
        location = f"'{file}'" if run is None else f"'{file}', run {run}"
        max_gap = self.options.max_gap
        if self.time is not None and max_gap is not None:
            times = self.time.to_si(values[self.time.column], "s")
            lines = {name: bridged(values[name], times, max_gap) for name in self._spanning(file)}
            values = {**values, **lines}
        if clock is None and self.time is not None:
            clock = uniform_clock(
                self.time.to_si(values[self.time.column], "s"), location, self.options.clock
            )
        clock = clock or Clock(0.0, float(self.options.rate_hz), n_rows)
        sampled_channels = () if self.held is None else self.held.channels
        channels = {
            name: clock.align(
                column.to_si(values[column.column], channel(name).unit), name in self.gappy
            )
            for name, column in columns.items()
            if name not in sampled_channels
        }
        provenance: dict[str, Any] = (
            {"file": file.name}
            | ({} if run is None else {"run": run})
            | ({PART: part} if part[1] > 1 else {})
        )
        end = cut_end(file, self.layout) if file.is_file() else None
        if end is not None and run == [*self._runs_of(file)][-1]:
            provenance[MISSING] = {"": [f"not read: {end[1]}"]}
        if file.stem in self.dropped:
            provenance["dropped_rows"] = list(self.options.drop_rows[file.stem])
        if self.pose is not None:
            channels |= self.pose.channels_of(values, clock, location)
        if self.held is not None:
            sampled_columns = {
                name: column for name, column in columns.items() if name in sampled_channels
            }
            lines, inside, rate = self.held.interpolated(sampled_columns, values, clock, location)
            channels = {name: samples[inside] for name, samples in (channels | lines).items()}
            clock = clock.part(inside)
            provenance["held"] = self.held.description(rate)
        return self._recording(self._name_of(file, run), f"'{file}'", clock, channels, provenance)

    def data_files(self) -> list[Path]:
        """Tables of the data set, without those that it excludes."""
        return remaining_files(
            super().data_files(), self.options.exclude or (), self.dropped, self.location
        )

    def runs_in(self, file: Path) -> Runs:
        """Rows of each run without those that are left out."""
        counter = self.time.column if self.time and self._cuts else self.options.runs
        if counter is None or is_stored_recording(file):
            return super().runs_in(file)
        require_files([file], self.name)
        if self.time is not None and self._cuts:
            names = self._spanning(file) if self.options.max_gap else []
            values = self.column_values(file, [counter, *names])
            return timed_runs(
                self.time.to_si(values[counter], "s"),
                self.options.max_gap,
                restarts=self.options.time_restarts,
                columns=(values[name] for name in names),
            )
        return counted_runs(self.column_values(file, [counter])[counter], counter, file)

    def _spanning(self, file: Path) -> list[str]:
        """Columns that must have samples throughout a run: of channels that are not gappy or
        held.
        """
        sparse = {*self.gappy, *(self.held.channels if self.held else ())}
        columns = self._columns_of(file)
        return list({column.column: None for name, column in columns.items() if name not in sparse})


def unused_columns(dataset: Mapping[str, Any], file: Path | None = None) -> list[str]:
    """Columns that could be declared as channels; none unless the data set's source is ``tabular``.

    Raises `MissingError`, `DataError`.
    """
    source = open_source(dataset)
    if type(source) is not TabularSource:
        return []
    table = file or next(Path(entry) for entry in source.inputs().values())
    if is_stored_recording(table):
        return []
    channels = (
        CHANNELS
        if source.columns is None
        else [column.column for column in source.columns.values()]
    )
    used_columns = {"", source.options.runs, source.time and source.time.column, *channels}
    return [name for name in column_names(table, source.layout) if name not in used_columns]


SOURCE = TabularSource
