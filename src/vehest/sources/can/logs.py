"""Logs of a CAN bus, .asc, .blf, .trc of PCAN and .log of candump, read by python-can in a limited
process.

file -> frames as arrays (`vehest.sources.readers.can_logs`) -> `Frames`, iterated over as messages
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vehest.data.errors import DataError
from vehest.data.files import regular_file
from vehest.sources.limited import Arrays, read_limited, require_package

# frames that are converted to Python's numbers at a time, which take ten times the memory of an
# array
FRAMES_AT_A_TIME = 1 << 14
SUFFIXES = (".asc", ".blf", ".log", ".trc")  # endings of logs


@dataclass(frozen=True)
class Frames:
    """Frames of a log in their order, without error frames and remote frames.

    Iterated over as messages of python-can.
    """

    file: Path  # the log
    arrays: Arrays  # frames as `vehest.sources.readers.can_logs.read_frames` returns them
    buses: list[Any]  # names or numbers of the buses
    cut_line: str = ""  # last line of a text, which is incomplete and was left out

    def __iter__(self) -> Iterator[Any]:
        """Messages of python-can, made `FRAMES_AT_A_TIME` at a time."""
        from can import Message

        data = self.arrays["data"].data
        at = 0
        names = ("time", "identifier", "extended", "fd", "fast", "length", "bus")
        for begin in range(0, len(self.arrays["time"]), FRAMES_AT_A_TIME):
            rows = slice(begin, begin + FRAMES_AT_A_TIME)
            for time, identifier, extended, fd, fast, length, bus in zip(
                *(self.arrays[name][rows].tolist() for name in names), strict=True
            ):
                yield Message(
                    time,
                    identifier,
                    bool(extended),
                    channel=self.buses[bus],
                    data=bytes(data[at : at + length]),
                    is_fd=bool(fd),
                    bitrate_switch=bool(fast),
                )
                at += length

    @property
    def cut_end(self) -> str:
        """Text on the part of the log that was not read; empty where all was."""
        return f"last line '{self.cut_line}', which has no end" if self.cut_line else ""

    @property
    def last_stamp(self) -> float:
        """The largest stamp [s]."""
        return float(self.arrays["time"].max())


def read_frames(file: Path, selected: Collection[tuple[int, bool]] | None = None) -> Frames:
    """Read the frames of a log.

    Parameters
    ----------
    file : Path
        A log whose name ends in one of `SUFFIXES`.
    selected : collection or None
        Identifier and whether it is extended of each message that is wanted; None for all.

    Raises
    ------
    MissingError
        There is no such file, or python-can is not installed.
    DataError
        It is of another format, damaged, holds no frame, or more than the limits allow.
    """
    if regular_file(file).suffix.lower() not in SUFFIXES:
        raise DataError(
            f"'{file}' is no log of a bus: its name ends in none of {', '.join(SUFFIXES)}"
        )
    require_package("can", "bus", "reading CAN")
    request = None if selected is None else [list(identifier) for identifier in selected]
    reading = read_limited("vehest.sources.readers.can_logs:read_frames", file, selected=request)
    return Frames(file, reading.arrays, reading.summary["buses"], reading.summary["cut_line"])
