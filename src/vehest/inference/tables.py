"""Writes estimates as tables, Parquet or CSV."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError
from vehest.data.estimate import (
    IN_DEGREES,
    QUANTITIES,
    Estimate,
    estimate_columns,
    number_cell,
    time_cell,
    with_degrees,
)
from vehest.data.files import written_aside
from vehest.data.store import write_estimate_parts
from vehest.trust.health import reason_in_words

TABLE_SUFFIXES = (".parquet", ".csv")  # endings of tables of estimates
LOG_SUFFIXES = (".mf4", ".mat")
"""Endings of files of estimates that are the log with further channels."""


def write_estimate_table(parts: Iterable[Estimate], path: Path, band: str = "") -> None:
    """Write an estimate, of parts that follow one another, as Parquet or CSV, by the file's ending.

    Units are those of `COLUMN_UNITS`. CSV has six significant digits, times to a microsecond.
    ``band`` says what calibrated the bands, in the metadata of Parquet.

    Parameters
    ----------
    parts : iterable of Estimate
        Of one recording, at least one; each is written before the next is read, so that hours need
        little memory.
    path : Path
        Ends in .parquet or .csv; it is replaced in one step.
    """
    check_table_name(path)
    if path.suffix.lower() == ".parquet":
        write_estimate_parts(parts, path, band)
        return
    tables = map(_text_columns, estimate_columns(parts))
    first = next(tables)
    with written_aside(path) as aside, open(aside, "w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(first)
        for columns in chain([first], tables):
            writer.writerows(zip(*(columns[name] for name in first), strict=True))


def _text_columns(columns: Mapping[str, FloatArray]) -> dict[str, list[Any]]:
    """Cells of a table of text, with the reasons of health as text.

    Angles are listed in degrees, too, behind the other columns.
    """
    cells: dict[str, list[Any]] = {"time": [time_cell(time) for time in columns["time"].tolist()]}
    quantities = [name for name in columns if name in QUANTITIES]
    cells |= {name: [number_cell(value) for value in columns[name].tolist()] for name in quantities}
    if "health" in columns:
        cells["health"] = columns["health"].astype(int).tolist()
        cells["health_reason"] = [reason_in_words(code) for code in columns["health_reason"]]
    angles = with_degrees(columns)
    in_degrees = [name for name in IN_DEGREES if name in angles]
    return cells | {
        name: [number_cell(value) for value in angles[name].tolist()] for name in in_degrees
    }


def check_table_name(path: Path) -> None:
    """Raise `ConfigurationError` for a file that is neither a table nor a log."""
    if path.suffix.lower() not in TABLE_SUFFIXES:
        raise ConfigurationError(
            f"'{path}' must end in {', '.join(TABLE_SUFFIXES)} or, as a log with further "
            f"channels, {' or '.join(LOG_SUFFIXES)}"
        )
