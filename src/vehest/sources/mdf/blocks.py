"""Bytes of an MDF file as they are asked for: every address, length, and the number of blocks that are followed, is checked first."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

from vehest.data.errors import DataError, printable
from vehest.data.limits import check_limit

MOST_BLOCKS = 1_000_000  # that a file may chain


class BlockFile:
    """An open file.

    Args:
        stream: of its bytes.
        path: for messages.
    """

    def __init__(self, stream: BinaryIO, path: Path) -> None:
        self.stream, self.path = stream, path
        self.size = stream.seek(0, 2)
        self.followed = 0
        self.text_bytes = 0
        self.texts: dict[int, str] = {}

    def read(self, address: int, length: int) -> bytes:
        """Bytes from an address on.

        Raises:
            DataError: the file ends before them, or cannot be read.
        """
        if address + length > self.size:
            raise self.damaged(f"{length} bytes are announced at byte {address}, the file has {self.size}")
        try:
            self.stream.seek(address)
            content = self.stream.read(length)
        except OSError as error:
            raise DataError(f"cannot read '{self.path}': {error.strerror or error}; check the disk and its permissions") from None
        if len(content) < length:
            raise self.damaged("it became shorter while it was read")
        return content

    def unpack(self, layout: str, address: int) -> tuple[int, ...]:
        """Numbers from an address on."""
        return struct.unpack(layout, self.read(address, struct.calcsize(layout)))

    def follow(self, blocks: int = 1) -> None:
        """Count blocks that are followed.

        Raises:
            DataError: they are more than the limit.
        """
        self.followed += blocks
        if self.followed > MOST_BLOCKS:
            raise DataError(f"'{self.path}' chains more than {MOST_BLOCKS} blocks; it is damaged")

    def keep_text(self, address: int, content: bytes, encoding: str) -> str:
        """A text up to its end, read once."""
        self.text_bytes += len(content)
        check_limit("text_bytes", self.text_bytes, f"'{self.path}' names things in {self.text_bytes} bytes or more")
        plain = content.split(b"\0", 1)[0].strip(b" \r\t\n")
        try:
            text = plain.decode(encoding)
        except UnicodeDecodeError:
            text = plain.decode("latin-1")
        self.texts[address] = text
        return text

    def damaged(self, reason: str) -> DataError:
        """The error for bytes that contradict the format."""
        return DataError(f"'{self.path}' cannot be read as MDF ({printable(reason)}); is it truncated or damaged?")

    def unsupported(self, what: str, fix: str) -> DataError:
        """The error for what the format allows and vehest does not read."""
        return DataError(f"'{self.path}' {what}, which is not read; {fix}")


class Trail:
    """Blocks of one kind that were met, so that none is met twice."""

    def __init__(self, file: BlockFile, what: str) -> None:
        self.file, self.what = file, what
        self.met: set[int] = set()

    def step(self, address: int) -> None:
        """Go to a block.

        Raises:
            DataError: it was met before, or they are too many.
        """
        if address in self.met:
            raise self.file.damaged(f"its {self.what} lead back to the one at byte {address}")
        self.met.add(address)
        self.file.follow()


def shown(name: str) -> str:
    """A name from the file as it stands in messages: printable and not too long."""
    return printable(name if len(name) <= 120 else name[:120] + "…")
