"""Any CSV or Parquet table with a column a channel; names, units and signs are declared in conf/dataset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as compute
import pyarrow.csv as pc

from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS, channel
from vehest.data.errors import ConfigurationError, DataError, MissingError, printable
from vehest.data.limits import check_limit
from vehest.data.parquet import DAMAGE, parquet_file, read_numbers
from vehest.data.recording import Recording
from vehest.data.store import is_stored_recording, read_recording
from vehest.data.text_files import first_line
from vehest.sources.base import Source, matching_files, require_files
from vehest.sources.clocks import Clock, ClockPolicy, uniform_clock
from vehest.sources.columns import (
    ChannelMap,
    ChannelNames,
    Column,
    columns_from_config,
    identity_columns,
    time_column_from_config,
)
from vehest.sources.held import Held, between_samples, held_from_config, new_samples, with_repeats
from vehest.sources.table_pose import TablePose, table_pose_from_config
from vehest.sources.table_rows import counted_runs, dropped_rows_from_config, kept_rows, restarted_runs
from vehest.sources.text_tables import check_header, check_size, table_stream

MOST_SKIPPED_ROWS = 10_000


@dataclass(frozen=True)
class TabularOptions:
    """Options of the source, by type; what is None is not said."""

    path: str | None = None
    files: str = "*.csv"
    exclude: Annotated[tuple[str, ...], "a list of patterns over the files' stems"] | None = None
    drop_rows: Annotated[dict[str, tuple[int | str, ...]], "a mapping from a file's stem to a list of rows"] | None = None
    runs: str | int | None = None
    time_restarts: bool = False
    time: dict[str, Any] | None = None
    rate_hz: float | None = None
    clock: ClockPolicy = "strict"
    channels: ChannelMap | None = None
    gappy: ChannelNames | None = None
    held: dict[str, Any] | None = None
    pose: dict[str, Any] | None = None
    delimiter: str = ","
    decimal: str = "."
    encoding: str = "utf8"
    skip_rows: int = 0


class TabularSource(Source):
    """Tables, a recording each, or one for each uninterrupted run that a column of them counts.

    Options: ``path``, ``files`` (glob) and ``exclude``, ``drop_rows``, ``runs`` (column) or ``time_restarts``, ``time`` or ``rate_hz``,
    ``clock``, ``channels``, ``gappy``, ``held``, ``pose``, and for CSV ``delimiter``, ``decimal``, ``encoding``, ``skip_rows``.
    """

    options_type = TabularOptions
    keys = frozenset(
        {
            *("path", "files", "exclude", "drop_rows", "runs", "time_restarts", "time", "rate_hz", "clock", "channels", "gappy", "held"),
            *("pose", "delimiter", "decimal", "encoding", "skip_rows"),
        }
    )

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        super().__init__(dataset)
        declared = dataset.get("channels")
        self.columns = None if declared is None else columns_from_config(declared, self.name)
        time = dataset.get("time")
        self.time = None if time is None else time_column_from_config(time, self.name)
        rate = dataset.get("rate_hz")
        if self.time is None and rate is None:
            raise ConfigurationError(f"data set '{self.name}': without a time column, rate_hz must be given")
        if rate is not None and not rate > 0:
            raise ConfigurationError(f"data set '{self.name}': rate_hz must be a positive number, not {rate}")
        self.runs = None if dataset.get("runs") is None else str(dataset["runs"])
        self.restarts = bool(dataset.get("time_restarts", False))
        if self.restarts and (self.runs is not None or self.time is None):
            what = "a column counts its runs" if self.runs is not None else "it has no time column"
            raise ConfigurationError(f"data set '{self.name}': time_restarts cannot begin runs where {what}; leave one out")
        self.dropped = dropped_rows_from_config(dataset.get("drop_rows") or {}, f"data set '{self.name}'")
        self.gappy = self._gappy_channels(dataset.get("gappy") or [])
        self.held, self.pose = self._held(dataset.get("held")), self._pose(dataset.get("pose"))
        self._known_runs: dict[Path, dict[int, slice]] = {}
        _require_options(dataset, self.name)

    def ids(self) -> list[str]:
        """Stems of the files, in alphabetical order; where a column counts runs, ``STEM_run_N`` in the order of the file.

        Raises:
            MissingError: no file is there, or one is empty.
            DataError: the column of runs cannot be read.
        """
        return list(self._found())

    def inputs(self) -> dict[str, str | Path]:
        """The tables."""
        return {file.name: file for file in self._files()}

    def read_raw(self, recording_id: str) -> Recording:
        """Read one recording by its name."""
        found = self._found()
        if recording_id not in found:
            raise MissingError(f"data set '{self.name}' has no recording '{recording_id}' (it has {_listed(list(found))})")
        return self._read(*found[recording_id])

    def read_raw_file(self, file: Path) -> Recording:
        """Read a table wherever it is.

        Raises:
            MissingError: it is not there or empty.
            DataError: it cannot be read, lacks a column, holds text where numbers belong, or holds several runs.
        """
        require_files([file], self.name)
        runs = list(self._runs_of(file)) if self._has_runs and not is_stored_recording(file) else [None]
        if len(runs) > 1:
            raise DataError(f"'{file}' holds {len(runs)} runs ({_listed([str(run) for run in runs])}); keep the rows of one")
        return self._read(file, runs[0])

    def _read(self, file: Path, run: int | None) -> Recording:
        require_files([file], self.name)
        if is_stored_recording(file):
            return read_recording(file)
        names = column_names(file, self.dataset)
        columns = identity_columns(names) if self.columns is None else self.columns
        if not columns:
            raise DataError(
                f"'{file}' has no column that is named like a channel (it has {_listed(names)}); declare the columns in conf/dataset"
            )
        wanted = self._wanted(columns)
        for name in wanted:
            if names.count(name) > 1:
                raise DataError(f"'{file}' has {names.count(name)} columns called '{name}'; rename or remove all but one")
            if name not in names:
                raise DataError(
                    f"'{file}' has no column '{name}' (it has {_listed(names)}); correct the map in conf/dataset/{self.name}.yaml"
                )
        values = self._values(file, wanted)
        if run is not None:
            rows = self._runs_of(file)[run]
            values = {name: samples[rows] for name, samples in values.items()}
        return self._recording(file, run, columns, values)

    def _wanted(self, columns: Mapping[str, Column]) -> list[str]:
        """Columns that something is made of."""
        wanted = [column.column for column in columns.values()] + ([self.time.column] if self.time else [])
        if self.runs is not None:
            wanted.append(self.runs)
        if self.held is not None and self.held.updated is not None:
            wanted.append(self.held.updated)
        if self.pose is not None:
            wanted += [column.column for column in self.pose.columns.values()]
        return list(dict.fromkeys(wanted))

    def _values(self, file: Path, wanted: list[str]) -> dict[str, FloatArray]:
        """Columns without the rows that the data set leaves out."""
        values = _read_columns(file, wanted, self.dataset)
        dropped = self.dropped.get(file.stem)
        if dropped is None:
            return values
        kept = kept_rows(len(next(iter(values.values()))), dropped, file)
        return {name: samples[kept] for name, samples in values.items()}

    def _recording(self, file: Path, run: int | None, columns: Mapping[str, Column], values: Mapping[str, FloatArray]) -> Recording:
        n_rows = len(next(iter(values.values())))
        where = f"'{file}'" if run is None else f"'{file}', run {run}"
        if n_rows == 0:
            raise DataError(f"'{file}' has a header and no rows")
        if self.time is not None:
            stamps = self.time.to_si(values[self.time.column], "s")
            clock = uniform_clock(stamps, where, self.dataset.get("clock", "strict"))
        else:
            clock = Clock(0.0, float(self.dataset["rate_hz"]), n_rows)
        held = () if self.held is None else self.held.channels
        channels = {
            name: clock.align(column.to_si(values[column.column], channel(name).unit), gappy=name in self.gappy)
            for name, column in columns.items()
            if name not in held
        }
        provenance: dict[str, Any] = {"dataset": self.name, "source": "tabular", "file": file.name} | ({} if run is None else {"run": run})
        if file.stem in self.dropped:
            provenance["dropped_rows"] = list(self.dataset["drop_rows"][file.stem])
        if self.pose is not None:
            channels |= self.pose.made_of(values, clock, where)
        if self.held is not None:
            channels, clock, rate = self._with_held(self.held, channels, columns, values, clock, where)
            provenance["held"] = self.held.description(rate)
        try:
            return Recording(
                id=_name_of(file, run),
                vehicle=str(self.dataset.get("vehicle", "unknown")),
                rate_hz=clock.rate_hz,
                start_time=clock.start_time,
                channels=channels,
                kind=self.kind,
                gappy=self.gappy,
                provenance=provenance,
            )
        except DataError as error:
            raise DataError(f"'{file}': {error}") from None

    def _with_held(
        self,
        held: Held,
        channels: Mapping[str, FloatArray],
        columns: Mapping[str, Column],
        values: Mapping[str, FloatArray],
        clock: Clock,
        where: str,
    ) -> tuple[dict[str, FloatArray], Clock, float]:
        """All channels where each held one lies between two samples, the clock of that range, and the held channels' rate [Hz]."""
        declared = {name: columns[name] for name in held.channels if name in columns}
        markers = [held.updated] if held.updated is not None else list(dict.fromkeys(column.column for column in declared.values()))
        rows = new_samples([values[name] for name in markers], where)
        times, ticks = clock.times_of_rows()[rows], clock.ticks()
        found = {}
        for name, column in declared.items():
            samples, taken = column.to_si(values[column.column], channel(name).unit)[rows], times
            if held.updated is None:
                samples, taken = with_repeats(samples, times)
            found[name] = between_samples(samples, taken, held.delay[name], ticks)
        begin, end = (times[edge] - np.array([held.delay[name] for name in declared]) for edge in (0, -1))
        inside = np.flatnonzero((ticks >= begin.max()) & (ticks <= end.min()))
        if not len(inside):
            raise DataError(f"{where}: no row lies between two samples of every held channel; are their delays in seconds?")
        kept = slice(int(inside[0]), int(inside[-1]) + 1)
        cut = replace(clock, start_time=float(ticks[kept.start]), n_samples=kept.stop - kept.start, stamps=None)
        return {name: samples[kept] for name, samples in {**channels, **found}.items()}, cut, (len(rows) - 1) / float(times[-1] - times[0])

    def _held(self, entry: Any) -> Held | None:
        if entry is None:
            return None
        if self.columns is None:
            raise ConfigurationError(f"data set '{self.name}': held needs channels that are declared")
        return held_from_config(entry, list(self.columns), f"data set '{self.name}': held")

    def _pose(self, entry: Any) -> TablePose | None:
        if entry is None:
            return None
        pose = table_pose_from_config(entry, f"data set '{self.name}': pose")
        doubled = sorted(set(self.columns or ()) & set(pose.channels))
        if doubled:
            raise ConfigurationError(
                f"data set '{self.name}': channel '{doubled[0]}' comes both from channels and from pose; leave one out"
            )
        return pose

    def _gappy_channels(self, names: Any) -> frozenset[str]:
        for name in names:
            if name not in (CHANNELS if self.columns is None else self.columns):
                raise ConfigurationError(f"data set '{self.name}': gappy names '{name}', which is not one of its channels")
        return frozenset(names)

    @property
    def _has_runs(self) -> bool:
        return self.runs is not None or self.restarts

    def _files(self) -> list[Path]:
        """Tables of the data set, without those that it excludes."""
        found = matching_files(self.dataset, "*.csv")
        stems = {file.stem for file in found}
        patterns = [str(pattern) for pattern in self.dataset.get("exclude") or ()]
        for pattern in patterns:
            if not any(fnmatchcase(stem, pattern) for stem in stems):
                raise MissingError(f"data set '{self.name}': exclude names '{pattern}', which no file is called")
        for stem in self.dropped:
            if stem not in stems:
                raise MissingError(f"data set '{self.name}': drop_rows names '{stem}', which no file is called")
        kept = [file for file in found if not any(fnmatchcase(file.stem, pattern) for pattern in patterns)]
        if not kept:
            raise MissingError(f"data set '{self.name}': exclude leaves none of its files")
        return kept

    def _found(self) -> dict[str, tuple[Path, int | None]]:
        """Names of the recordings: where each stands."""
        files = self._files()
        if not self._has_runs:
            return {_name_of(file, None): (file, None) for file in files}
        require_files(files, self.name)
        return {_name_of(file, run): (file, run) for file in files for run in self._runs_of(file)}

    def _runs_of(self, file: Path) -> dict[int, slice]:
        """Number of each run in a table: its rows, counted without those that are left out."""
        if file not in self._known_runs:
            self._known_runs[file] = self._read_runs(file)
        return self._known_runs[file]

    def _read_runs(self, file: Path) -> dict[int, slice]:
        column = self.runs if self.runs is not None or self.time is None else self.time.column
        names = column_names(file, self.dataset)
        if names.count(str(column)) != 1:
            what = "counts" if self.runs is not None else "begins"
            raise DataError(
                f"'{file}' has no column '{column}' that {what} its runs (it has {_listed(names)}); correct runs in the data set"
            )
        numbers = self._values(file, [str(column)])[str(column)]
        if not len(numbers):
            raise DataError(f"'{file}' has a header and no rows")
        return restarted_runs(numbers) if self.runs is None else counted_runs(numbers, self.runs, file)


def _require_options(dataset: Mapping[str, Any], name: str) -> None:
    for option, default in (("delimiter", ","), ("decimal", ".")):
        value = dataset.get(option, default)
        if len(value) != 1:
            raise ConfigurationError(f"data set '{name}': {option} must be one character, not '{value}'")
    encoding = str(dataset.get("encoding", "utf8"))
    try:
        "0,1".encode(encoding).decode(encoding)  # which codecs that are none of text refuse
    except (LookupError, ValueError):
        raise ConfigurationError(f"data set '{name}': encoding '{encoding}' is not known; use for example utf8 or latin-1") from None
    skip_rows = dataset.get("skip_rows", 0)
    if not 0 <= skip_rows <= MOST_SKIPPED_ROWS:
        raise ConfigurationError(f"data set '{name}': skip_rows must be a whole number of lines up to {MOST_SKIPPED_ROWS}, not {skip_rows}")
    pattern = str(dataset.get("files", "*.csv"))
    if not pattern or Path(pattern).is_absolute():
        raise ConfigurationError(f"data set '{name}': files must be a pattern inside path, such as '*.csv', not '{pattern}'")


def _name_of(file: Path, run: int | None) -> str:
    return file.stem if run is None else f"{file.stem}_run_{run}"


def _is_parquet(file: Path) -> bool:
    return file.suffix.lower() in {".parquet", ".pq"}


def column_names(file: Path, dataset: Mapping[str, Any]) -> list[str]:
    """Names of a table's columns, in order.

    Args:
        file: the table.
        dataset: with ``delimiter``, ``encoding`` and ``skip_rows`` where they are others than a plain CSV's.

    Raises:
        MissingError: there is no such file.
        DataError: it cannot be read, or has too many columns.
    """
    if _is_parquet(file):
        with parquet_file(file) as table:
            names = list(table.schema_arrow.names)
        check_limit("columns", len(names), f"'{file}' has {len(names)} columns")
        return names
    check_size(file, 1)
    check_header(file, str(dataset.get("delimiter", ",")), str(dataset.get("encoding", "utf8")), int(dataset.get("skip_rows", 0)))
    try:
        with (
            table_stream(file) as stream,
            pc.open_csv(stream, read_options=_read_options(dataset, threads=False), parse_options=_parse_options(dataset)) as reader,
        ):
            return list(reader.schema.names)
    except DAMAGE as error:
        raise _unreadable(file, error) from None


def _read_columns(file: Path, names: list[str], dataset: Mapping[str, Any]) -> dict[str, FloatArray]:
    """Columns of numbers, (T,) each."""
    if _is_parquet(file):
        with parquet_file(file) as table:
            return read_numbers(file, table, names)
    check_size(file, len(names))
    try:
        with table_stream(file) as stream:
            table = pc.read_csv(stream, _read_options(dataset), _parse_options(dataset), _convert_options(dataset, names, pa.float64()))
        return {name: table.column(name).to_numpy() for name in names}
    except DAMAGE as error:
        _point_at_text(file, names, dataset)
        raise _unreadable(file, error) from None


def _convert_options(dataset: Mapping[str, Any], names: list[str], kind: pa.DataType) -> pc.ConvertOptions:
    return pc.ConvertOptions(
        include_columns=names,
        column_types=dict.fromkeys(names, kind),
        decimal_point=str(dataset.get("decimal", ".")),
        strings_can_be_null=True,
    )


def _read_options(dataset: Mapping[str, Any], *, threads: bool = True) -> pc.ReadOptions:
    return pc.ReadOptions(use_threads=threads, encoding=str(dataset.get("encoding", "utf8")), skip_rows=int(dataset.get("skip_rows", 0)))


def _parse_options(dataset: Mapping[str, Any]) -> pc.ParseOptions:
    return pc.ParseOptions(delimiter=str(dataset.get("delimiter", ",")))


def _point_at_text(file: Path, names: list[str], dataset: Mapping[str, Any]) -> None:
    """Say where text stands in a column of numbers.

    Raises:
        DataError: where it is, or in which row the file cannot be read at all.
    """
    before = 0
    try:
        with (
            table_stream(file) as stream,
            pc.open_csv(
                stream, _read_options(dataset, threads=False), _parse_options(dataset), _convert_options(dataset, names, pa.string())
            ) as reader,
        ):  # on one thread, errors name their row
            for batch in reader:
                _point_at_text_in(batch, before, file, str(dataset.get("decimal", ".")))
                before += batch.num_rows
    except DAMAGE as error:
        raise _unreadable(file, error) from None


def _point_at_text_in(batch: pa.RecordBatch, before: int, file: Path, decimal: str) -> None:
    for name in batch.schema.names:
        try:
            plain = compute.replace_substring(compute.utf8_trim_whitespace(batch.column(name)), decimal, ".")
            compute.cast(plain, pa.float64())
            continue  # all of them numbers
        except pa.ArrowException:
            pass
        for row, text in enumerate(batch.column(name).to_pylist(), start=before + 1):
            try:
                float((text or "nan").replace(decimal, ".").replace("_", "?"))
            except ValueError:
                shown = printable(text if len(text) <= 40 else f"{text[:40]}…")
                raise DataError(f"'{file}': column '{name}' holds the text '{shown}' in data row {row}; numbers are needed") from None


def _unreadable(file: Path, error: Exception) -> DataError:
    return DataError(f"'{file}' cannot be read as a table ({first_line(error)}); is it truncated, or of another format or encoding?")


def _listed(names: list[str]) -> str:
    return ", ".join(printable(name[:60]) for name in names[:12]) + (", …" if len(names) > 12 else "")


SOURCE = TabularSource
