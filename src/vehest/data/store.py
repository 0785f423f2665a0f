"""Recordings and estimates as Parquet files; what is read back is what was written, bit for bit."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from vehest.data.errors import DataError, MissingError
from vehest.data.estimate import Estimate, Mode
from vehest.data.files import writing_error, written_aside
from vehest.data.parquet import parquet_file, read_numbers
from vehest.data.recording import Kind, Recording
from vehest.data.schema import check_format, validated
from vehest.data.text_files import parse_json

_METADATA_KEY = b"vehest"
_FORMAT = 1
_COVARIANCE = "covariance"
_LAYOUT: dict[str, Any] = {
    "compression": "zstd",
    "use_dictionary": False,
    "use_byte_stream_split": True,
    "write_statistics": False,
    "write_page_checksum": True,  # a flipped bit decompresses to other numbers without complaint
}


@dataclass(frozen=True)
class RecordingDescription:
    """What the file of a recording says beside its table; see `Recording`."""

    format: int
    content: Literal["recording"]
    id: str
    vehicle: str
    rate_hz: float
    start_time: float
    kind: Kind = "real"
    gappy: frozenset[str] = frozenset()
    provenance: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class EstimateDescription:
    """What the file of an estimate says beside its table; see `Estimate`. ``n_states`` is the side of the covariance."""

    format: int
    content: Literal["estimate"]
    recording_id: str
    estimator: str
    rate_hz: float
    start_time: float
    mode: Mode = "causal"
    n_states: int | None = None
    covariance_of: tuple[str, ...] = ("vy", "yaw_rate")  # of files from before rows had names


_Description = TypeVar("_Description", RecordingDescription, EstimateDescription)


def write_recording(recording: Recording, path: Path) -> None:
    """Store one recording; the file appears complete or not at all.

    Raises:
        MissingError: the file cannot be written.
    """
    description = {
        "format": _FORMAT,
        "content": "recording",
        "id": recording.id,
        "vehicle": recording.vehicle,
        "rate_hz": recording.rate_hz,
        "start_time": recording.start_time,
        "kind": recording.kind,
        "gappy": sorted(recording.gappy),
        "provenance": dict(recording.provenance),
    }
    _write(path, dict(recording.channels), description)


def read_recording(path: Path, channels: Iterable[str] | None = None) -> Recording:
    """Read a recording back, all of it or the named channels.

    Raises:
        MissingError: there is no such file.
        DataError: the file is damaged, not a recording, or lacks a channel.
    """
    columns, described = _read(path, RecordingDescription, None if channels is None else list(channels))
    try:
        return Recording(
            id=described.id,
            vehicle=described.vehicle,
            rate_hz=described.rate_hz,
            start_time=described.start_time,
            channels=columns,
            kind=described.kind,
            gappy=described.gappy & frozenset(columns),
            provenance=described.provenance,
        )
    except DataError as error:
        raise DataError(f"'{path}': {error}") from None


def is_stored_recording(path: Path) -> bool:
    """Whether ``path`` is a Parquet file that vehest wrote as a recording.

    Raises:
        DataError: it is one, and what it says about itself is damaged.
    """
    try:
        with parquet_file(path) as file:
            schema = file.schema_arrow
    except (DataError, MissingError):
        return False
    return _description(schema, path).get("content") == "recording"


def write_estimate(estimate: Estimate, path: Path) -> None:
    """Store one estimate, with its time column, so that other tools can read it as it is.

    Raises:
        MissingError: the file cannot be written.
    """
    description = {
        "format": _FORMAT,
        "content": "estimate",
        "recording_id": estimate.recording_id,
        "estimator": estimate.estimator,
        "rate_hz": estimate.rate_hz,
        "start_time": estimate.start_time,
        "mode": estimate.mode,
    }
    columns: dict[str, Any] = {"time": estimate.time, **estimate.channels}
    if estimate.covariance is not None:
        description["n_states"] = estimate.covariance.shape[1]
        description["covariance_of"] = list(estimate.covariance_of)
        for row, column in np.ndindex(estimate.covariance.shape[1:]):
            columns[f"{_COVARIANCE}_{row}_{column}"] = estimate.covariance[:, row, column]
    _write(path, columns, description)


def read_estimate(path: Path) -> Estimate:
    """Read an estimate back.

    Raises:
        MissingError: there is no such file.
        DataError: the file is damaged or not an estimate.
    """
    columns, described = _read(path, EstimateDescription, None)
    if columns.pop("time", None) is None:
        raise DataError(f"'{path}' has no column 'time'; make it again")
    covariance = None
    if described.n_states is not None:
        covariance = _covariance(columns, described.n_states, path)
    try:
        return Estimate(
            recording_id=described.recording_id,
            estimator=described.estimator,
            rate_hz=described.rate_hz,
            start_time=described.start_time,
            channels=columns,
            mode=described.mode,
            covariance=covariance,
            covariance_of=() if covariance is None else described.covariance_of,
        )
    except DataError as error:
        raise DataError(f"'{path}': {error}") from None


def _covariance(columns: dict[str, Any], n_states: int, path: Path) -> Any:
    """Take the entries of the covariance out of the columns; shape (T, n, n)."""
    here = sum(name.startswith(f"{_COVARIANCE}_") for name in columns)
    if n_states < 1 or n_states**2 != here:
        raise DataError(f"'{path}': n_states is {n_states}, and there are {here} columns of the covariance; make it again")
    names = [f"{_COVARIANCE}_{row}_{column}" for row, column in np.ndindex(n_states, n_states)]
    missing = [name for name in names if name not in columns]
    if missing:
        raise DataError(f"'{path}' has no column '{missing[0]}'; make it again")
    return np.stack([columns.pop(name) for name in names], axis=1).reshape(-1, n_states, n_states)


def _write(path: Path, columns: Mapping[str, Any], description: Mapping[str, Any]) -> None:
    try:
        described = json.dumps(description).encode()
    except (TypeError, ValueError) as error:
        raise DataError(f"'{path}' cannot be written: the provenance holds more than JSON values ({_first_line(error)})") from None
    arrays = {name: pa.array(np.asarray(values, dtype=np.float64)) for name, values in columns.items()}
    table = pa.table(arrays).replace_schema_metadata({_METADATA_KEY: described})
    with written_aside(path) as aside, open(aside, "wb") as stream:  # pyarrow itself takes no names that are not UTF-8
        try:
            pq.write_table(table, stream, **_LAYOUT)
        except pa.ArrowException as error:
            raise writing_error(path, OSError(str(error))) from error


def _read(path: Path, kind: type[_Description], names: list[str] | None) -> tuple[dict[str, Any], _Description]:
    try:
        with parquet_file(path) as file:
            described = _described(file.schema_arrow, path, kind)
            _check_columns(file.schema_arrow, path)
            missing = [name for name in names or [] if name not in file.schema_arrow.names]
            if missing:
                have = ", ".join(file.schema_arrow.names)
                raise DataError(f"'{path}' has no channel '{missing[0]}' (it has {have})")
            return dict(read_numbers(path, file, file.schema_arrow.names if names is None else names)), described
    except (ValueError, KeyError) as error:
        raise DataError(f"'{path}' is truncated or damaged ({_first_line(error)}); make it again") from error


def _described(schema: Any, path: Path, kind: type[_Description]) -> _Description:
    content = "recording" if kind is RecordingDescription else "estimate"
    found = _description(schema, path)
    if found.get("content") != content:
        article = "an" if content == "estimate" else "a"
        raise DataError(f"'{path}' is a Parquet file, but not {article} {content} that vehest wrote")
    check_format(found.get("format", 0), _FORMAT, f"'{path}'")
    return validated(kind, found, f"'{path}'")


def _check_columns(schema: Any, path: Path) -> None:
    for name, column in zip(schema.names, schema.types, strict=True):
        if schema.names.count(name) > 1:
            raise DataError(f"'{path}' has {schema.names.count(name)} columns called '{name}'; make it again")
        if column != pa.float64():
            raise DataError(f"'{path}': column '{name}' is of type {column}, not double; make it again")


def _description(schema: Any, path: Path) -> dict[str, Any]:
    """What vehest wrote beside the table; empty for a table of someone else's."""
    described = parse_json((schema.metadata or {}).get(_METADATA_KEY, b"{}"), f"'{path}': the description beside the table")
    return described if isinstance(described, dict) else {}


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0][:120] if str(error).strip() else type(error).__name__
