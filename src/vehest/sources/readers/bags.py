"""Topics of a ROS 2 bag as arrays, by rosbags.

bag -> connections of the wanted topics -> messages, deserialised as declared -> times and fields
"""

from __future__ import annotations

import os
from array import array
from collections.abc import Callable, Mapping, Sequence
from functools import partial, reduce
from operator import attrgetter
from pathlib import Path
from typing import Any
from urllib.parse import quote

import apsw
import numpy as np
from rosbags.interfaces import Connection, MessageDefinitionFormat, Nodetype
from rosbags.rosbag2 import Reader
from rosbags.typesys import (
    Stores,
    TypesysError,
    get_types_from_idl,
    get_types_from_msg,
    get_typestore,
)

from vehest.data.errors import ConfigurationError, DataError, printable
from vehest.data.limits import check_limit
from vehest.sources.limited import Arrays

apsw.connection_hooks.append(
    lambda connection: connection.pragma("temp_store", "memory")
)  # SQLite may write no file

TEXTS = frozenset({"string", "wstring", "byte", "char"})  # types of fields that are no numbers
ARRAYS = (Nodetype.ARRAY, Nodetype.SEQUENCE)  # types of nodes of arrays
LATEST = 2**62  # latest time, ns of unix time: 146 years

Topic = Sequence[Any]  # name, message type, paths of fields


def read_topics(
    bag: Path, topics: Sequence[Topic], layouts: Mapping[str, str]
) -> tuple[Arrays, dict[str, Any]]:
    """Messages of topics, in the order in which the bag received them.

    Parameters
    ----------
    bag : Path
        A bag's folder, or one of its files.
    topics : sequence
        Of each topic name, message type and paths of numeric fields.
    layouts : mapping
        Message type -> its definition, for types that ROS 2 Humble does not ship.

    Returns
    -------
    arrays : dict
        ``TOPIC@received`` [ns of unix time], ``TOPIC@stamped`` [ns] where messages have headers,
        and ``TOPIC.FIELD``, in the message's unit, shape (N,) each.
    summary : dict
        ``start`` of the bag [ns of unix time].

    Raises
    ------
    ConfigurationError
        A message type is unknown, or a field is not in it or is no number.
    DataError
        The bag is damaged, holds no messages of a topic, other types or layouts than declared, or
        more messages than the limits allow.
    """
    types = _types(layouts)
    with _opened(bag) as reader:
        try:
            arrays = _read(bag, reader, types, topics)
        except KeyError as error:  # of rosbags' types
            raise ConfigurationError(
                f"message type {error} is neither a standard one nor declared; give its layout in "
                "messages"
            ) from None
        if not 0 <= reader.start_time < LATEST:
            raise DataError(
                f"'{bag}' starts at {reader.start_time} ns, which is no time; make it again"
            )
        return arrays, {"start": reader.start_time}


def survey_topics(
    bag: Path, ignored: Sequence[str], most_fields: int
) -> tuple[Arrays, dict[str, Any]]:
    """Topics whose messages are of ROS's own types, with their plain numbers.

    Parameters
    ----------
    bag : Path
        A bag's folder, or one of its files.
    ignored : sequence of str
        Last parts of the names of topics that are passed over.
    most_fields : int
        A topic whose messages have more numbers is skipped. Fields of headers and covariances do
        not count and are not read.

    Returns
    -------
    arrays : dict
        As of `read_topics`.
    summary : dict
        ``topics``, name, type and fields of each, and ``skipped``, reasons.
    """
    types = _types({})
    arrays = Arrays()
    surveyed = []
    skipped = []
    with _opened(bag) as reader:
        topics = {
            connection.topic: connection.msgtype
            for connection in reader.connections
            if connection.msgcount
        }
        for name, kind in topics.items():
            if name.strip("/").split("/")[-1] in ignored:
                continue
            fields = [
                field
                for field in _numbers(types, kind)
                if not field.startswith("header.") and "covariance" not in field
            ]
            if not 0 < len(fields) <= most_fields:
                skipped.append(
                    f"topic '{printable(name)}' of type '{printable(kind)}' is none of ROS's own "
                    "of plain numbers; to read it, give its layout under messages "
                    "(docs/sources/rosbag.md)"
                )
                continue
            try:
                arrays |= _read(bag, reader, types, [(name, kind, fields)])
                surveyed.append([name, kind, fields])
            except DataError as error:
                skipped.append(str(error).removeprefix(f"'{bag}': "))
    return arrays, {"topics": surveyed, "skipped": skipped}


class _UriPath(type(Path())):  # type: ignore[misc]
    """A path that rosbags can write into the URI of a SQLite database."""

    def __format__(self, _: str) -> str:
        """The path, percent-encoded."""
        return quote(os.fsencode(self), safe="/:\\")


def _opened(bag: Path) -> Reader:
    """A bag, unless a SQLite file of it ends within a page: SQLite would fill that up with zeros.

    Source: SQLite, Database File Format, section 1.3, https://www.sqlite.org/fileformat2.html.
    """
    for file in [bag] if bag.is_file() else bag.iterdir():
        if file.is_file():
            with open(file, "rb") as stream:
                head = stream.read(18)
            page = int.from_bytes(head[16:], "big")
            if head.startswith(b"SQLite format 3\0") and file.stat().st_size % (
                65536 if page == 1 else page
            ):
                raise DataError(f"'{bag}': '{file.name}' is truncated; fetch it again")
    return Reader(_UriPath(bag))


def _types(layouts: Mapping[str, str]) -> Any:
    """Standard message types and the declared ones: rosbags makes code of these, never of a bag's
    own definitions.
    """
    types = get_typestore(Stores.ROS2_HUMBLE)
    declared = {}
    for name, text in layouts.items():
        try:
            declared.update(get_types_from_msg(text, name))
        except Exception as error:  # of rosbags' parser, of any kind
            raise ConfigurationError(
                f"the layout of message type '{name}' cannot be read: "
                f"{' '.join(str(error).split())[:160]}"
            ) from None
    try:
        types.register(declared)
    except TypesysError as error:
        raise ConfigurationError(f"layouts of message types: {error}") from None
    return types


def _numbers(types: Any, kind: str, prefix: str = "") -> list[str]:
    """Paths of the plain numbers in a message type; none of an unknown one."""
    paths: list[str] = []
    for field, (node, detail) in types.fielddefs.get(kind, ((), ()))[1]:
        if node == Nodetype.NAME:
            paths += _numbers(types, detail, f"{prefix}{field}.")
        elif node == Nodetype.BASE and detail[0] not in TEXTS | {"bool"}:
            paths.append(f"{prefix}{field}")
    return paths


def _part(message: Any, part: str) -> Any:
    """An element of an array by its number, or a field of a message by its name."""
    return message[int(part)] if part.isdigit() else getattr(message, part)


def _getter(types: Any, topic: str, kind: str, path: str) -> Callable[[Any], Any]:
    """Function that takes a field out of a message, by its path; numbers in it are places in an
    array.

    Raises
    ------
    ConfigurationError
        The path is not in the message's type, or leads to text, an array or a message.
    """
    node = Nodetype.NAME
    detail = kind
    parts = path.split(".")
    for part in parts:
        inner: dict[str, Any] = {}
        if node == Nodetype.NAME:
            inner = dict(types.fielddefs[detail][1])
        elif node in ARRAYS and part.isdigit():
            inner = {part: detail[0]}
        if part not in inner:
            raise ConfigurationError(
                f"topic '{topic}': '{kind}' has no field '{path}': '{part}' is none of: "
                f"{', '.join(inner)}"
            )
        node, detail = inner[part]
    if node != Nodetype.BASE or detail[0] in TEXTS:
        raise ConfigurationError(
            f"topic '{topic}': field '{path}' of '{kind}' is not a number; name one inside it"
        )
    return partial(reduce, _part, parts) if any(map(str.isdigit, parts)) else attrgetter(path)


def _read(bag: Path, reader: Reader, types: Any, topics: Sequence[Topic]) -> Arrays:
    """Arrays of topics as of `read_topics`, without the layouts and the bag's start."""
    columns: dict[str, array[Any]] = {}
    takers: dict[str, list[tuple[Callable[[Any], None], Callable[[Any], Any]]]] = {}
    counts = {}
    keys = {}
    selected = []
    for name, kind, paths in topics:
        getters = {f"{name}.{path}": _getter(types, name, kind, path) for path in paths}
        if dict(types.fielddefs[kind][1]).get("header") == (Nodetype.NAME, "std_msgs/msg/Header"):
            getters[f"{name}@stamped"] = lambda message: (
                message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            )
        keys[name] = [f"{name}@received", *getters]
        columns |= {
            key: array("q" if key.endswith(("@received", "@stamped")) else "d")
            for key in keys[name]
        }
        takers[name] = [(columns[key].append, getter) for key, getter in getters.items()]
        connections = _connections(bag, reader, types, name, kind)
        counts[name] = sum(connection.msgcount for connection in connections)
        check_limit(
            "samples", counts[name], f"'{bag}': topic '{name}' holds {counts[name]} messages"
        )
        selected += connections
    for connection, time, raw in reader.messages(selected):
        message: Any = types.deserialize_cdr(raw, connection.msgtype)
        columns[f"{connection.topic}@received"].append(time)
        for take, getter in takers[connection.topic]:
            take(getter(message))
    arrays: Arrays = {key: np.array(values) for key, values in columns.items()}
    for name, count in counts.items():
        received = arrays[f"{name}@received"]
        if len(received) != count:
            raise DataError(
                f"'{bag}': topic '{name}' holds {len(received)} messages, the bag says {count}; "
                "it is truncated"
            )
        if received.min() < 0 or received.max() >= LATEST:
            raise DataError(
                f"'{bag}': topic '{name}': a message was received at no time there is; the bag is "
                "damaged"
            )
        order = np.argsort(received, kind="stable")
        arrays |= {key: arrays[key][order] for key in keys[name]}
    return arrays


def _connections(bag: Path, reader: Reader, types: Any, name: str, kind: str) -> list[Connection]:
    """Connections of a bag for a topic, whose type and layout are checked against the declared
    ones.
    """
    connections = [connection for connection in reader.connections if connection.topic == name]
    if not any(connection.msgcount for connection in connections):
        names = {connection.topic for connection in reader.connections if connection.msgcount}
        topics = printable(", ".join(sorted(names)[:30])) or "none"
        raise DataError(
            f"'{bag}' holds no messages of topic '{name}' (of {topics}); correct topics in the "
            "configuration"
        )
    for connection in connections:
        if connection.msgtype != kind:
            raise DataError(
                f"'{bag}': topic '{name}' carries '{printable(connection.msgtype)}', not '{kind}' "
                "as declared"
            )
        for message_type, (_, fields) in _definitions(connection).items():
            declared = types.fielddefs.get(message_type, ((), fields))[1]
            if [(field.lower(), node) for field, node in fields] != [
                (field.lower(), node) for field, node in declared
            ]:
                raise DataError(
                    f"'{bag}': topic '{name}': the bag's own layout of '{message_type}' is not "
                    "the declared one; correct messages"
                )
    return connections


def _definitions(connection: Connection) -> Mapping[str, Any]:
    """Types as the bag itself defines them, parsed only."""
    form = connection.msgdef.format
    text = connection.msgdef.data
    if form == MessageDefinitionFormat.NONE:
        return {}
    if form == MessageDefinitionFormat.MSG:
        return get_types_from_msg(text, connection.msgtype)
    rule = "=" * 80 + "\n"
    sections = (
        [part.split("\n", 1)[1] for part in text.split(rule)[1:]]
        if text.startswith(f"{rule}IDL: ")
        else [text]
    )
    return {
        name: kind for section in sections for name, kind in get_types_from_idl(section).items()
    }
