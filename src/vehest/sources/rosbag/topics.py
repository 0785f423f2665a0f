"""Topics of a ROS 2 bag as arrays: sqlite3 and MCAP, read without ROS through the library rosbags (extra ``ros``)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehest.data.errors import ConfigurationError, DataError, MissingError, VehestError
from vehest.data.recording import FloatArray
from vehest.sources.archive import MOST_BYTES, unpacked

STORAGES = (".db3", ".mcap")
METADATA = "metadata.yaml"
HEADER = "header"
UNUSABLE_IN_PATHS = "?#%"  # SQLite is handed the path as a URI


@dataclass(frozen=True)
class TopicData:
    """All messages of one topic, in the order in which they were recorded.

    Args:
        received: when the bag received them [ns of unix time], shape (T,).
        stamped: what their headers say [ns of unix time], shape (T,); None where they have none.
        fields: path of a field in the message -> values, shape (T,).
    """

    received: NDArray[np.int64]
    stamped: NDArray[np.int64] | None
    fields: Mapping[str, FloatArray]


@dataclass(frozen=True)
class Wanted:
    """What is read of one topic.

    Args:
        topic: its name in the bag.
        type: its message type, such as ``sensor_msgs/msg/Imu``.
        fields: paths of numeric fields, such as ``linear_acceleration.x`` or ``data.0``.
    """

    topic: str
    type: str
    fields: tuple[str, ...]


@dataclass(frozen=True)
class Bag:
    """What was read of a bag.

    Args:
        start: when its first message was received [ns of unix time].
        topics: by their names in the bag.
    """

    start: int
    topics: Mapping[str, TopicData]


def read_bag(path: Path, wanted: Sequence[Wanted], layouts: Mapping[str, str], most_bytes: int = MOST_BYTES) -> Bag:
    """Read topics of a bag.

    Args:
        path: a bag's folder, one of its ``.db3`` or ``.mcap`` files, or a zip archive that holds one bag.
        wanted: topics and fields.
        layouts: message definitions that ROS 2 does not ship, by type, as text in the format of ``.msg`` files.
        most_bytes: limit of an archive's unpacked size [bytes].

    Raises:
        MissingError: rosbags is not installed, or the bag is not there.
        ConfigurationError: a layout cannot be read, or a type or a field that is not in the layouts.
        DataError: the bag is damaged, or does not hold the topics, types and layouts that are wanted.
    """
    types = known_types(layouts)
    getters = {one.topic: [_getter(types, one, field) for field in one.fields] for one in wanted}
    with _unpacked_bag(path, most_bytes) as bag, _opened(bag, path) as reader:
        connections = [_connection(reader, one, path) for one in wanted]
        for one, held in zip(wanted, connections, strict=True):
            for connection in held:
                _refuse_other_layout(types, connection, one, path)
        messages = _read_messages(reader, [connection for held in connections for connection in held], types, getters, path)
        return Bag(int(reader.start_time), {one.topic: _topic_data(one, messages[one.topic], types) for one in wanted})


def bag_files(path: Path) -> list[Path]:
    """The files that a bag is made of: the archive or file itself, or what its folder holds.

    Raises:
        MissingError: one is not there, is empty, or may not be read.
    """
    try:
        files = sorted(file for file in path.iterdir() if file.name == METADATA or _is_storage(file)) if path.is_dir() else [path]
    except OSError as error:
        raise MissingError(f"cannot read '{path}' ({error.strerror}); check its permissions") from None
    if not files:
        raise MissingError(f"'{path}' holds no bag: neither {METADATA} nor a file ending in {' or '.join(STORAGES)}")
    for file in files:
        if not file.is_file():
            raise MissingError(f"there is no file '{file}'")
        if file.stat().st_size == 0:
            raise MissingError(f"file '{file}' is empty")
    return files


def known_types(layouts: Mapping[str, str]) -> Any:
    """Standard message types and those declared in text, as a rosbags type store.

    Raises:
        MissingError: rosbags is not installed.
        ConfigurationError: a layout cannot be read.
    """
    try:
        from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
    except ImportError:
        raise MissingError("reading ROS 2 bags needs the package rosbags; pip install 'vehest[ros]'") from None
    types = get_typestore(Stores.ROS2_HUMBLE)
    declared: dict[str, Any] = {}
    for name, text in layouts.items():
        try:
            declared.update(get_types_from_msg(text, name))
        except (TypesysError, ValueError, TypeError) as error:
            raise ConfigurationError(f"the layout of message type '{name}' cannot be read: {' '.join(str(error).split())[:160]}") from None
    for name, (_, fields) in declared.items():
        for field, description in fields:
            if (missing := _named_type(description)) and missing not in declared and missing not in types.fielddefs:
                raise ConfigurationError(
                    f"the layout of message type '{name}': field '{field}' is of type '{missing}', which is not declared"
                )
    try:
        types.register(declared)
    except TypesysError as error:
        raise ConfigurationError(f"layouts of message types: {_first_line(error)}") from None
    return types


def _named_type(description: Any) -> str:
    """The message type that a field refers to, empty if it is a plain one."""
    kind, detail = description
    if kind.name in {"ARRAY", "SEQUENCE"}:
        return _named_type(detail[0])
    return str(detail) if kind.name == "NAME" else ""


def _getter(types: Any, wanted: Wanted, path: str) -> Callable[[Any], Any]:
    """What takes a field out of a message, once it is known that there is one and that it is a number."""
    described: Any = None
    at: Any = wanted.type
    for part in path.split("."):
        if part.isdigit() and described is not None and described[0].name in {"ARRAY", "SEQUENCE"}:
            described = described[1][0]
        else:
            if at not in types.fielddefs:
                raise ConfigurationError(f"message type '{at}' is neither a standard one nor declared; give its layout in messages")
            fields = dict(types.fielddefs[at][1])
            if part not in fields:
                raise ConfigurationError(f"topic '{wanted.topic}': message type '{at}' has no field '{part}' (it has {', '.join(fields)})")
            described = fields[part]
        at = _named_type(described) if described[0].name == "NAME" else f"{path}'s array"
    if described is None or described[0].name != "BASE" or described[1][0] in {"string", "wstring", "byte", "char"}:
        raise ConfigurationError(f"topic '{wanted.topic}': field '{path}' of '{wanted.type}' is not a number; name one inside it")
    if not any(part.isdigit() for part in path.split(".")):
        return attrgetter(path)
    return lambda message: _walk(message, path)


def _walk(message: Any, path: str) -> Any:
    for part in path.split("."):
        message = message[int(part)] if part.isdigit() else getattr(message, part)
    return message


@contextmanager
def _unpacked_bag(path: Path, most_bytes: int) -> Iterator[Path]:
    """The bag itself; an archive's is there as long as the context lasts."""
    bag_files(path)
    if path.is_dir() or _is_storage(path):
        yield path
        return
    with unpacked(path, most_bytes=most_bytes) as folder:
        bags = sorted(file.parent for file in folder.rglob(METADATA))
        if len(bags) != 1:
            raise DataError(f"'{path}' holds {len(bags) or 'no'} bags (folders with a {METADATA}); one is needed")
        yield bags[0]


def _is_storage(path: Path) -> bool:
    return path.suffix.lower() in STORAGES


@contextmanager
def _opened(bag: Path, path: Path) -> Iterator[Any]:
    from rosbags.rosbag2 import Reader

    if bag.is_dir() and not (bag / METADATA).is_file():
        raise DataError(f"'{path}' has no {METADATA}, without which a folder is no bag; make one with 'ros2 bag reindex'")
    if any(character in str(bag) for character in UNUSABLE_IN_PATHS):
        raise DataError(f"'{path}' cannot be read from a path with one of {' '.join(UNUSABLE_IN_PATHS)} in it; rename the folder or file")
    for file in bag.iterdir() if bag.is_dir() else [bag]:
        _refuse_short_sqlite(file, path)
    reader = Reader(bag)
    try:
        reader.open()
    except Exception as error:  # whatever a parser of binary files meets in a damaged one
        raise _damaged(path, error, bag) from None
    try:
        yield reader
    finally:
        reader.close()


def _refuse_short_sqlite(file: Path, path: Path) -> None:
    """SQLite does not miss pages at the end that it has no need to read.

    Source:
        SQLite, Database File Format, section 1.3, https://www.sqlite.org/fileformat2.html.
    """
    if file.suffix.lower() != ".db3" or not file.is_file():
        return
    try:
        with open(file, "rb") as stream:
            header = stream.read(100)
    except OSError as error:
        raise MissingError(f"cannot read '{file}' ({error.strerror}); check the disk and its permissions") from None
    if len(header) < 100 or not header.startswith(b"SQLite format 3\0"):
        raise DataError(f"'{path}': '{file.name}' is no SQLite database, or is truncated; fetch it again")
    page, pages = int.from_bytes(header[16:18], "big"), int.from_bytes(header[28:32], "big")
    size = (65536 if page == 1 else page) * pages
    if header[24:28] == header[92:96] and file.stat().st_size < size:  # only then is the number of pages kept
        raise DataError(f"'{path}': '{file.name}' holds {file.stat().st_size} of its {size} bytes; it is truncated, fetch it again")


def _connection(reader: Any, wanted: Wanted, path: Path) -> list[Any]:
    """What the bag holds of a topic, if it is what was declared."""
    held = [connection for connection in reader.connections if connection.topic == wanted.topic]
    if not held:
        topics = ", ".join(sorted({str(connection.topic) for connection in reader.connections})) or "none"
        raise DataError(f"'{path}' has no topic '{wanted.topic}' (it has {topics}); correct topics in the data set's configuration")
    for connection in held:
        if connection.msgtype != wanted.type:
            raise DataError(f"'{path}': topic '{wanted.topic}' carries '{connection.msgtype}', not '{wanted.type}' as declared")
    if not sum(connection.msgcount for connection in held):
        raise DataError(f"'{path}': topic '{wanted.topic}' holds no messages")
    return held


def _refuse_other_layout(types: Any, connection: Any, wanted: Wanted, path: Path) -> None:
    """A bag that says itself how its messages are laid out must say what was declared, or numbers would come from the wrong bytes."""
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    definition = connection.msgdef
    if definition.format == MessageDefinitionFormat.NONE:
        return
    try:
        if definition.format == MessageDefinitionFormat.MSG:
            own = get_types_from_msg(definition.data, connection.msgtype)
        else:
            sections = definition.data.split("=" * 80 + "\n") if definition.data.startswith("=" * 80) else [definition.data]
            own = {}
            for section in filter(None, sections):
                own.update(get_types_from_idl(section.split("\n", 1)[1] if section.startswith("IDL: ") else section))
    except Exception as error:  # the text comes from the file
        raise _damaged(path, error) from None
    for name, (_, fields) in own.items():
        declared = types.fielddefs.get(name)
        if declared is not None and _layout(declared[1]) != _layout(fields):
            raise DataError(
                f"'{path}': topic '{wanted.topic}': the bag's own layout of '{name}' is not the declared one; "
                f"correct messages in the data set"
            )


def _layout(fields: Any) -> list[tuple[str, str]]:
    return [(str(name).lower(), repr(description)) for name, description in fields]


def _read_messages(
    reader: Any, connections: list[Any], types: Any, getters: Mapping[str, list[Callable[[Any], Any]]], path: Path
) -> dict[str, list[tuple[Any, ...]]]:
    """Time received, time stamped, and fields of every message."""
    messages: dict[str, list[tuple[Any, ...]]] = {topic: [] for topic in getters}
    stamped = {connection.topic: _has_header(types, connection.msgtype) for connection in connections}
    try:
        for connection, received, raw in reader.messages(connections):
            message = types.deserialize_cdr(raw, connection.msgtype)
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec if stamped[connection.topic] else None
            messages[connection.topic].append((received, stamp, *(getter(message) for getter in getters[connection.topic])))
    except VehestError:
        raise
    except Exception as error:  # whatever a parser of binary files meets in a damaged one
        raise _damaged(path, error) from None
    for topic, held in messages.items():
        declared = sum(connection.msgcount for connection in connections if connection.topic == topic)
        if len(held) != declared:
            raise DataError(
                f"'{path}': topic '{topic}' holds {len(held)} messages, the bag says {declared}; it is truncated, fetch it again"
            )
    return messages


def _has_header(types: Any, name: str) -> bool:
    return _named_type(dict(types.fielddefs[name][1]).get(HEADER, (_Plain, ""))) == "std_msgs/msg/Header"


class _Plain:
    """Stands for the description of a field that is not there."""

    name = "BASE"


def _topic_data(wanted: Wanted, messages: list[tuple[Any, ...]], types: Any) -> TopicData:
    received, stamped, *fields = zip(*messages, strict=True)
    return TopicData(
        received=np.array(received, dtype=np.int64),
        stamped=np.array(stamped, dtype=np.int64) if _has_header(types, wanted.type) else None,
        fields={name: np.array(values, dtype=np.float64) for name, values in zip(wanted.fields, fields, strict=True)},
    )


def _damaged(path: Path, error: Exception, unpacked: Path | None = None) -> DataError:
    text = _first_line(error) if unpacked is None else _first_line(error).replace(f"{unpacked}/", "")
    return DataError(f"'{path}' cannot be read as a ROS 2 bag ({text}); is it truncated or damaged? fetch it again")


def _first_line(error: Exception) -> str:
    text = (str(error).splitlines() or [""])[0][:160]
    return text or type(error).__name__
