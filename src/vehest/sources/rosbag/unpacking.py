"""Zstandard and LZ4 as bags use them: unpacked up to what is announced or allowed, never beyond."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, BinaryIO

from vehest.data.errors import MissingError
from vehest.data.files import writing_error
from vehest.data.limits import check_unpacked

BLOCK = 1 << 20
MOST_AT_ONCE = 256 * 2**20  # of one message, or of one chunk of MCAP


class DamagedBagError(Exception):
    """The bytes of a bag contradict its format."""


class Unpacked:
    """Counts what a file unpacks to.

    Args:
        path: for messages.
        packed: size of the file [bytes].
    """

    def __init__(self, path: Path, packed: int) -> None:
        self.path, self.packed, self.bytes = path, packed, 0

    def count(self, more: int) -> None:
        """Count bytes.

        Raises:
            DataError: they are more than the limits.
        """
        self.bytes += more
        check_unpacked(self.path, self.packed, self.bytes)

    def block(self, content: bytes, compression: str, announced: int | None) -> bytes:
        """A block as it was before it was compressed.

        Args:
            content: compressed.
            compression: ``zstd``, ``lz4``, or nothing.
            announced: how long it is; None where nothing says so.

        Raises:
            DamagedBagError: it is something else, or of another length.
            DataError: it is more than the limits.
        """
        most = MOST_AT_ONCE if announced is None else announced
        if most > MOST_AT_ONCE:
            raise DamagedBagError(f"{most} bytes are announced in one block")
        if announced is not None:
            self.count(announced)
        plain = content if not compression else _unpack(content, compression, most)
        if announced is None:
            self.count(len(plain))
        elif len(plain) != announced:
            raise DamagedBagError(f"a block of {len(plain)} bytes announces {announced}")
        return plain


def unpack_zstd(file: Path, to: Path) -> None:
    """Unpack a file that ROS has compressed as a whole.

    Raises:
        DamagedBagError: it is no Zstandard, or cut.
        DataError: it unpacks to more than the limits.
        MissingError: there is no room for it.
    """
    zstd = _zstd()
    counted = Unpacked(file, file.stat().st_size)
    with open(file, "rb") as packed, _written(to) as plain:
        decompressor = zstd.ZstdDecompressor()
        started = False
        while block := packed.read(BLOCK):
            while True:
                if decompressor.eof:
                    block, decompressor = decompressor.unused_data or block, zstd.ZstdDecompressor()
                started = True
                try:
                    content = decompressor.decompress(block, BLOCK)
                except zstd.ZstdError as error:
                    raise DamagedBagError(str(error)) from None
                counted.count(len(content))
                try:
                    plain.write(content)
                except OSError as error:
                    raise writing_error(to, error) from None
                block = b""
                if (decompressor.eof and not decompressor.unused_data) or (not decompressor.eof and decompressor.needs_input):
                    break
        if not started or not decompressor.eof:
            raise DamagedBagError("it ends in the middle")


def _written(to: Path) -> BinaryIO:
    try:
        return open(to, "xb")
    except OSError as error:
        raise writing_error(to, error) from None


def _unpack(content: bytes, compression: str, most: int) -> bytes:
    if compression == "zstd":
        zstd = _zstd()
        decompressor = zstd.ZstdDecompressor()
        failures: Any = zstd.ZstdError
    elif compression == "lz4":
        import lz4.frame

        decompressor, failures = lz4.frame.LZ4FrameDecompressor(), RuntimeError
    else:
        raise DamagedBagError(f"it is compressed by '{compression[:20]}', neither zstd nor lz4")
    try:
        plain: bytes = decompressor.decompress(content, most + 1)
    except (failures, EOFError, ValueError) as error:
        raise DamagedBagError(f"a compressed block: {error}") from None
    if len(plain) > most:
        raise DamagedBagError(f"a block unpacks to more than {most} bytes")
    if not decompressor.eof:
        raise DamagedBagError("a compressed block is cut")
    return plain


def _zstd() -> Any:
    try:
        if sys.version_info >= (3, 14):
            from compression import zstd
        else:
            from backports import zstd
    except ImportError:
        raise MissingError("reading compressed ROS 2 bags needs the package rosbags; pip install 'vehest[ros]'") from None
    return zstd
