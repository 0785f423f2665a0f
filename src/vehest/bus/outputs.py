"""Writes estimates of a bus to a file while they are made; what is written stays."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vehest.bus.messages import dbc_text
from vehest.data.errors import ConfigurationError
from vehest.data.estimate import IN_DEGREES, number_cell, time_cell
from vehest.data.files import writing_error
from vehest.trust.health import reason_in_words

LEADING_COLUMNS = ("vy", "sideslip")  # first columns of a table after the times
# last columns of a table
TRAILING_COLUMNS = ("band_vy", "band_sideslip", "health", "health_reason")


def output_files(path: Path | None) -> list[Path]:
    """Files that an output writes: a table, or a log of frames with its DBC beside it.

    Parameters
    ----------
    path : Path or None
        None: nothing is written.

    Raises
    ------
    ConfigurationError
        The path ends in neither ``.csv`` nor ``.asc``.
    """
    if path is not None and path.suffix.lower() not in (".csv", ".asc"):
        raise ConfigurationError(f"'{path}' must end in .csv or .asc")
    return (
        []
        if path is None
        else [path]
        if path.suffix.lower() == ".csv"
        else [path, path.with_suffix(".dbc")]
    )


class Output:
    """Writes the files of ``path``.

    A table has the columns of ``vehest estimate`` for ``names``, all that estimates hold, and
    ``sampled``, the instant of the sample. A log has the frames of estimates as they came off the
    bus.

    Parameters
    ----------
    path : Path or None
        ``.csv`` or ``.asc``; None: nothing is written.
    names : sequence of str
        Quantities that estimates may have.
    first_id : int
        Identifier of the estimates, for the DBC.

    Raises
    ------
    MissingError
        A file cannot be written.
    """

    def __init__(self, path: Path | None, names: Sequence[str], first_id: int) -> None:
        self._names = [
            *LEADING_COLUMNS,
            *(name for name in names if name not in LEADING_COLUMNS + TRAILING_COLUMNS),
            *(name for name in TRAILING_COLUMNS[:2] if name in names),
        ]
        self._path = path or Path()
        self._angles: list[str] = []  # columns of `IN_DEGREES`
        self._table: Any = None
        self._log: Any = None
        if path is not None and path.suffix.lower() == ".csv":
            with writing(path):
                self._table = path.open("w", encoding="utf-8", newline="", buffering=1)
            self._angles = [name for name, angle in IN_DEGREES.items() if angle in self._names]
            self._row(["time", "sampled", *self._names, *TRAILING_COLUMNS[2:], *self._angles])
        elif path is not None:
            from can.io.asc import ASCWriter

            write_dbc(path.with_suffix(".dbc"), first_id)
            with writing(path):
                self._log = ASCWriter(path)

    def estimate(self, time: float, sampled: float, values: Mapping[str, float]) -> None:
        """Write an estimate that holds for ``time``, of the sample at ``sampled``, on the bus's
        clock [s].

        Parameters
        ----------
        time : float
            For which the estimate holds; later than the sample for a model that predicts.
        sampled : float
            Instant of the sample.
        values : mapping
            Quantity -> value in SI units, health and its reason.
        """
        if self._table is not None:
            cells = [number_cell(values.get(name, math.nan)) for name in self._names]
            health = [str(int(values["health"])), reason_in_words(values["health_reason"])]
            angles = [
                number_cell(math.degrees(values.get(IN_DEGREES[name], math.nan)))
                for name in self._angles
            ]
            self._row([time_cell(time), time_cell(sampled), *cells, *health, *angles])

    def _row(self, cells: list[str]) -> None:
        """Write a row of the table; raises `MissingError` where it cannot be written."""
        with writing(self._path):
            csv.writer(self._table, lineterminator="\n").writerow(cells)

    def frame(self, frame: Any) -> None:
        """Write a frame of an estimate to the log."""
        if self._log is not None:
            frame.channel = 0
            with writing(self._path):
                self._log.on_message_received(frame)

    def close(self) -> None:
        """Close the files."""
        with writing(self._path):
            if self._table is not None:
                self._table.close()
            if self._log is not None:
                self._log.stop()


def write_dbc(path: Path, first_id: int) -> None:
    """Write the DBC of estimates; raises `MissingError` where it cannot be written."""
    with writing(path):
        path.write_text(dbc_text(first_id), encoding="cp1252")


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn a failure to write into its one-line error."""
    try:
        yield
    except OSError as error:
        raise writing_error(path, error) from error
