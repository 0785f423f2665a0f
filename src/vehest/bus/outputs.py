"""Where estimates of a bus are written to while they are made, so that what was written stays whatever happens next."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from vehest.bus.messages import dbc_text
from vehest.bus.receiver import Said
from vehest.data.errors import ConfigurationError
from vehest.data.files import writing_error
from vehest.trust.verdict import reason_in_words

SUFFIXES = (".csv", ".asc")
FLUSHED_EVERY = 20
"""Estimates after which they are on the disk."""


class Output:
    """Nothing is written.

    Attributes:
        files: that were written.
    """

    files: Sequence[Path] = ()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close what is open."""

    def estimate(self, said: Said) -> None:
        """Write an estimate, as the model made it."""

    def frame(self, frame: Any, stamp: float) -> None:
        """Write a frame of an estimate that came off the bus, stamped [s] on its clock."""


class TableOutput(Output):
    """A row an estimate, with the columns of ``vehest estimate``, and ``sampled``, the instant of the sample.

    Args:
        path: ends in ``.csv``.
        names: of what estimates hold.

    Raises:
        MissingError: it cannot be written.
    """

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        self.files, self._path = (path,), path
        first = [name for name in ("vy", "sideslip") if name in names]
        last = [name for name in ("band_vy", "band_sideslip") if name in names]
        self._names = first + [name for name in names if name not in (*first, *last, "health", "health_reason")] + last
        self._count = 0
        self._file = _guarded(path, lambda: path.open("w", encoding="utf-8", newline=""))
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._write(["time", "sampled", *self._names, "health", "health_reason"])

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close the file."""
        _guarded(self._path, self._file.close)

    def estimate(self, said: Said) -> None:
        """Write a row."""
        values = [said.values.get(name, math.nan) for name in self._names]
        cells = ["" if math.isnan(value) else f"{value:.9g}" for value in values]
        health, reason = said.values["health"], said.values["health_reason"]
        self._write([f"{said.time:.6f}", f"{said.sampled:.6f}", *cells, str(int(health)), reason_in_words(reason)])

    def _write(self, row: list[str]) -> None:
        _guarded(self._path, lambda: self._writer.writerow(row))
        self._count += 1
        if self._count % FLUSHED_EVERY == 0:
            _guarded(self._path, self._file.flush)


class LogOutput(Output):
    """The frames of estimates as they came off the bus, beside it the DBC that describes them.

    Args:
        path: ends in ``.asc``.
        first_id: identifier of the estimates.

    Raises:
        MissingError: it cannot be written.
    """

    def __init__(self, path: Path, first_id: int) -> None:
        from can.io.asc import ASCWriter

        self.dbc = path.with_suffix(".dbc")
        self.files, self._path = (path, self.dbc), path
        write_dbc(self.dbc, first_id)
        self._writer = _guarded(path, lambda: ASCWriter(path))

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close the log."""
        _guarded(self._path, self._writer.stop)

    def frame(self, frame: Any, stamp: float) -> None:
        """Write a frame."""
        frame.timestamp, frame.channel = stamp, 0
        _guarded(self._path, lambda: self._writer.on_message_received(frame))


def open_output(path: Path | None, names: Sequence[str], first_id: int) -> Output:
    """What writes estimates to a file, by its ending; nothing without a file.

    Raises:
        ConfigurationError: another ending, or a folder.
        MissingError: it cannot be written.
    """
    if path is None:
        return Output()
    check_output(path)
    return TableOutput(path, names) if path.suffix.lower() == ".csv" else LogOutput(path, first_id)


def check_output(path: Path) -> None:
    """See that estimates can be written to a file of that name.

    Raises:
        ConfigurationError: they cannot.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigurationError(f"'{path}' must end in {' or '.join(SUFFIXES)}")
    if path.is_dir():
        raise ConfigurationError(f"'{path}' is a folder; name a file")


def write_dbc(path: Path, first_id: int) -> None:
    """Write the DBC of estimates.

    Raises:
        MissingError: it cannot be written.
    """
    _guarded(path, lambda: path.write_text(dbc_text(first_id), encoding="cp1252"))


def _guarded(path: Path, work: Callable[[], Any]) -> Any:
    try:
        return work()
    except OSError as error:
        raise writing_error(path, error) from error
