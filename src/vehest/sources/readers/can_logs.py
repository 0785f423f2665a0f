"""Frames of a bus log as arrays, by python-can."""

from __future__ import annotations

import re
from array import array
from collections.abc import Collection, Sequence
from datetime import datetime
from io import TextIOWrapper
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from can.io.asc import ASCReader
from can.io.blf import BLFReader
from can.io.canutils import CanutilsLogReader
from can.io.trc import TRCReader

from vehest.data.errors import DataError, printable
from vehest.data.limits import check_limit
from vehest.sources.limited import Arrays

LATEST = 1e11  # latest time stamp [s]
FRAME = re.compile(r"\s*(\(|\d)")  # matches the start of a line that holds a frame
DATE = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d{6}")  # matches a date and time
# matches the stamp at the start of a line of an .asc [s]
EVENT = re.compile(r"\s*(\d+\.\d+)(?=\s)")
DELTA = re.compile(r"\s*\((\d+\.\d+)\)")  # matches the stamp at the start of a line of candump [s]
# share of stamps that are smaller than the one before, above which stamps count from the last frame
MIN_DECREASE_SHARE = 0.1
N_JUDGED_STAMPS = 2000  # number of first stamps of a log by which this is decided
# matches a frame that is to be sent, which is logged as Tx when it is sent
REQUEST = re.compile(r"\s*\d+\.\d+\s+(CANFD\s+)?\d+\s+(\S+\s+)?TxRq\s")
# matches a frame with a name in place of its identifier
NAMED = re.compile(r"\s*\d+\.\d+\s+\d+\s+(?![0-9A-Fa-f]+x?\s)(\w+)\s+[RT]x\s")
# matches a line that candump writes on the screen
ON_SCREEN = re.compile(
    r"\s*\((?P<time>[\d.: -]+)\)\s+(?P<bus>\S+)\s+([RT]X\s+\S\s*\S\s+)?"
    r"(?P<identifier>[\dA-F]{3,8})\s+"
    r"\[(?P<length>\d+)\]\s*(?P<data>([\dA-F]{2}(\s|$))*|remote request)"
)


def read_frames(
    file: Path, selected: Collection[Sequence[Any]] | None
) -> tuple[Arrays, dict[str, Any]]:
    """Frames of a log in their order, without error frames and remote frames.

    Parameters
    ----------
    file : Path
        A log whose ending is ``.blf``, ``.asc``, ``.trc`` or ``.log``.
    selected : collection or None
        Identifier and whether it is extended of each message that is wanted; None for all.

    Returns
    -------
    arrays : dict
        ``time`` [s], ``identifier``, ``extended``, ``fd``, ``fast`` (bit rate switched), ``length``
        [bytes] and ``bus`` (number in ``buses`` of the summary) of each frame, and ``data``, the
        bytes of all, one frame behind the other.
    summary : dict
        ``buses``, their names or numbers; ``cut_line``, the last line, which has no end and was
        left out.

    Raises
    ------
    DataError
        The log is truncated, holds no frame, more than the limits allow, or one at no time of a
        drive.
    """
    identifiers_read = {
        (int(identifier), bool(extended)) for identifier, extended in selected or ()
    }
    times = array("d")
    identifiers = array("L")
    buses = array("L")
    data = bytearray()
    flags = {name: bytearray() for name in ("extended", "fd", "fast", "length")}
    numbers: dict[Any, int] = {}
    count = 0
    with _opened(file) as reader:
        if isinstance(reader, BLFReader) and reader.file_size > file.stat().st_size:
            raise DataError(
                f"'{file}' is truncated: it says that it is {reader.file_size} bytes long; fetch "
                "it again"
            )
        for frame in reader:
            count += 1
            check_limit("samples", count, f"'{file}' holds {count} frames or more")
            if frame.is_error_frame or frame.is_remote_frame:
                continue
            if not abs(frame.timestamp) < LATEST:
                raise DataError(
                    f"'{file}': frame {count} is stamped {frame.timestamp:.6g} s; the file is "
                    "damaged"
                )
            identifier = frame.arbitration_id, frame.is_extended_id
            if selected is not None and identifier not in identifiers_read:
                continue
            times.append(frame.timestamp)
            identifiers.append(frame.arbitration_id)
            bus = frame.channel - 1 if isinstance(reader, TRCReader) else frame.channel
            buses.append(numbers.setdefault(bus, len(numbers)))
            flags["extended"].append(frame.is_extended_id)
            flags["fd"].append(frame.is_fd)
            flags["fast"].append(frame.bitrate_switch)
            flags["length"].append(len(frame.data))
            data += frame.data
        cut_line = printable(getattr(reader.file, "cut_line", "").strip()[:60])
    if not count:
        raise DataError(f"'{file}' holds no frame; is it a log of a bus?")
    arrays = {"time": times, "identifier": identifiers, "bus": buses}
    octets = {**flags, "data": data}
    return {
        **{name: np.array(values) for name, values in arrays.items()},
        **{name: np.frombuffer(values, np.uint8) for name, values in octets.items()},
    }, {"buses": list(numbers), "cut_line": cut_line}


def _opened(file: Path) -> Any:
    """A reader; texts are opened here, since their comments are of any encoding."""
    match file.suffix.lower():
        case ".blf":
            return BLFReader(file)
        case ".asc":
            return ASCReader(_VectorText(file))
        case ".trc":
            return TRCReader(_LogText(file))
    return CanutilsLogReader(_CandumpText(file))


class _LogText(TextIOWrapper):
    """Lines of a log, as python-can understands them."""

    def __init__(self, file: Path) -> None:
        super().__init__(open(file, "rb"), encoding="utf-8", errors="replace")  # noqa: SIM115
        self.file = file
        self.cut_line = ""  # the last one, where it has no end and is left out

    def __next__(self) -> str:  # type: ignore[override]
        """The next line that python-can understands."""
        line = super().__next__()
        if line.endswith("\n"):
            return line
        self.cut_line = line if FRAME.match(line) else ""
        return ""


class _VectorText(_LogText):
    """Lines of an .asc, with stamps that count from the start of the measurement.

    Where the file writes the time since the event before, as ``timestamps relative`` means, they
    are summed; some loggers write these words above stamps that never decrease, which stay.
    """

    def __init__(self, file: Path) -> None:
        super().__init__(file)
        self.is_relative = _counts_from_last_event(file)
        self.elapsed = 0.0

    def __next__(self) -> str:  # type: ignore[override]
        """The next line, its stamp counted from the start of the measurement."""
        line = super().__next__()
        if self.is_relative and (event := EVENT.match(line)):
            self.elapsed += float(event[1])
            line = f"{self.elapsed:.9f}{line[event.end() :]}"
        if named := NAMED.match(line):
            raise DataError(
                f"'{self.file}' has names of messages such as '{printable(named[1])}' in place of "
                "identifiers; export it with numeric identifiers"
            )
        return "" if REQUEST.match(line) else line


def _counts_from_last_event(file: Path) -> bool:
    """Whether stamps of an .asc count from the event before."""
    with _LogText(file) as lines:
        head = "".join(line for _, line in zip(range(10), lines, strict=False))
        if not re.search(r"timestamps\s+relative", head, re.IGNORECASE):
            return False
        stamps = (float(event[1]) for line in lines if (event := EVENT.match(line)))
        return any(later < earlier for earlier, later in pairwise(stamps))


def _counts_from_last_frame(file: Path) -> bool:
    """Whether stamps of candump count from the frame before, as those of its option -td."""
    with _LogText(file) as lines:
        matches = (frame for line in lines if (frame := DELTA.match(line)))
        stamps = [float(frame[1]) for frame in islice(matches, N_JUDGED_STAMPS)]
    n_decreasing = sum(later < earlier for earlier, later in pairwise(stamps))
    return n_decreasing > MIN_DECREASE_SHARE * len(stamps)


class _CandumpText(_LogText):
    """Lines of candump, also of what it writes on the screen, as those of its log.

    Stamps that count from the frame before are summed.
    """

    def __init__(self, file: Path) -> None:
        super().__init__(file)
        self.is_relative = _counts_from_last_frame(file)
        self.elapsed = 0.0

    def __next__(self) -> str:  # type: ignore[override]
        """The next line as candump's log has it."""
        line = super().__next__()
        if self.is_relative and (stamp := DELTA.match(line)):
            self.elapsed += float(stamp[1])
            line = f"({self.elapsed:.6f}){line[stamp.end() :]}"
        if (frame := ON_SCREEN.match(line)) is None:
            return line
        fd = "#0" if len(frame["length"]) > 1 else ""  # two digits are those of CAN FD
        data = frame["data"].replace(" ", "").replace("remoterequest", "R").strip()
        time = frame["time"]
        if DATE.fullmatch(time):
            time = f"{datetime.fromisoformat(f'{time}+00:00').timestamp():.6f}"
        return f"({time}) {frame['bus']} {frame['identifier']}#{fd}{data}\n"
