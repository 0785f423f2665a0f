"""MAT files of version 5 to 7: structs of numbers, with every length checked.

Format: MathWorks, MAT-File Format, Level 5. SciPy reads these files too, but a damaged one can bring its reader down and the process
with it (1.17.1: a segmentation fault), where one line is wanted. Nothing in a file is executed or unpickled.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vehest.data.errors import DataError
from vehest.data.recording import FloatArray

_HEADER_BYTES = 128
_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_HEAD_BYTES = 1024  # of a compressed array: more than its flags, dimensions and name take

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
            DataError: the file is damaged here.
        """
        try:
            elements = self._elements()
            if elements.is_empty():
                return {}
            kind, _, shape, _ = elements.head()
            if kind != _STRUCT or math.prod(shape) != 1:
                return {}
            return {name: MatArray(f"{self.where}.{name}", self.order, elements.next(_MATRIX)) for name in elements.field_names()}
        except _DamageError as damage:
            raise _damaged(self.where, damage) from None

    def numbers(self) -> FloatArray | None:
        """Real numbers in a row or column, shape (T,); None where it is something else.

        Raises:
            DataError: the file is damaged here.
        """
        try:
            elements = self._elements()
            if elements.is_empty():
                return np.empty(0)
            kind, flags, shape, _ = elements.head()
            if kind not in _NUMERIC or flags & _COMPLEX or (math.prod(shape) and sum(length != 1 for length in shape) > 1):
                return None
            values = elements.numbers()
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
        DataError: it cannot be read, is damaged, or is of another format or version.
    """
    try:
        content = memoryview(file.read_bytes())
    except OSError as error:
        raise DataError(f"'{file}' cannot be read ({error.strerror or error}); check the disk and its permissions") from None
    order = _byte_order(content, file)
    arrays: dict[str, MatArray] = {}
    try:
        elements = _Elements(content[_HEADER_BYTES:], order)
        while not elements.is_empty():
            kind, body = elements.any()
            if kind not in (_MATRIX, _COMPRESSED):
                raise _DamageError(f"something of type {kind} stands where an array belongs")
            head = _inflated(body, order, at_most=_HEAD_BYTES) if kind == _COMPRESSED else body
            name = _Elements(head, order).head()[3] if head else ""
            arrays[name] = MatArray(f"'{file}': {name}", order, body, kind == _COMPRESSED)
    except _DamageError as damage:
        raise _damaged(f"'{file}'", damage) from None
    return arrays


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
        shape = self.numbers().tolist()
        if len(shape) < 2 or min(shape) < 0:
            raise _DamageError(f"an array cannot be of shape {shape}")
        name = _name(bytes(self.any()[1]))
        return int(flags[0]) & 0xFF, int(flags[0]) >> 8 & 0xFF, shape, name

    def field_names(self) -> list[str]:
        width, text = self.numbers(), bytes(self.any()[1])
        if len(width) != 1 or width[0] < 1 or len(text) % int(width[0]):
            raise _DamageError("the names of a struct's fields are cut")
        starts = range(0, len(text), int(width[0]))
        return [_name(text[start : start + int(width[0])].split(b"\0")[0]) for start in starts]


def _name(text: bytes) -> str:
    name = text.decode("ascii", "replace")
    if not (name.isascii() and name.isprintable()):
        raise _DamageError("a name holds what no name can")
    return name


def _inflated(body: memoryview, order: str, at_most: int | None = None) -> memoryview:
    """A compressed array's bytes without the tag, all of them or the first."""
    inflater = zlib.decompressobj()
    try:
        tag = inflater.decompress(body, 8)
        if len(tag) < 8:
            raise _DamageError("a compressed array is cut")
        kind, size = struct.unpack(f"{order}II", tag)
        if kind != _MATRIX:
            raise _DamageError(f"something of type {kind} stands where an array belongs")
        wanted = size if at_most is None else min(size, at_most)
        inflated = inflater.decompress(inflater.unconsumed_tail, wanted) if wanted else b""
        if len(inflated) < wanted:
            raise _DamageError("a compressed array is cut")
        if at_most is None and (inflater.decompress(inflater.unconsumed_tail, 1) or not inflater.eof):
            raise _DamageError("a compressed array is longer than announced, or cut")
    except zlib.error as error:
        raise _DamageError(str(error)) from None
    except MemoryError:
        raise _DamageError("a compressed array announces more bytes than fit into memory") from None
    return memoryview(inflated)


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
