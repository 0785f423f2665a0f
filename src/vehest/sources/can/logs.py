"""Frames of bus logs through python-can: .asc, .blf, .log of candump.

python-can believes lengths that a file states and unpacks whatever is packed. What a file asks for is therefore counted before it gets it:
lines of text, and of a BLF file every object, container and what that unpacks to.
"""

from __future__ import annotations

import logging
import math
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from vehest.data.errors import DataError, MissingError, VehestError
from vehest.data.files import regular_file
from vehest.data.limits import check_limit, check_unpacked
from vehest.data.text_files import first_line
from vehest.sources.text_tables import check_size

SUFFIXES = (".asc", ".blf", ".log")
LONGEST_LINE = 1 << 16  # bytes; a frame of CAN FD takes 400
HEAD, CONTAINER, STAMPED, CANDIDATES = 144, 10, 32, 8  # bytes of a file's head; kind; least bytes of an object with a time; of padding
MOST_OBJECT = 1 << 20  # bytes of one object, such as a frame of Ethernet
MOST_CONTAINER = 64 << 20  # bytes that one container unpacks to; loggers take 128 KiB
LATEST = 1e11  # s


def frames_of(file: Path) -> Iterator[Any]:
    """Frames of a log in their order, without error frames and remote frames: objects of python-can with finite time stamps.

    Raises:
        MissingError: there is no such file, or python-can is not installed.
        DataError: it is of another format, damaged, truncated or more than the limits.
    """
    suffix = regular_file(file).suffix.lower()
    if suffix not in SUFFIXES:
        raise DataError(f"'{file}' is no log of a bus: its name ends in none of {', '.join(SUFFIXES)}")
    if file.stat().st_size == 0:
        raise DataError(f"'{file}' is empty")
    check_log(file)
    count = 0
    try:
        with _speechless(), _opened(file, suffix) as reader:
            for frame in reader:
                count += 1
                check_limit("samples", count, f"'{file}' holds {count} frames or more")
                if frame.is_error_frame or frame.is_remote_frame:
                    continue
                if not (math.isfinite(frame.timestamp) and abs(frame.timestamp) < LATEST):
                    raise DataError(f"'{file}': frame {count} is stamped {frame.timestamp:.6g} s; the file is damaged")
                yield frame
    except VehestError:
        raise
    except ImportError:
        raise MissingError("reading CAN needs the packages python-can and cantools; pip install 'vehest[bus]'") from None
    except OSError as error:
        raise DataError(f"cannot read '{file}': {error.strerror or error}; check the disk and its permissions") from None
    except Exception as error:  # whatever a parser meets in a damaged file
        raise _damaged(file, f"after {count} frames: {first_line(error)[:160] or type(error).__name__}") from None
    if not count:
        raise DataError(f"'{file}' holds no frame; is it a log of a bus?")


def check_log(file: Path) -> None:
    """See that what a log asks for stays within the limits, before it is parsed.

    Raises:
        DataError: it does not, or the file is damaged or truncated.
    """
    if file.suffix.lower() == ".blf":
        _check_blf(file)
    else:
        check_size(file, 1, LONGEST_LINE)


@contextmanager
def _speechless() -> Iterator[None]:
    """Keep python-can from printing a line for every object that it does not know."""
    logger = logging.getLogger("can.io")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


def _opened(file: Path, suffix: str) -> Any:
    """A reader of python-can; texts are opened here, since their comments are of any encoding."""
    from can.io.asc import ASCReader
    from can.io.blf import BLFReader
    from can.io.canutils import CanutilsLogReader

    if suffix == ".blf":
        return BLFReader(file)
    text = open(file, encoding="utf-8", errors="replace")  # noqa: SIM115 (the reader closes it)
    return ASCReader(text) if suffix == ".asc" else CanutilsLogReader(text)


def _check_blf(file: Path) -> None:
    """Go through all objects of a BLF file as its reader will: none may end it early, hold it or unpack to more than the limits."""
    size = file.stat().st_size
    try:
        with open(file, "rb") as stream:
            head = stream.read(8)
            if head[:4] != b"LOGG":
                raise DataError(f"'{file}' is no BLF file: it does not begin with 'LOGG'")
            length = int.from_bytes(head[4:8], "little")
            if not 72 <= length <= min(size, 1 << 16) or size < HEAD:
                raise _damaged(file, f"its head says that it is {length} bytes long")
            stream.seek(length)
            _check_objects(file, stream, size)
    except OSError as error:
        raise DataError(f"cannot read '{file}': {error.strerror or error}; check the disk and its permissions") from None


def _check_objects(file: Path, stream: BinaryIO, size: int) -> None:
    """The outer objects, of which containers are unpacked."""
    unpacked = 0
    tail = b""
    while True:
        at = stream.tell()
        base = stream.read(16)
        if not base:
            if tail.lstrip(b"\0"):
                raise DataError(f"'{file}' is truncated: its last object goes on behind its end; fetch it again")
            return
        if len(base) < 16 or base[:4] != b"LOBJ":
            raise _damaged(file, f"no object begins at byte {at}")
        length, kind = struct.unpack("<LL", base[8:16])
        if length < 32:
            raise _damaged(file, f"the object at byte {at} says that it is {length} bytes long")
        if at + length > size:
            raise DataError(
                f"'{file}' is truncated: the object at byte {at} ends {at + length - size} bytes behind the file; fetch it again"
            )
        if kind == CONTAINER:
            if length > MOST_CONTAINER:
                raise _damaged(file, f"the container at byte {at} is {length} bytes long")
            content = _content(file, stream.read(length - 16), at)
            unpacked += len(content)
            check_unpacked(file, size, unpacked)
            tail = _check_inner(file, tail + content, at)
        stream.seek(at + length + length % 4)


def _content(file: Path, data: bytes, at: int) -> bytes:
    """What a container unpacks to, bounded."""
    method, packed = int.from_bytes(data[:2], "little"), data[16:]
    if method == 0:
        return packed
    if method != 2:
        raise _damaged(file, f"the container at byte {at} is packed by method {method}; 0 and 2 are known")
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(packed, MOST_CONTAINER)
    except zlib.error as error:
        raise _damaged(file, f"the container at byte {at}: {error}") from None
    if not unpacker.eof:
        what = f"unpacks to more than {MOST_CONTAINER} bytes" if unpacker.unconsumed_tail else "is cut"
        raise _damaged(file, f"the container at byte {at} {what}")
    return content


def _check_inner(file: Path, data: bytes, container: int) -> bytes:
    """Objects in a container, each as long as it says; returns what goes on in the next one."""
    at = 0
    while True:
        found = data.find(b"LOBJ", at, at + CANDIDATES)
        if found < 0:
            if at + CANDIDATES > len(data):
                return data[at:]
            raise _damaged(file, f"in the container at byte {container} no object begins at {at}")
        if found + 16 > len(data):
            return data[at:]
        length = struct.unpack_from("<L", data, found + 8)[0]
        if not STAMPED <= length <= MOST_OBJECT:
            raise _damaged(file, f"in the container at byte {container} the object at {found} says that it is {length} bytes long")
        if found + length > len(data):
            return data[at:]
        at = found + length


def _damaged(file: Path, what: str) -> DataError:
    return DataError(f"'{file}' cannot be read as a log of a bus ({what}); is it truncated or damaged?")
