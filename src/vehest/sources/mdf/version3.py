"""What a file of MDF 2 or 3 says that it holds.

Format: Vector, MDF Format Specification 3.3. Comments, sources and triggers are passed by: nothing is taken out of them.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone

import numpy as np

from vehest.sources.mdf import conversions
from vehest.sources.mdf.blocks import BlockFile, Trail, shown
from vehest.sources.mdf.layout import ChannelPlace, Contents, Conversion, DataGroup, Field, Group, Piece

_CHANNEL = "<5IH32s128s4H24x"  # next, conversion, source, dependency, comment; type, name, description; first bit, bits, coding, flag
_CHANNEL_BYTES = 218
_MASTER = 1
_MOTOROLA_TYPES = (9, 10, 11, 12)
_KINDS = {0: "unsigned", 1: "signed", 2: "real", 3: "real", 7: "text", 9: "unsigned", 10: "signed", 11: "real", 12: "real"}
_KINDS |= {13: "unsigned", 14: "signed", 15: "real", 16: "real"}
_OWN_ORDER = (0, 1, 2, 3)  # codings in the byte order of the file
_DATE_BYTES = 18


def read_version3(file: BlockFile, version: str, unfinished: int) -> Contents:
    """Groups and channels of a file.

    Args:
        file: the file.
        version: as it says.
        unfinished: flags of what its writer left to be completed; 0 for a file that was closed.

    Raises:
        DataError: it is damaged, or holds what is not read.
    """
    (big_endian,) = file.unpack("<H", 24)
    length = _head(file, 64, b"HD")
    (address,) = file.unpack("<I", 68)
    groups: list[Group] = []
    trail, places = Trail(file, "data groups"), _Places(file)
    while address:
        trail.step(address)
        _head(file, address, b"DG")
        address, first, _, blocks, count, id_bytes = file.unpack("<4I2H", address + 4)
        if id_bytes not in (0, 1, 2):
            raise file.damaged(f"records are numbered {id_bytes} times")
        data = DataGroup(blocks, min(id_bytes, 1), repeated_id=id_bytes == 2)
        if count > 1 and not id_bytes:
            raise file.damaged("several groups share blocks whose records are not numbered")
        for _ in range(count):
            if not first:
                break
            first = _read_group(file, first, data, groups, places)
    return Contents(
        version=version,
        start=_start(file, length),
        groups=groups,
        field=lambda place: _field(file, place, bool(big_endian)),
        pieces=lambda data: _pieces(file, data, groups, bool(unfinished)),
        counted=not unfinished,
    )


class _Places:
    def __init__(self, file: BlockFile) -> None:
        self.groups, self.channels = Trail(file, "channel groups"), Trail(file, "channels")


def _head(file: BlockFile, address: int, kind: bytes) -> int:
    """Length of a block."""
    head = file.read(address, 4)
    if head[:2] != kind:
        raise file.damaged(f"at byte {address} stands {head[:2]!r} instead of {kind!r}")
    length = int.from_bytes(head[2:], "little")
    if address + length > file.size:
        raise file.damaged(f"the {kind.decode()} block at byte {address} is cut")
    return length


def _text(file: BlockFile, address: int) -> str:
    if not address:
        return ""
    if address not in file.texts:
        length = _head(file, address, b"TX")
        file.keep_text(address, file.read(address + 4, max(length - 4, 0)), "latin-1")
    return file.texts[address]


def _read_group(file: BlockFile, address: int, data: DataGroup, groups: list[Group], places: _Places) -> int:
    """Read a group; returns the next one's address."""
    places.groups.step(address)
    _head(file, address, b"CG")
    following, channel, comment, record_id, _, record_bytes, samples = file.unpack("<3I3HI", address + 4)
    group = Group(len(groups), _text(file, comment), samples, record_id, record_bytes, 0, data)
    if record_id in data.sizes:
        raise file.damaged(f"two groups number their records {record_id}")
    data.sizes[record_id] = record_bytes
    groups.append(group)
    while channel:
        places.channels.step(channel)
        length = _head(file, channel, b"CN")
        (kind,) = file.unpack("<H", channel + 24)
        group.channels += [ChannelPlace(channel, name, kind == _MASTER) for name in _names(file, channel, length)]
        (channel,) = file.unpack("<I", channel + 4)
    return following


def _names(file: BlockFile, address: int, length: int) -> list[str]:
    """A channel's name, the long one where there is one, and the name that is shown instead of it."""
    short = file.read(address + 26, 32).split(b"\0", 1)[0].decode("latin-1").strip(" \t\n\r")
    behind = address + _CHANNEL_BYTES
    long = _text(file, file.unpack("<I", behind)[0]) if length >= _CHANNEL_BYTES + 4 else ""
    alias = _text(file, file.unpack("<I", behind + 4)[0]) if length >= _CHANNEL_BYTES + 8 else ""
    return list(dict.fromkeys([long or short, *([alias] if alias else [])]))


def _field(file: BlockFile, place: ChannelPlace, is_motorola: bool) -> Field:
    length = _head(file, place.address, b"CN")
    _, conversion, _, dependency, *_ = file.unpack("<5I", place.address + 4)
    first_bit, bits, coding = file.unpack("<3H", place.address + 186)
    if length >= _CHANNEL_BYTES + 10:
        first_bit += 8 * file.unpack("<H", place.address + _CHANNEL_BYTES + 8)[0]
    meaning = "other" if dependency else _KINDS.get(coding, "other")
    where = f"signal '{shown(place.name)}'"
    unit, apply = ("", conversions.same) if not conversion else _conversion(file, conversion, where)
    return Field(
        kind=meaning,  # type: ignore[arg-type]
        big_endian=coding in _MOTOROLA_TYPES or (is_motorola and coding in _OWN_ORDER),
        byte=first_bit // 8,
        bit=first_bit % 8,
        bits=bits,
        invalid_bit=None,
        all_invalid=False,
        unit=unit,
        conversion=apply if meaning not in ("text", "other") else conversions.same,
    )


def _conversion(file: BlockFile, address: int, where: str) -> tuple[str, Conversion]:
    """Unit and conversion of a block."""
    length = _head(file, address, b"CC")
    unit = file.read(address + 22, 20).split(b"\0", 1)[0].decode("latin-1").strip(" \t\n\r")
    kind, count = file.unpack("<2H", address + 42)
    content = file.read(address + 46, max(length - 46, 0))
    if kind == 10:
        written = content.split(b"\0", 1)[0].decode("latin-1").strip(" \t\n\r")
        return unit, conversions.formula(file, where, written)
    if kind in (7, 8):
        raise file.unsupported(
            f"converts {where} by an exponential or logarithm, which programs compute in different ways", "export it as plain numbers"
        )
    if kind in (11, 12):
        return unit, conversions.text
    if kind == 65535:
        return unit, conversions.same
    needed = {0: 2, 1: 2 * count, 2: 2 * count, 6: 6, 9: 6}.get(kind)
    if not needed or len(content) < 8 * needed:
        raise file.damaged(f"{where}: a conversion of kind {kind} with {count} values in {length} bytes")
    values = np.frombuffer(content, "<f8", needed)
    if kind == 0:
        return unit, conversions.linear(float(values[0]), float(values[1]))
    if kind == 6:
        return unit, conversions.polynomial(values.tolist())
    if kind == 9:
        return unit, conversions.rational(values.tolist())
    if not (np.diff(values[::2]) >= 0).all():
        raise file.damaged(f"{where}: the points of its table do not ascend")
    return unit, conversions.table(values[::2], values[1::2], interpolated=kind == 1)


def _pieces(file: BlockFile, data: DataGroup, groups: list[Group], is_open: bool) -> list[Piece]:
    """The one block of data, as long as its groups say."""
    if not data.address:
        return []
    around = data.id_bytes * (2 if data.repeated_id else 1)
    announced = sum((group.record_bytes + around) * group.samples for group in groups if group.data is data)
    there = max(file.size - data.address, 0)
    length = there if is_open else min(announced, there)
    return [Piece(data.address, length, length)]


def _start(file: BlockFile, length: int) -> str:
    """When the measurement started, local time."""
    if length >= 164 + 10:
        nanoseconds, offset = file.unpack("<Qh", 64 + 164)
        if nanoseconds:
            try:
                zone = timezone(timedelta(hours=offset))
                return (datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=nanoseconds // 1000)).astimezone(zone).isoformat()
            except (OverflowError, ValueError):
                return ""
    try:
        written = file.read(64 + 18, _DATE_BYTES).decode("ascii")
        return datetime.strptime(written, "%d:%m:%Y%H:%M:%S").isoformat()
    except ValueError:
        return ""
