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
from vehest.data.files import writing_error
from vehest.trust.health import reason_in_words

FIRST, LAST = ("vy", "sideslip"), ("band_vy", "band_sideslip", "health", "health_reason")


def output_files(path: Path | None) -> list[Path]:
    """Files that an output writes: a table, or a log of frames with its DBC beside it; none without a path.

    Raises:
        ConfigurationError: the path ends in neither ``.csv`` nor ``.asc``.
    """
    if path is not None and path.suffix.lower() not in (".csv", ".asc"):
        raise ConfigurationError(f"'{path}' must end in .csv or .asc")
    return [] if path is None else [path] if path.suffix.lower() == ".csv" else [path, path.with_suffix(".dbc")]


class Output:
    """Nothing is written."""

    def estimate(self, time: float, sampled: float, values: Mapping[str, float]) -> None:
        """Write an estimate that holds for ``time``, of the sample at ``sampled``, on the bus's clock [s]."""

    def frame(self, frame: Any) -> None:
        """Write a frame of an estimate."""

    def close(self) -> None:
        """Close the file."""


class TableOutput(Output):
    """A row an estimate, with the columns of ``vehest estimate`` for ``names``, all that estimates hold, and ``sampled``."""

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        self._path = path
        self._names = [*FIRST, *(name for name in names if name not in FIRST + LAST), *(name for name in LAST[:2] if name in names)]
        with writing(path):
            self._file = path.open("w", encoding="utf-8", newline="", buffering=1)
            self._writer = csv.writer(self._file, lineterminator="\n")
            self._writer.writerow(["time", "sampled", *self._names, *LAST[2:]])

    def estimate(self, time: float, sampled: float, values: Mapping[str, float]) -> None:
        """Write a row."""
        numbers = [values.get(name, math.nan) for name in self._names]
        cells = ["" if math.isnan(number) else f"{number:.9g}" for number in numbers]
        health = [str(int(values["health"])), reason_in_words(values["health_reason"])]
        with writing(self._path):
            self._writer.writerow([f"{time:.6f}", f"{sampled:.6f}", *cells, *health])

    def close(self) -> None:
        """Close the table."""
        with writing(self._path):
            self._file.close()


class LogOutput(Output):
    """The frames of estimates as they came off the bus, beside them the DBC that describes them."""

    def __init__(self, path: Path, first_id: int) -> None:
        from can.io.asc import ASCWriter

        self._path = path
        write_dbc(path.with_suffix(".dbc"), first_id)
        with writing(path):
            self._writer = ASCWriter(path)

    def frame(self, frame: Any) -> None:
        """Write a frame."""
        frame.channel = 0
        with writing(self._path):
            self._writer.on_message_received(frame)

    def close(self) -> None:
        """Close the log."""
        with writing(self._path):
            self._writer.stop()


def open_output(path: Path | None, names: Sequence[str], first_id: int) -> Output:
    """Output to a file by its ending; raises `MissingError` where it cannot be written."""
    if path is None:
        return Output()
    return TableOutput(path, names) if path.suffix.lower() == ".csv" else LogOutput(path, first_id)


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
