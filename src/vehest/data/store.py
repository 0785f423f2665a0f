"""Recordings and estimates as Parquet files; what is read back is what was written, bit for bit."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from vehest.data.errors import DataError, MissingError
from vehest.data.estimate import Estimate
from vehest.data.files import writing_error, written_aside
from vehest.data.recording import Recording

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
    columns, description = _read(path, "recording", None if channels is None else list(channels))
    return Recording(
        id=description["id"],
        vehicle=description["vehicle"],
        rate_hz=description["rate_hz"],
        start_time=description["start_time"],
        channels=columns,
        kind=description["kind"],
        gappy=frozenset(description["gappy"]) & frozenset(columns),
        provenance=description["provenance"],
    )


def is_stored_recording(path: Path) -> bool:
    """Whether ``path`` is a Parquet file that vehest wrote as a recording."""
    try:
        return bool(_description(pq.read_schema(path)).get("content") == "recording")
    except (OSError, pa.ArrowException, ValueError):
        return False


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
    columns, description = _read(path, "estimate", None)
    columns.pop("time")
    n_states = description.get("n_states")
    covariance, covariance_of = None, ()
    if n_states is not None:
        entries = [columns.pop(f"{_COVARIANCE}_{row}_{column}") for row, column in np.ndindex(n_states, n_states)]
        covariance = np.stack(entries, axis=1).reshape(-1, n_states, n_states)
        covariance_of = tuple(description.get("covariance_of", ("vy", "yaw_rate")))  # of files from before rows had names
    return Estimate(
        recording_id=description["recording_id"],
        estimator=description["estimator"],
        rate_hz=description["rate_hz"],
        start_time=description["start_time"],
        channels=columns,
        mode=description["mode"],
        covariance=covariance,
        covariance_of=covariance_of,
    )


def _write(path: Path, columns: Mapping[str, Any], description: Mapping[str, Any]) -> None:
    try:
        described = json.dumps(description).encode()
    except (TypeError, ValueError) as error:
        raise DataError(f"'{path}' cannot be written: the provenance holds more than JSON values ({_first_line(error)})") from None
    arrays = {name: pa.array(np.asarray(values, dtype=np.float64)) for name, values in columns.items()}
    table = pa.table(arrays).replace_schema_metadata({_METADATA_KEY: described})
    with written_aside(path) as aside:
        try:
            pq.write_table(table, aside, **_LAYOUT)
        except pa.ArrowException as error:
            raise writing_error(path, OSError(str(error))) from error


def _read(path: Path, content: str, names: list[str] | None) -> tuple[dict[str, Any], dict[str, Any]]:
    if not path.is_file():
        raise MissingError(f"there is no file '{path}'")
    if path.stat().st_size == 0:
        raise DataError(f"'{path}' is empty; make it again")
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            description = _description(file.schema_arrow)
            if description.get("content") != content:
                article = "an" if content == "estimate" else "a"
                raise DataError(f"'{path}' is a Parquet file, but not {article} {content} that vehest wrote")
            if description["format"] > _FORMAT:
                raise DataError(f"'{path}' was written by a newer vehest (format {description['format']}); update vehest")
            missing = [name for name in names or [] if name not in file.schema_arrow.names]
            if missing:
                have = ", ".join(file.schema_arrow.names)
                raise DataError(f"'{path}' has no channel '{missing[0]}' (it has {have})")
            table = file.read(columns=names)
    except (OSError, pa.ArrowException, ValueError, KeyError) as error:
        raise DataError(f"'{path}' is truncated or damaged ({_first_line(error)}); make it again") from error
    return {name: table.column(name).to_numpy() for name in table.column_names}, description


def _description(schema: Any) -> dict[str, Any]:
    """What vehest wrote beside the table; empty for a table of someone else's."""
    described = json.loads((schema.metadata or {}).get(_METADATA_KEY, b"{}"))
    return described if isinstance(described, dict) else {}


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0][:120] if str(error).strip() else type(error).__name__
