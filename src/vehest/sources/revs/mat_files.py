"""MAT files of version 5 to 7: structs of numbers, with every length checked.

Format: MathWorks, MAT-File Format, Level 5. SciPy reads these files too, but a damaged one can bring its reader down and the process
with it (1.17.1: a segmentation fault), where one line is wanted. Nothing in a file is executed or unpickled.
"""

from __future__ import annotations

import math
import mmap
import struct
import zlib
from collections.abc import Container
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.files import regular_file
from vehest.data.limits import check_limit, check_unpacked, current_limits

_HEADER_BYTES = 128
_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_HEAD_BYTES = 1024  # of a compressed array: more than its flags, dimensions and name take
_MOST_DIMENSIONS, _MOST_LETTERS = 32, 255  # of an array and of a name; MATLAB writes names of at most 63
_MOST_DEFLATED = 1040  # times: no deflated byte stands for more
_CHUNK, _PACKED_CHUNK = 1 << 17, 1 << 14
_SAMPLE_BYTES = 32  # of a field with values and time stamps, and what else it may hold of a sample

_MATRIX, _COMPRESSED = 14, 15  # types of elements
_NUMBER_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_STRUCT, _NUMERIC = 2, range(6, 16)  # classes of arrays: structs; double, single and whole numbers
_COMPLEX = 0x08


@dataclass(frozen=True)
class MatArray:
    """One array of a MAT file, decoded when it is asked for.

    Args:
        where: file and name, for messages.
        order: byte order, ``<`` or ``>``.
        body: its bytes without the tag, as they are or compressed.
        compressed: whether they are compressed.
    """

    where: str
    order: str
    body: memoryview
    compressed: bool = False

    def fields(self) -> dict[str, MatArray]:
        """Fields of a struct; none where it is something else, or an array of several structs.

        Raises:
            DataError: the file is damaged here, or a field is more than the limits.
        """
        return {name: field for name, field in self.some_fields(None).items() if field is not None}

    def some_fields(self, wanted: Container[str] | None) -> dict[str, MatArray | None]:
        """Fields of a struct by name; of a compressed one, those that are not wanted are passed by and stand as None.

        Args:
            wanted: names; None for all.

        Raises:
            DataError: the file is damaged here, or a field is more than the limits.
        """
        try:
            if self.compressed:
                return self._streamed_fields(wanted)
            elements = self._elements()
            if not _is_struct(elements):
                return {}
            return {name: MatArray(f"{self.where}.{name}", self.order, elements.next(_MATRIX)) for name in elements.field_names()}
        except _DamageError as damage:
            raise _damaged(self.where, damage) from None

    def _streamed_fields(self, wanted: Container[str] | None) -> dict[str, MatArray | None]:
        """Fields of a compressed struct, of which only those that are wanted are ever in memory."""
        stream = _Inflation(self.body, self.order)
        if not stream.left:
            return {}
        head = b"".join(stream.element(_HEAD_BYTES) for _ in range(3))
        if not _is_struct(_Elements(memoryview(head), self.order)):
            return {}
        described = b"".join(stream.element(current_limits().text_bytes) for _ in range(2))
        fields: dict[str, MatArray | None] = {}
        for name in _Elements(memoryview(described), self.order).field_names():
            kind, size = struct.unpack(f"{self.order}II", stream.read(8))
            if kind != _MATRIX:
                raise _DamageError(f"type {_MATRIX} is expected, type {kind} was found")
            where, kept = f"{self.where}.{name}", wanted is None or name in wanted
            if kept:
                check_limit("samples", size // _SAMPLE_BYTES, f"{where} holds {size} bytes, as many as {size // _SAMPLE_BYTES} samples")
            body = stream.read(size) if kept else stream.skip(size)
            stream.skip(min(-size % 8, stream.left))
            fields[name] = MatArray(where, self.order, memoryview(body)) if kept else None
        stream.finish()
        return fields

    def numbers(self) -> FloatArray | None:
        """Real numbers in a row or column, shape (T,); None where it is something else.

        Raises:
            DataError: the file is damaged here.
        """
        try:
            if self.compressed:
                head = _Elements(_inflated(self.body, self.order, at_most=_HEAD_BYTES), self.order)
                if not head.is_empty() and head.head()[0] not in _NUMERIC:
                    return None
            elements = self._elements()
            if elements.is_empty():
                return np.empty(0)
            kind, flags, shape, _ = elements.head()
            if kind not in _NUMERIC or flags & _COMPLEX or (math.prod(shape) and sum(length != 1 for length in shape) > 1):
                return None
            values = elements.numbers()
            check_limit("samples", len(values), f"{self.where} holds {len(values)} numbers")
            if len(values) != math.prod(shape):
                raise _DamageError(f"{math.prod(shape)} numbers are announced, {len(values)} are there")
            return values.astype(np.float64)
        except _DamageError as damage:
            raise _damaged(self.where, damage) from None

    def _elements(self) -> _Elements:
        return _Elements(_inflated(self.body, self.order) if self.compressed else self.body, self.order)


def read_mat_file(file: Path) -> dict[str, MatArray]:
    """The arrays of a MAT file by their names.

    Raises:
        MissingError: there is no such file.
        DataError: it cannot be read, is damaged, of another format or version, or would unpack to more than the limits.
    """
    try:
        with open(regular_file(file), "rb") as stream:
            size = stream.seek(0, 2)
            content = memoryview(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) if size else b"")
    except OSError as error:
        raise DataError(f"'{file}' cannot be read ({error.strerror or error}); check the disk and its permissions") from None
    order = _byte_order(content, file)
    arrays: dict[str, MatArray] = {}
    unpacked = 0
    try:
        elements = _Elements(content[_HEADER_BYTES:], order)
        while not elements.is_empty():
            kind, body = elements.any()
            unpacked += _announced(body, order) if kind == _COMPRESSED else 0
            check_unpacked(file, len(content), unpacked)
            if kind not in (_MATRIX, _COMPRESSED):
                raise _DamageError(f"something of type {kind} stands where an array belongs")
            head = _inflated(body, order, at_most=_HEAD_BYTES) if kind == _COMPRESSED else body
            name = _Elements(head, order).head()[3] if head else ""
            arrays[name] = MatArray(f"'{file}': {name}", order, body, kind == _COMPRESSED)
    except _DamageError as damage:
        raise _damaged(f"'{file}'", damage) from None
    return arrays


def _is_struct(elements: _Elements) -> bool:
    """Whether one struct stands there; its head is passed."""
    if elements.is_empty():
        return False
    kind, _, shape, _ = elements.head()
    return kind == _STRUCT and math.prod(shape) == 1


class _DamageError(Exception):
    """The bytes contradict the format."""


class _Elements:
    """Tagged pieces of a MAT file, one after another."""

    def __init__(self, data: memoryview, order: str) -> None:
        self.data, self.order = data, order

    def is_empty(self) -> bool:
        return not self.data

    def any(self) -> tuple[int, memoryview]:
        """Type and bytes of the next piece."""
        if len(self.data) < 8:
            raise _DamageError("it ends in the middle of an array")
        kind, size = struct.unpack_from(f"{self.order}II", self.data)
        if kind >> 16:  # up to four bytes stand within the tag
            kind, size, start, end = kind & 0xFFFF, kind >> 16, 4, 8
            if size > 4:
                raise _DamageError(f"{size} bytes are announced where 4 have room")
        else:
            start, end = 8, 8 + size + (-size % 8 if kind != _COMPRESSED else 0)
        if start + size > len(self.data):
            raise _DamageError(f"{size} bytes are announced, {len(self.data) - start} are left")
        body, self.data = self.data[start : start + size], self.data[end:]
        return kind, body

    def next(self, wanted: int) -> memoryview:
        """Bytes of the next piece, which must be of a type."""
        kind, body = self.any()
        if kind != wanted:
            raise _DamageError(f"type {wanted} is expected, type {kind} was found")
        return body

    def numbers(self) -> np.ndarray:
        """Numbers of the next piece."""
        kind, body = self.any()
        if kind not in _NUMBER_TYPES:
            raise _DamageError(f"numbers are expected, type {kind} was found")
        dtype = np.dtype(self.order + _NUMBER_TYPES[kind])
        if len(body) % dtype.itemsize:
            raise _DamageError(f"{len(body)} bytes hold no whole number of values")
        return np.frombuffer(body, dtype)

    def head(self) -> tuple[int, int, list[int], str]:
        """Class, flags, shape and name, which every array begins with."""
        flags = self.numbers()
        if len(flags) != 2:
            raise _DamageError("the flags of an array are missing")
        shape = self.numbers()[: _MOST_DIMENSIONS + 1].tolist()
        if not 2 <= len(shape) <= _MOST_DIMENSIONS or min(shape) < 0:
            raise _DamageError(f"an array cannot be of shape {shape[:_MOST_DIMENSIONS]}")
        name = _name(bytes(self.any()[1]))
        return int(flags[0]) & 0xFF, int(flags[0]) >> 8 & 0xFF, shape, name

    def field_names(self) -> list[str]:
        width, text = self.numbers(), bytes(self.any()[1])
        if len(width) != 1 or width[0] < 1 or len(text) % int(width[0]):
            raise _DamageError("the names of a struct's fields are cut")
        starts = range(0, len(text), int(width[0]))
        return [_name(text[start : start + int(width[0])].split(b"\0")[0]) for start in starts]


def _name(text: bytes) -> str:
    name = text[: _MOST_LETTERS + 1].decode("ascii", "replace")
    if len(name) > _MOST_LETTERS or not (name.isascii() and name.isprintable()):
        raise _DamageError("a name holds what no name can")
    return name


def _announced(body: memoryview, order: str) -> int:
    """How many bytes a compressed array says it unpacks to."""
    try:
        tag = zlib.decompressobj().decompress(body[:_HEAD_BYTES], 8)
    except zlib.error as error:
        raise _DamageError(str(error)) from None
    if len(tag) < 8:
        raise _DamageError("a compressed array is cut")
    size: int = struct.unpack(f"{order}II", tag)[1]
    if size > _MOST_DEFLATED * (len(body) + 1):
        raise _DamageError(f"a compressed array of {len(body)} bytes announces {size}")
    return size


class _Inflation:
    """A compressed array's bytes without the tag, as they are asked for."""

    def __init__(self, body: memoryview, order: str) -> None:
        self.inflater, self.body, self.at, self.waiting, self.order = zlib.decompressobj(), body, 0, b"", order
        self.left = 8
        kind, self.left = struct.unpack(f"{order}II", self.read(8))
        if kind != _MATRIX:
            raise _DamageError(f"something of type {kind} stands where an array belongs")

    def read(self, length: int) -> bytearray:
        """The next bytes."""
        if length > self.left:
            raise _DamageError(f"{length} bytes are announced, {self.left} are left")
        self.left -= length
        inflated = bytearray()
        try:
            while len(inflated) < length and not self.inflater.eof and (self.waiting or self.at < len(self.body)):
                if not self.waiting:
                    self.waiting, self.at = bytes(self.body[self.at : self.at + _PACKED_CHUNK]), self.at + _PACKED_CHUNK
                inflated += self.inflater.decompress(self.waiting, min(_CHUNK, length - len(inflated)))
                self.waiting = self.inflater.unconsumed_tail
        except zlib.error as error:
            raise _DamageError(str(error)) from None
        except MemoryError:
            raise _DamageError("a compressed array announces more bytes than fit into memory") from None
        if len(inflated) < length:
            raise _DamageError("a compressed array is cut")
        return inflated

    def skip(self, length: int) -> bytearray:
        """Pass bytes by."""
        for start in range(0, length, _CHUNK):
            self.read(min(_CHUNK, length - start))
        return bytearray()

    def element(self, most: int) -> bytes:
        """The next small element with its tag."""
        tag = bytes(self.read(8))
        kind, size = struct.unpack(f"{self.order}II", tag)
        if kind >> 16:
            return tag
        if size > most:
            raise _DamageError(f"{size} bytes stand where a few belong")
        return tag + bytes(self.read(size + -size % 8))

    def finish(self) -> None:
        """See that nothing follows."""
        try:
            rest = self.inflater.decompress(self.waiting + bytes(self.body[self.at :]), 1)
        except zlib.error as error:
            raise _DamageError(str(error)) from None
        if self.left or rest or not self.inflater.eof:
            raise _DamageError("a compressed array is longer than announced, or cut")


def _inflated(body: memoryview, order: str, at_most: int | None = None) -> memoryview:
    """A compressed array's bytes without the tag, all of them or the first."""
    stream = _Inflation(body, order)
    content = stream.read(stream.left if at_most is None else min(stream.left, at_most))
    if at_most is None:
        stream.finish()
    return memoryview(content).toreadonly()


def _byte_order(content: memoryview, file: Path) -> str:
    header = bytes(content[:_HEADER_BYTES])
    if header.startswith(_HDF5_SIGNATURE) or header.startswith(b"MATLAB 7.3") or bytes(content[512:520]) == _HDF5_SIGNATURE:
        raise DataError(f"'{file}' is a MAT file of version 7.3 (HDF5), which is not read; save it with -v7 in MATLAB, or set layout: csv")
    order = {b"IM": "<", b"MI": ">"}.get(header[126:128])
    if order is None or struct.unpack_from(f"{order}H", header, 124)[0] != 0x0100:
        raise DataError(f"'{file}' is no MAT file of version 5 to 7, or it is truncated; fetch it again")
    return order


def _damaged(where: str, damage: _DamageError) -> DataError:
    return DataError(f"{where} is truncated or damaged ({damage}); fetch it again")
