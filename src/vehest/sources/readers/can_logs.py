"""Frames of a bus log as arrays, by python-can."""

from __future__ import annotations

from array import array
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from can.io.asc import ASCReader
from can.io.blf import BLFReader
from can.io.canutils import CanutilsLogReader

from vehest.data.errors import DataError
from vehest.data.limits import check_limit
from vehest.sources.limited import Arrays

LATEST = 1e11  # s


def read_frames(
    file: Path, selected: Collection[Sequence[Any]] | None
) -> tuple[Arrays, dict[str, Any]]:
    """Frames of a log in their order, without error frames and remote frames.

    Parameters
    ----------
    file : Path
        A log whose ending is ``.blf``, ``.asc`` or ``.log``.
    selected : collection or None
        Identifier and whether it is extended of each message that is wanted; None for all.

    Returns
    -------
    arrays : dict
        ``time`` [s], ``identifier``, ``extended``, ``fd``, ``fast`` (bit rate switched), ``length``
        [bytes] and ``bus`` (number in ``buses`` of the summary) of each frame, and ``data``, the
        bytes of all, one frame behind the other.
    summary : dict
        ``buses``, their names or numbers.

    Raises
    ------
    DataError
        The log is truncated, holds no frame, more than the limits allow, or one at no time of a
        drive.
    """
    identifiers_read = (
        None
        if selected is None
        else {(int(identifier), bool(extended)) for identifier, extended in selected}
    )
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
            if (
                identifiers_read is not None
                and (frame.arbitration_id, frame.is_extended_id) not in identifiers_read
            ):
                continue
            times.append(frame.timestamp)
            identifiers.append(frame.arbitration_id)
            buses.append(numbers.setdefault(frame.channel, len(numbers)))
            flags["extended"].append(frame.is_extended_id)
            flags["fd"].append(frame.is_fd)
            flags["fast"].append(frame.bitrate_switch)
            flags["length"].append(len(frame.data))
            data += frame.data
    if not count:
        raise DataError(f"'{file}' holds no frame; is it a log of a bus?")
    arrays = {
        name: np.frombuffer(values, np.uint8) for name, values in {**flags, "data": data}.items()
    }
    return {
        "time": np.array(times),
        "identifier": np.array(identifiers),
        "bus": np.array(buses),
        **arrays,
    }, {"buses": list(numbers)}


def _opened(file: Path) -> Any:
    """A reader; texts are opened here, since their comments are of any encoding."""
    if file.suffix.lower() == ".blf":
        return BLFReader(file)
    text = open(file, encoding="utf-8", errors="replace")  # noqa: SIM115 (the reader closes it)
    return ASCReader(text) if file.suffix.lower() == ".asc" else CanutilsLogReader(text)
