"""The two files of ROS 2 bags, SQLite databases and MCAP, as messages: every length, number and chain is checked before it is followed."""

from __future__ import annotations

import sqlite3
import struct
import zlib
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

from vehest.data.errors import printable
from vehest.data.limits import check_limit, current_limits
from vehest.sources.rosbag.unpacking import DamagedBagError, Unpacked

LATEST = 2**62  # ns of unix time: 146 years
MOST_TOPICS = 10_000
MOST_BLOB = 256 * 2**20
_FORMATS: Mapping[str, Literal["msg", "idl", ""]] = {"ros2msg": "msg", "ros2idl": "idl", "omgidl": "idl", "": ""}


@dataclass(frozen=True)
class HeldTopic:
    """What a file holds of one topic.

    Args:
        number: by which its messages refer to it.
        name: of the topic.
        type: of its messages.
        encoding: of its messages, ``cdr``.
        format: of the layout that the file brings along; empty where it brings none.
        layout: of the messages, as text.
        count: how many messages the file says it holds; None where it does not say.
    """

    number: int
    name: str
    type: str
    encoding: str
    format: Literal["msg", "idl", ""]
    layout: str
    count: int | None


Message = tuple[int, int, bytes]  # number of the topic, received [ns], content


class Storage(ABC):
    """An open file of a bag.

    Attributes:
        topics: that it holds.
        start: when its first message was received [ns of unix time]; None where there is none.
    """

    topics: list[HeldTopic]
    start: int | None

    @abstractmethod
    def messages(self, numbers: Collection[int]) -> Iterator[Message]:
        """Messages of topics, in the order in which they stand."""

    @abstractmethod
    def close(self) -> None:
        """Let go of the file."""


def open_storage(file: Path, kind: str | None = None) -> Storage:
    """Open a file of a bag.

    Args:
        file: a regular file.
        kind: ``sqlite3`` or ``mcap``; None: by its ending.

    Raises:
        DamagedBagError: it contradicts its format.
        DataError: it is more than the limits.
    """
    if (kind or file.suffix.lower()) in ("mcap", ".mcap"):
        return McapStorage(file)
    return SqliteStorage(file)


class SqliteStorage(Storage):
    """A SQLite database: tables alone, whose rows are counted before they are read.

    Views, triggers, virtual tables and computed columns would run what the file says; a database of ROS has none.
    """

    def __init__(self, file: Path) -> None:
        self.size = file.stat().st_size
        self.connection = sqlite3.connect(f"file:{quote(str(file))}?mode=ro&immutable=1", uri=True)
        try:
            self._guard()
            self._refuse_programs()
            self._count()
            self.topics = self._topics()
        except BaseException:
            self.connection.close()
            raise

    def messages(self, numbers: Collection[int]) -> Iterator[Message]:
        """Messages of topics, in the order in which they stand."""
        if len(numbers) > MOST_TOPICS:
            raise DamagedBagError(f"it holds {len(numbers)} topics")
        marks = ",".join("?" * len(numbers))
        with _as_damage():
            query = f"SELECT topic_id, timestamp, data FROM messages NOT INDEXED WHERE topic_id IN ({marks})"
            yield from self.connection.execute(query, tuple(numbers))

    def close(self) -> None:
        """Let go of the file."""
        self.connection.close()

    def _guard(self) -> None:
        """Bounds on what SQLite itself may do."""
        left = [100 + self.size // 1000]
        connection = self.connection

        def is_over() -> bool:
            left[0] -= 1
            return left[0] < 0

        connection.text_factory = lambda content: content.decode("utf-8", "replace")
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_BLOB)
        connection.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
        connection.set_progress_handler(is_over, 100_000)  # steps of its machine: at least a hundred for every byte
        with _as_damage():
            for setting in ("trusted_schema = OFF", "cell_size_check = ON", "temp_store = MEMORY", "query_only = ON"):
                connection.execute(f"PRAGMA {setting}")

    def _refuse_programs(self) -> None:
        with _as_damage():
            entries = self.connection.execute("SELECT type, name, sql FROM sqlite_master LIMIT 1001").fetchall()
        if len(entries) > 1000:
            raise DamagedBagError("its schema has more than 1000 entries")
        names = [str(name) for kind, name, _ in entries if kind == "table"]
        for kind, name, sql in entries:
            if kind not in ("table", "index") or "virtual" in str(sql or "").lower().split("(")[0].split():
                raise DamagedBagError(f"it holds a {kind} '{printable(str(name))[:60]}', which a bag does not need; make it anew")
        missing = {"topics", "messages"} - set(names)
        if missing:
            raise DamagedBagError(f"it has no table '{min(missing)}'")
        with _as_damage():
            for table in ("topics", "messages", "message_definitions"):
                if any(column[6] for column in self.connection.execute(f"PRAGMA table_xinfo({table})")):
                    raise DamagedBagError(f"its table '{table}' computes columns, which a bag does not need; make it anew")
        self.has_layouts = "message_definitions" in names

    def _count(self) -> None:
        """Rows, their lengths and types, without reading what they hold."""
        possible = self.size // 4  # a row takes more
        with _as_damage():
            (count,) = self.connection.execute(
                "SELECT count(*) FROM (SELECT 1 FROM messages NOT INDEXED LIMIT ?)", (possible + 1,)
            ).fetchone()
            if count > possible:
                raise DamagedBagError("its pages lead back to one another")
            check_limit("memory", 8 * count, f"it holds {count} messages")
            rows = self.connection.execute(
                "SELECT topic_id, count(*), min(timestamp), max(timestamp), total(length(data)), "
                "sum(typeof(timestamp) != 'integer' OR typeof(data) != 'blob') FROM messages NOT INDEXED GROUP BY topic_id LIMIT ?",
                (MOST_TOPICS + 1,),
            ).fetchall()
        if len(rows) > MOST_TOPICS:
            raise DamagedBagError(f"it holds more than {MOST_TOPICS} topics")
        if sum(row[4] for row in rows) > self.size:
            raise DamagedBagError("its messages are longer than the file")
        if any(row[5] for row in rows):
            raise DamagedBagError("a message has no time or no content")
        if any(not 0 <= time < LATEST for row in rows for time in row[2:4]):
            raise DamagedBagError("a message was received at no time there is")
        self.counts = {row[0]: row[1] for row in rows}
        self.start = min((row[2] for row in rows), default=None)

    def _topics(self) -> list[HeldTopic]:
        layouts: dict[str, tuple[str, str]] = {}
        with _as_damage():
            if self.has_layouts:
                query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions LIMIT ?"
                for name, encoding, text in self._described(query):
                    layouts.setdefault(name, (encoding, text))
            return [
                _topic(number, name, kind, encoding, *layouts.get(kind, ("", "")), self.counts.get(number, 0))
                for number, name, kind, encoding in self._described("SELECT id, name, type, serialization_format FROM topics LIMIT ?")
            ]

    def _described(self, query: str) -> Iterator[tuple[Any, ...]]:
        """Rows of a small table, bounded in number and length."""
        length = 0
        for number, row in enumerate(self.connection.execute(query, (MOST_TOPICS + 1,))):
            length += sum(len(value) for value in row if isinstance(value, str | bytes))
            if number >= MOST_TOPICS or length > current_limits().text_bytes:
                raise DamagedBagError(f"its topics are more than {MOST_TOPICS}, or described at too great length")
            if not all(isinstance(value, str | int) for value in row):
                raise DamagedBagError("a topic has no name or type")
            yield row


class McapStorage(Storage):
    """A file of MCAP, read from its beginning; its index is not trusted, but for which chunks need not be unpacked.

    Format: https://mcap.dev/spec.
    """

    MAGIC = b"\x89MCAP0\r\n"

    def __init__(self, file: Path) -> None:
        self.size = file.stat().st_size
        self.stream = open(file, "rb")  # noqa: SIM115
        self.unpacked = Unpacked(file, self.size)
        self.schemas: dict[int, tuple[str, str, str]] = {}
        self.channels: dict[int, tuple[int, str, str]] = {}
        self.chunks: list[tuple[int, int, set[int] | None]] = []  # where it begins, its length, channels inside where known
        self.plain = False  # whether messages stand outside of chunks
        self.counts: dict[int, int] | None = None
        self.start = None
        try:
            self._walk()
            if not self.channels:
                for begin, length, _ in self.chunks:
                    for kind, content in self._chunk(begin, length):
                        self._describe(kind, content)
            self.topics = [self._topic(number) for number in self.channels]
        except BaseException:
            self.stream.close()
            raise

    def messages(self, numbers: Collection[int]) -> Iterator[Message]:
        """Messages of topics, in the order in which they stand."""
        wanted = set(numbers)
        if self.plain:
            for kind, begin, length in self._records():
                if kind == 0x05:
                    yield from _mcap_message(self._read(begin, length), wanted)
        for begin, length, inside in self.chunks:
            if inside is None or inside & wanted:
                for kind, content in self._chunk(begin, length):
                    if kind == 0x05:
                        yield from _mcap_message(content, wanted)

    def close(self) -> None:
        """Let go of the file."""
        self.stream.close()

    def _read(self, begin: int, length: int) -> bytes:
        if length > MOST_BLOB:
            raise DamagedBagError(f"{length} bytes are announced in one piece")
        self.stream.seek(begin)
        content = self.stream.read(length)
        if len(content) < length:
            raise DamagedBagError("it ends in the middle")
        return content

    def _records(self) -> Iterator[tuple[int, int, int]]:
        """Kind, beginning and length of every record but those in chunks."""
        if self._read(0, 8) != self.MAGIC or self._read(max(self.size - 8, 0), 8) != self.MAGIC:
            raise DamagedBagError("it does not begin and end as MCAP does")
        at, count = 8, 0
        while at < self.size - 8:
            kind, length = struct.unpack("<BQ", self._read(at, 9))
            if at + 9 + length > self.size - 8:
                raise DamagedBagError(f"a record at byte {at} announces {length} bytes")
            yield kind, at + 9, length
            at += 9 + length
            count += 1
            check_limit("samples", count, f"'{self.unpacked.path}' holds {count} records or more outside of chunks")
            if kind == 0x02:
                return

    def _walk(self) -> None:
        """See what there is, outside of chunks."""
        starts: list[int] = []
        last = 0
        for kind, begin, length in self._records():
            last = kind
            if kind in (0x03, 0x04):
                self._describe(kind, self._read(begin, length))
            elif kind == 0x05:
                self.plain = True
                starts.append(struct.unpack("<6xQ", _piece(self._read(begin, min(length, 14)), 0, 14))[0])
                starts = [min(starts)]
            elif kind == 0x06:
                starts = [min([*starts, struct.unpack("<Q", self._read(begin, 8))[0]])]
                self.chunks.append((begin, length, None))
            elif kind == 0x07 and self.chunks:
                chunk_begin, chunk_length, inside = self.chunks[-1]
                (number,) = struct.unpack("<H", _piece(self._read(begin, min(length, 2)), 0, 2))
                self.chunks[-1] = (chunk_begin, chunk_length, (inside or set()) | {number})
            elif kind == 0x0B:
                self._statistics(self._read(begin, length), starts)
        if last != 0x02:
            raise DamagedBagError("it has no end")
        self.start = min(starts) if starts and min(starts) < LATEST else None

    def _statistics(self, content: bytes, starts: list[int]) -> None:
        messages, start, length = struct.unpack("<Q18xQ8xI", _piece(content, 0, 46))
        pairs = _piece(content, 46, length)
        self.counts = dict(struct.iter_unpack("<HQ", pairs[: len(pairs) // 10 * 10]))
        if messages:
            starts.append(start)

    def _describe(self, kind: int, content: bytes) -> None:
        """A schema or a channel."""
        check_limit("text_bytes", len(content), f"'{self.unpacked.path}' describes a topic in {len(content)} bytes")
        if len(self.schemas) + len(self.channels) > 2 * MOST_TOPICS:
            raise DamagedBagError(f"it holds more than {MOST_TOPICS} topics")
        if kind == 0x03:
            number, at = struct.unpack("<H", _piece(content, 0, 2))[0], 2
            name, at = _string(content, at)
            encoding, at = _string(content, at)
            text, at = _string(content, at)
            self.schemas.setdefault(number, (name, encoding, text))
        elif kind == 0x04:
            number, schema = struct.unpack("<2H", _piece(content, 0, 4))
            topic, at = _string(content, 4)
            encoding, at = _string(content, at)
            self.channels.setdefault(number, (schema, topic, encoding))

    def _topic(self, number: int) -> HeldTopic:
        schema, topic, encoding = self.channels[number]
        name, form, text = self.schemas.get(schema, ("", "", ""))
        return _topic(number, topic, name, encoding, form, text, None if self.counts is None else self.counts.get(number, 0))

    def _chunk(self, begin: int, length: int) -> Iterator[tuple[int, bytes]]:
        """Kind and content of a chunk's records."""
        head = self._read(begin, min(length, 64))
        announced, checksum = struct.unpack("<16xQI", _piece(head, 0, 28))
        compression, at = _string(head, 28)
        (packed,) = struct.unpack("<Q", _piece(head, at, 8))
        if at + 8 + packed > length:
            raise DamagedBagError("a chunk is longer than its record")
        content = self.unpacked.block(self._read(begin + at + 8, packed), compression, announced)
        if checksum and zlib.crc32(content) != checksum:
            raise DamagedBagError("a chunk does not match its checksum")
        at = 0
        while at < len(content):
            kind, size = struct.unpack("<BQ", _piece(content, at, 9))
            yield kind, _piece(content, at + 9, size)
            at += 9 + size


def _mcap_message(content: bytes, wanted: Collection[int]) -> Iterator[Message]:
    number, received = struct.unpack("<H4xQ", _piece(content, 0, 14))
    if number in wanted:
        if received >= LATEST:
            raise DamagedBagError("a message was received at no time there is")
        yield number, received, _piece(content, 22, max(len(content) - 22, 0))


def _piece(content: bytes, begin: int, length: int) -> bytes:
    piece = content[begin : begin + length]
    if len(piece) < length:
        raise DamagedBagError("a record is cut")
    return piece


def _string(content: bytes, begin: int) -> tuple[str, int]:
    """A string and where it ends."""
    (length,) = struct.unpack("<I", _piece(content, begin, 4))
    return _piece(content, begin + 4, length).decode("utf-8", "replace"), begin + 4 + length


def _topic(number: int, name: str, kind: str, encoding: str, form: str, layout: str, count: int | None) -> HeldTopic:
    if form not in _FORMATS:
        raise DamagedBagError(f"a layout is written as '{printable(form)[:20]}'")
    return HeldTopic(number, name, kind, encoding, _FORMATS[form], layout, count)


@contextmanager
def _as_damage() -> Iterator[None]:
    """Errors of SQLite are damage of the file."""
    try:
        yield
    except (sqlite3.Error, OverflowError, UnicodeError) as error:
        raise DamagedBagError("it asks SQLite for more than a bag needs" if "interrupted" in str(error) else str(error)) from None
