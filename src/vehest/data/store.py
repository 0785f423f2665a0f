"""Stores recordings and estimates as Parquet files, which come back bit for bit."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from vehest.constants import FloatArray
from vehest.data.errors import DataError, MissingError
from vehest.data.estimate import (
    COVARIANCE,
    IN_DEGREES,
    Estimate,
    Mode,
    column_units,
    estimate_columns,
    with_degrees,
)
from vehest.data.files import writing_error, written_aside
from vehest.data.parquet import parquet_file, read_numbers
from vehest.data.recording import Kind, Recording
from vehest.data.schema import check_format, validated
from vehest.data.text_files import first_line, parse_json

_METADATA_KEY = b"vehest"  # key of vehest's description in the metadata of a Parquet file
_FORMAT = 1  # version of the layout of stored files
# options of pyarrow for stored files
_LAYOUT: dict[str, Any] = {
    "compression": "zstd",
    "use_dictionary": False,
    "use_byte_stream_split": True,
    "write_statistics": False,
    "write_page_checksum": True,  # a flipped bit decompresses to other numbers without complaint
}


@dataclass(frozen=True)
class RecordingDescription:
    """Description of a recording beside its table; see `Recording`."""

    format: int  # version of the layout
    content: Literal["recording"]  # kind of content
    id: str  # name of the recording
    vehicle: str  # name of the vehicle
    rate_hz: float  # sampling rate [Hz]
    start_time: float  # time of the first sample [s]
    kind: Kind = "real"  # whether it was real or simulated
    gappy: frozenset[str] = frozenset()  # channels in which NaN means that nothing was measured
    provenance: dict[str, Any] = field(default_factory=dict)  # origin of the samples


@dataclass(frozen=True)
class EstimateDescription:
    """Description of an estimate beside its table; see `Estimate`.

    See `Estimate`. ``n_states`` is the side of the covariance.
    """

    format: int  # version of the layout
    content: Literal["estimate"]  # kind of content
    recording_id: str  # name of the recording
    estimator: str  # name of the estimator
    rate_hz: float  # rate of the estimate [Hz]
    start_time: float  # time of the first sample [s]
    mode: Mode = "causal"  # ``causal`` if no sample used measurements later than its own time
    n_states: int | None = None  # side n of the covariance; None: there is none
    # quantity behind each row of the covariance; the default is for files in which rows had no
    # names
    covariance_of: tuple[str, ...] = ("vy", "yaw_rate")
    band: str = ""  # text on what calibrated ``band_vy`` and ``band_sideslip``, and for which car


# attributes of a recording in its description
_OF_RECORDING = ("id", "vehicle", "rate_hz", "start_time", "kind")
# attributes of an estimate in its description
_OF_ESTIMATE = ("recording_id", "estimator", "rate_hz", "start_time", "mode")

_Description = TypeVar("_Description", RecordingDescription, EstimateDescription)


def write_recording(recording: Recording, path: Path) -> None:
    """Store one recording.

    The file appears complete or not at all.

    Raises
    ------
    MissingError
        The file cannot be written.
    """
    about = _attributes(recording, _OF_RECORDING) | {
        "gappy": sorted(recording.gappy),
        "provenance": dict(recording.provenance),
    }
    _write(path, [recording.channels], "recording", about)


def read_recording(path: Path, channels: Iterable[str] | None = None) -> Recording:
    """Read a recording back, all of it or the named channels.

    Raises
    ------
    MissingError
        There is no such file.
    DataError
        The file is damaged, not a recording, or lacks a channel.
    """
    columns, described = _read(
        path, RecordingDescription, None if channels is None else list(channels)
    )
    gappy = described.gappy & columns.keys()
    about = _attributes(described, _OF_RECORDING)
    try:
        return Recording(channels=columns, gappy=gappy, provenance=described.provenance, **about)
    except DataError as error:
        raise DataError(f"'{path}': {error}") from None


def is_stored_recording(path: Path) -> bool:
    """Whether ``path`` is a Parquet file that vehest wrote as a recording.

    Raises
    ------
    DataError
        Its description is damaged.
    """
    return _content_of(path) == "recording"


def is_stored_estimate(path: Path) -> bool:
    """Whether ``path`` is a Parquet file that vehest wrote as an estimate.

    Raises
    ------
    DataError
        Its description is damaged.
    """
    return _content_of(path) == "estimate"


def _content_of(path: Path) -> str:
    """Kind of content that vehest wrote into a Parquet file: ``recording`` or ``estimate``.

    Empty for a file of another tool, whatever it is.
    """
    try:
        with parquet_file(path) as file:
            schema = file.schema_arrow
    except (DataError, MissingError):
        return ""  # the reader of tables says why
    if _METADATA_KEY not in (schema.metadata or {}):
        return ""
    content = str(_metadata(schema, path).get("content"))
    if content not in ("recording", "estimate"):
        raise DataError(
            f"'{path}': the description beside the table names neither a recording nor an "
            "estimate; make it again"
        )
    return content


def write_estimate(estimate: Estimate, path: Path) -> None:
    """Store one estimate, with its time column, so that other tools can read it.

    Raises
    ------
    MissingError
        The file cannot be written.
    """
    _write(path, estimate_columns([estimate]), "estimate", _about_estimate(estimate))


def write_estimate_parts(parts: Iterable[Estimate], path: Path, band: str = "") -> None:
    """Write the parts of an estimate, one after another, as a table for people and other tools.

    It has the quantities of the first part, those of `IN_DEGREES` and, as metadata ``unit`` of each
    field of the schema, their units. `read_estimate` reads it back.

    Parameters
    ----------
    parts : iterable of Estimate
        Parts on one clock.
    path : Path
        Parquet file.
    band : str
        What calibrated the bands, for the description beside the table.

    Raises
    ------
    MissingError
        The file cannot be written.
    """
    remaining = iter(parts)
    first = next(remaining)
    about = _about_estimate(first) | ({"band": band} if band else {})
    columns = map(with_degrees, estimate_columns(chain([first], remaining)))
    _write(path, columns, "estimate", about, column_units(first))


def _about_estimate(estimate: Estimate) -> dict[str, Any]:
    """The description of an estimate beside its table."""
    about = _attributes(estimate, _OF_ESTIMATE)
    if estimate.covariance is not None:
        about["n_states"] = estimate.covariance.shape[1]
        about["covariance_of"] = list(estimate.covariance_of)
    return about


def read_estimate(path: Path) -> Estimate:
    """Read an estimate back.

    Raises
    ------
    MissingError
        There is no such file.
    DataError
        The file is damaged or not an estimate.
    """
    columns, described = _read(path, EstimateDescription)
    covariance = None
    n_states = described.n_states
    try:
        del columns["time"]
        for name in IN_DEGREES:
            columns.pop(name, None)
        if n_states is not None:
            n_entries = sum(name.startswith(f"{COVARIANCE}_") for name in columns)
            if n_states < 1 or n_states**2 != n_entries:
                raise DataError(
                    f"n_states is {n_states}, and there are {n_entries} columns of the covariance; "
                    "make it again"
                )
            entries = [
                columns.pop(f"{COVARIANCE}_{row}_{column}")
                for row, column in np.ndindex(n_states, n_states)
            ]
            covariance = np.stack(entries, axis=1).reshape(-1, n_states, n_states)
        covariance_of = () if covariance is None else described.covariance_of
        return Estimate(
            channels=columns,
            covariance=covariance,
            covariance_of=covariance_of,
            **_attributes(described, _OF_ESTIMATE),
        )
    except KeyError as error:
        raise DataError(f"'{path}' has no column {error}; make it again") from None
    except (DataError, ValueError) as error:
        raise DataError(f"'{path}': {error}") from None


def description_of(schema: pa.Schema, path: Path, kind: type[_Description]) -> _Description:
    """The description of a recording or an estimate beside its table.

    Parameters
    ----------
    schema : pyarrow.Schema
        Schema of the file, whose metadata hold the description.
    path : Path
        The file, for messages.
    kind : type
        Dataclass of the description: that of a recording, or of an estimate.

    Raises
    ------
    DataError
        It is damaged, or of another kind or format.
    """
    content = "recording" if kind is RecordingDescription else "estimate"
    description = _metadata(schema, path)
    if description.get("content") != content:
        raise DataError(
            f"'{path}' is a Parquet file, but not {'a' if content == 'recording' else 'an'} "
            f"{content} that vehest wrote"
        )
    check_format(description.get("format", 0), _FORMAT, f"'{path}'")
    return validated(kind, description, f"'{path}'")


def _attributes(of: object, names: Iterable[str]) -> dict[str, Any]:
    """Named attributes of an object, name -> value."""
    return {name: getattr(of, name) for name in names}


def _write(
    path: Path,
    parts: Iterable[Mapping[str, FloatArray]],
    content: str,
    about: Mapping[str, Any],
    units: Mapping[str, str] | None = None,
) -> None:
    """Write parts as one table with a description beside it.

    ``units``: column -> unit, for the schema.
    """
    try:
        described = json.dumps({"format": _FORMAT, "content": content, **about}).encode()
    except (TypeError, ValueError) as error:
        raise DataError(
            f"'{path}' cannot be written: the provenance holds more than JSON values "
            f"({first_line(error)})"
        ) from None
    tables = (
        _table(columns, units or {}).replace_schema_metadata({_METADATA_KEY: described})
        for columns in parts
    )
    first = next(tables)
    with (
        written_aside(path) as aside,
        open(aside, "wb") as stream,
    ):  # pyarrow itself takes no names that are not UTF-8
        try:
            with pq.ParquetWriter(stream, first.schema, **_LAYOUT) as writer:
                for table in chain([first], tables):
                    writer.write_table(table.select(first.schema.names))
        except pa.ArrowException as error:
            raise writing_error(path, OSError(str(error))) from error


def _table(columns: Mapping[str, FloatArray], units: Mapping[str, str]) -> pa.Table:
    """Columns as an Arrow table of float64, each with its unit in the metadata where it has one."""
    buffers = {
        name: pa.py_buffer(np.ascontiguousarray(values, dtype=np.float64))
        for name, values in columns.items()
    }  # without pandas
    arrays = [
        pa.Array.from_buffers(pa.float64(), buffer.size // 8, [None, buffer])
        for buffer in buffers.values()
    ]
    fields = [
        pa.field(name, pa.float64(), metadata={"unit": units[name]} if name in units else None)
        for name in buffers
    ]
    return pa.table(arrays, schema=pa.schema(fields))


def _read(
    path: Path, kind: type[_Description], names: list[str] | None = None
) -> tuple[dict[str, FloatArray], _Description]:
    """Columns, shape (T,) each, and the description of a file of vehest's own; None in ``names``
    for all.

    Raises
    ------
    DataError
        It is no such file, a column is there twice or is not float64, or a wanted one is missing.
    """
    with parquet_file(path) as file:
        schema = file.schema_arrow
        described = description_of(schema, path, kind)
        for name, column in zip(schema.names, schema.types, strict=True):
            if column != pa.float64() or schema.names.count(name) > 1:
                raise DataError(
                    f"'{path}': column '{name}' is there twice, or of type {column}, not double; "
                    "make it again"
                )
        missing = [name for name in names or [] if name not in schema.names]
        if missing:
            raise DataError(
                f"'{path}' has no channel '{missing[0]}' (it has {', '.join(schema.names)})"
            )
        return read_numbers(path, file, schema.names if names is None else names), described


def _metadata(schema: pa.Schema, path: Path) -> dict[str, Any]:
    """The description of vehest beside a table; empty for a table of someone else's."""
    described = parse_json(
        (schema.metadata or {}).get(_METADATA_KEY, b"{}"),
        f"'{path}': the description beside the table",
    )
    if not isinstance(described, dict):
        raise DataError(
            f"'{path}': the description beside the table is damaged (it is no mapping); make it "
            "again"
        )
    return described
