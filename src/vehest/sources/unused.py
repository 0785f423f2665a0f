"""Columns of a table that no channel of its data set uses."""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vehest.data.channels import CHANNELS
from vehest.data.parquet import parquet_file
from vehest.data.store import is_stored_recording
from vehest.sources.base import open_source
from vehest.sources.text_tables import BLOCK, check_header, table_stream


def unused_columns(dataset: Mapping[str, Any], file: Path | None = None) -> list[str]:
    """Names of columns that could be declared as channels; none where the data set's source reads no tables.

    Args:
        dataset: its configuration.
        file: the table; the first of the data set if none is given.

    Raises:
        MissingError: there is no such file.
        DataError: it cannot be read.
    """
    if dataset.get("source") != "tabular":
        return []
    files = [file] if file is not None else [entry for entry in open_source(dataset).inputs().values() if isinstance(entry, Path)]
    if is_stored_recording(files[0]):
        return []
    declared, time = dataset.get("channels"), dataset.get("time")
    entries = [*(CHANNELS if declared is None else declared.values()), *([] if time is None else [time]), dataset.get("runs")]
    used = {entry.get("column") if isinstance(entry, Mapping) else entry for entry in entries}
    return [name for name in _header(files[0], dataset) if name and name not in used]


def _header(file: Path, dataset: Mapping[str, Any]) -> list[str]:
    if file.suffix.lower() in {".parquet", ".pq"}:
        with parquet_file(file) as table:
            return list(table.schema_arrow.names)
    delimiter, encoding, skipped = (
        dataset.get(key, default) for key, default in (("delimiter", ","), ("encoding", "utf8"), ("skip_rows", 0))
    )
    check_header(file, delimiter, encoding, skipped)
    with table_stream(file) as stream:
        begin = codecs.getincrementaldecoder(encoding)(errors="replace").decode(stream.read(BLOCK))
    lines = [line for line in re.split(r"\r\n|\n|\r", begin)[skipped:] if line]
    try:
        return next(csv.reader(lines[:1], delimiter=delimiter), [])
    except csv.Error:  # pyarrow reads longer names
        return []
