"""A ROS 2 bag as a whole: its metadata, its files, and the messages of its topics."""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from vehest.data.errors import DataError
from vehest.data.files import regular_file
from vehest.data.text_files import first_line, read_yaml
from vehest.sources.rosbag.storage import LATEST, HeldTopic, Storage, open_storage
from vehest.sources.rosbag.unpacking import DamagedBagError, Unpacked, unpack_zstd

METADATA = "metadata.yaml"
NEWEST = 9  # version of the metadata


@dataclass(frozen=True)
class BagTopic:
    """A topic of a bag.

    Args:
        name: of the topic.
        type: of its messages.
        count: how many messages the bag says it holds; None where it does not say.
        layouts: format and text of what the bag says of its messages.
    """

    name: str
    type: str
    count: int | None
    layouts: tuple[tuple[str, str], ...]


class OpenBag:
    """A bag whose files are open.

    Args:
        start: when its first message was received [ns of unix time].
        topics: that it says it holds.
        storages: its files.
        counted: of what its messages unpack to, where each is compressed.
    """

    def __init__(self, start: int, topics: list[BagTopic], storages: list[Storage], counted: Unpacked | None = None) -> None:
        self.start, self.topics, self.storages, self.counted = start, topics, storages, counted

    def messages(self, wanted: Collection[tuple[str, str]]) -> Iterator[tuple[str, int, bytes]]:
        """Topic, time received [ns] and content of messages.

        Args:
            wanted: names and types of topics.
        """
        for storage in self.storages:
            names = {topic.number: topic.name for topic in storage.topics if (topic.name, topic.type) in wanted}
            if names:
                for number, received, content in storage.messages(names):
                    yield names[number], received, self.counted.block(content, "zstd", None) if self.counted else content


@contextmanager
def open_bag(bag: Path) -> Iterator[OpenBag]:
    """Open a bag's folder, or a single file of one.

    Raises:
        DamagedBagError: it contradicts its format.
        DataError: it is more than the limits.
    """
    with ExitStack() as stack:
        yield _open_folder(bag, stack) if bag.is_dir() else _open_file(bag, stack)


def _open_file(file: Path, stack: ExitStack) -> OpenBag:
    storage = open_storage(regular_file(file))
    stack.callback(storage.close)
    topics = [BagTopic(topic.name, topic.type, topic.count, _layouts([topic])) for topic in storage.topics]
    _require_cdr(topic.encoding for topic in storage.topics)
    return OpenBag(storage.start or 0, topics, [storage])


def _open_folder(bag: Path, stack: ExitStack) -> OpenBag:
    try:
        described = read_yaml(bag / METADATA)
    except DataError as error:
        raise DamagedBagError(first_line(error)) from None
    about = _member(described, "rosbag2_bagfile_information", dict)
    version = _member(about, "version", int)
    if not 0 < version <= NEWEST:
        raise DamagedBagError(f"version {version} not supported")
    kind = _member(about, "storage_identifier", str)
    if kind not in ("sqlite3", "mcap"):
        raise DamagedBagError(f"storage '{kind[:20]}' not supported")
    names = [PurePosixPath(name).name for name in _list(about, "relative_file_paths", str)]
    missing = [name for name in names if name in ("", "..") or not (bag / name).exists()]
    if missing or not names:
        raise DamagedBagError(f"files are missing: {missing}")
    if len(set(names)) < len(names):
        raise DamagedBagError("it names one of its files twice")
    start = _member(_member(about, "starting_time", dict), "nanoseconds_since_epoch", int)
    is_empty = _member(about, "message_count", int) == 0
    if not is_empty and not 0 <= start < LATEST:
        raise DamagedBagError(f"it began at {start} ns, which is no time there is")
    mode = str(about.get("compression_mode") or "none").lower()
    if mode not in ("none", "file", "message") or (mode != "none" and about.get("compression_format") != "zstd"):
        raise DamagedBagError(f"it is compressed in mode '{mode[:20]}', not file or message by zstd")
    storages: list[Storage] = []
    files = [regular_file(bag / name) for name in names]
    for file in files:
        storage = open_storage(_unpacked_file(file, stack) if mode == "file" else file, kind)
        stack.callback(storage.close)
        storages.append(storage)
    counted = Unpacked(bag, sum(file.stat().st_size for file in files)) if mode == "message" else None
    return OpenBag(0 if is_empty else start, _topics(about, storages), storages, counted)


def _topics(about: dict[str, Any], storages: list[Storage]) -> list[BagTopic]:
    held: dict[str, list[HeldTopic]] = {}
    for storage in storages:
        for topic in storage.topics:
            held.setdefault(topic.type, []).append(topic)
    topics, encodings = [], []
    for entry in _list(about, "topics_with_message_count", dict):
        topic, count = _member(entry, "topic_metadata", dict), _member(entry, "message_count", int)
        name, kind = _member(topic, "name", str), _member(topic, "type", str)
        encodings.append(_member(topic, "serialization_format", str))
        topics.append(BagTopic(name, kind, count, _layouts(held.get(kind, []))))
    _require_cdr(encodings)
    return topics


def _layouts(topics: list[HeldTopic]) -> tuple[tuple[str, str], ...]:
    return tuple(dict.fromkeys((topic.format, topic.layout) for topic in topics if topic.format))


def _require_cdr(encodings: Any) -> None:
    for encoding in encodings:
        if encoding != "cdr":
            raise DamagedBagError(f"messages are encoded as '{encoding[:20]}', not cdr")


def _unpacked_file(file: Path, stack: ExitStack) -> Path:
    """A file that ROS has compressed as a whole, in a temporary folder as long as the bag is open."""
    folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="vehest-", ignore_cleanup_errors=True))
    plain = Path(folder) / file.stem
    unpack_zstd(file, plain)
    return plain


def _member(mapping: Any, key: str, kind: type) -> Any:
    value = mapping.get(key) if isinstance(mapping, dict) else None
    if not isinstance(value, kind) or isinstance(value, bool):
        raise DamagedBagError(f"its {METADATA} does not say '{key}'")
    return value


def _list(mapping: Any, key: str, kind: type) -> list[Any]:
    values = _member(mapping, key, list)
    if not all(isinstance(value, kind) for value in values):
        raise DamagedBagError(f"its {METADATA} does not say '{key}'")
    return values
