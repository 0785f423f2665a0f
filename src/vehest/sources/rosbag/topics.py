"""Topics of a ROS 2 bag as arrays: sqlite3 and MCAP, read without ROS; the library rosbags (extra ``ros``) knows the types of messages."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError, MissingError, printable
from vehest.data.limits import check_limit
from vehest.sources.archive import MOST_BYTES, unpacked
from vehest.sources.rosbag.bags import METADATA, BagTopic, OpenBag, open_bag
from vehest.sources.rosbag.unpacking import DamagedBagError

STORAGES = (".db3", ".mcap")
HEADER = "header"
MOST_LAYOUT = 100_000  # characters


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
    types = known_types(tuple(sorted(layouts.items())))
    getters = {one.topic: [_getter(types, one, field) for field in one.fields] for one in wanted}
    with _unpacked_bag(path, most_bytes) as bag:
        _require_bag(bag, path)
        try:
            with open_bag(bag) as opened:
                for one in wanted:
                    for topic in _held(opened, one, path):
                        _refuse_other_layout(types, topic, one, path)
                messages = _read_messages(opened, wanted, types, getters, path)
                return Bag(opened.start, messages)
        except DamagedBagError as damage:
            raise _damaged(path, damage, bag) from None
        except OSError as error:
            raise MissingError(f"cannot read '{path}' ({error.strerror or error}); check the disk and its permissions") from None


def topics_in(path: Path, most_bytes: int = MOST_BYTES) -> dict[str, str]:
    """Topics that a bag says it holds messages of -> their type.

    Raises:
        MissingError: the bag is not there.
        DataError: it is damaged.
    """
    with _unpacked_bag(path, most_bytes) as bag:
        _require_bag(bag, path)
        try:
            with open_bag(bag) as opened:
                return {topic.name: topic.type for topic in opened.topics if topic.count is None or topic.count}
        except DamagedBagError as damage:
            raise _damaged(path, damage, bag) from None
        except OSError as error:
            raise MissingError(f"cannot read '{path}' ({error.strerror or error}); check the disk and its permissions") from None


def numeric_fields(kind: str, prefix: str = "") -> list[str]:
    """Paths of the plain numbers in a message type; none of a type that is not ROS's own.

    Raises:
        MissingError: rosbags is not installed.
    """
    types = known_types(())
    if kind not in types.fielddefs:
        return []
    paths: list[str] = []
    for field, (sort, detail) in types.fielddefs[kind][1]:
        path = f"{prefix}{field}"
        if sort.name == "NAME":
            paths += numeric_fields(str(detail), f"{path}.")
        elif sort.name == "BASE" and detail[0] not in {"string", "wstring", "byte", "char", "bool"}:
            paths.append(path)
    return paths


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


@lru_cache(maxsize=8)
def known_types(layouts: tuple[tuple[str, str], ...]) -> Any:
    """Standard message types and those declared in text, as a rosbags type store.

    rosbags writes code for these types and runs it; they come from ROS and from the data set's configuration, never from a bag.

    Args:
        layouts: message types and their definitions.

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
    for name, text in layouts:
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


def _require_bag(bag: Path, path: Path) -> None:
    if bag.is_dir() and not (bag / METADATA).is_file():
        raise DataError(f"'{path}' has no {METADATA}, without which a folder is no bag; make one with 'ros2 bag reindex'")
    for file in bag.iterdir() if bag.is_dir() else [bag]:
        _refuse_short_sqlite(file, path)


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


def _held(bag: OpenBag, wanted: Wanted, path: Path) -> list[BagTopic]:
    """What the bag holds of a topic, if it is what was declared."""
    held = [topic for topic in bag.topics if topic.name == wanted.topic]
    if not held:
        names = sorted({topic.name for topic in bag.topics})
        topics = printable(", ".join(names[:30])) + (", …" if len(names) > 30 else "") if names else "none"
        raise DataError(f"'{path}' has no topic '{wanted.topic}' (it has {topics}); correct topics in the data set's configuration")
    for topic in held:
        if topic.type != wanted.type:
            raise DataError(f"'{path}': topic '{wanted.topic}' carries '{printable(topic.type)}', not '{wanted.type}' as declared")
    if not any(topic.count is None or topic.count for topic in held):
        raise DataError(f"'{path}': topic '{wanted.topic}' holds no messages")
    return held


def _refuse_other_layout(types: Any, topic: BagTopic, wanted: Wanted, path: Path) -> None:
    """A bag that says itself how its messages are laid out must say what was declared, or numbers would come from the wrong bytes.

    Its text is parsed and compared; no type is made of it.
    """
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    for form, text in topic.layouts:
        if len(text) > MOST_LAYOUT:
            raise DataError(f"'{path}': topic '{wanted.topic}': its layout is {len(text)} characters long, more than {MOST_LAYOUT}")
        own: dict[str, Any] = {}
        try:
            if form == "msg":
                own = get_types_from_msg(text, topic.type)
            else:
                sections = text.split("=" * 80 + "\n") if text.startswith("=" * 80) else [text]
                for section in filter(None, sections):
                    own.update(get_types_from_idl(section.split("\n", 1)[1] if section.startswith("IDL: ") else section))
        except Exception as error:  # whatever a parser meets in a text that comes from the file
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
    bag: OpenBag, wanted: Sequence[Wanted], types: Any, getters: Mapping[str, list[Callable[[Any], Any]]], path: Path
) -> dict[str, TopicData]:
    """Time received, time stamped, and fields of every message."""
    kinds = {one.topic: one.type for one in wanted}
    stamped = {topic: _has_header(types, kind) for topic, kind in kinds.items()}
    times = {topic: (array("q"), array("q")) for topic in kinds}
    values = {topic: [array("d") for _ in getters[topic]] for topic in kinds}
    for topic, received, raw in bag.messages(set(kinds.items())):
        try:
            message = types.deserialize_cdr(raw, kinds[topic])
            times[topic][0].append(received)
            if stamped[topic]:
                times[topic][1].append(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)
            for samples, getter in zip(values[topic], getters[topic], strict=True):
                samples.append(getter(message))
        except Exception as error:  # whatever a parser of binary data meets in a damaged message
            raise _damaged(path, error) from None
        check_limit("samples", len(times[topic][0]), f"'{path}': topic '{topic}' holds {len(times[topic][0])} messages or more")
    read = {}
    for one in wanted:
        declared = [topic.count for topic in bag.topics if topic.name == one.topic]
        held = len(times[one.topic][0])
        if None not in declared and held != sum(count or 0 for count in declared):
            raise DataError(
                f"'{path}': topic '{one.topic}' holds {held} messages, the bag says {sum(count or 0 for count in declared)}; "
                f"it is truncated, fetch it again"
            )
        if not held:
            raise DataError(f"'{path}': topic '{one.topic}' holds no messages")
        read[one.topic] = _topic_data(one, *times[one.topic], values[one.topic], stamped[one.topic])
    return read


def _has_header(types: Any, name: str) -> bool:
    return _named_type(dict(types.fielddefs[name][1]).get(HEADER, (_Plain, ""))) == "std_msgs/msg/Header"


class _Plain:
    """Stands for the description of a field that is not there."""

    name = "BASE"


def _topic_data(wanted: Wanted, received: array[int], stamped: array[int], fields: list[array[float]], has_header: bool) -> TopicData:
    """Messages in the order in which they were received."""
    order = np.argsort(np.array(received), kind="stable")
    return TopicData(
        received=np.array(received, dtype=np.int64)[order],
        stamped=np.array(stamped, dtype=np.int64)[order] if has_header else None,
        fields={name: np.array(values, dtype=np.float64)[order] for name, values in zip(wanted.fields, fields, strict=True)},
    )


def _damaged(path: Path, error: Exception, unpacked: Path | None = None) -> DataError:
    text = _first_line(error) if unpacked is None else _first_line(error).replace(f"{unpacked}/", "")
    return DataError(f"'{path}' cannot be read as a ROS 2 bag ({text}); is it truncated or damaged? fetch it again")


def _first_line(error: Exception) -> str:
    text = (str(error).splitlines() or [""])[0][:160]
    return printable(text) or type(error).__name__
