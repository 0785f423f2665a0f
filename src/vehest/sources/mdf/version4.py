"""What a file of MDF 4 says that it holds.

Format: ASAM MDF 4.2, Measurement Data Format. Comments, attachments, events and sources are passed by: nothing is taken out of them.
"""

from __future__ import annotations

import html
import re
from datetime import UTC, datetime, timedelta, timezone

import numpy as np

from vehest.sources.mdf import conversions
from vehest.sources.mdf.blocks import BlockFile, Trail, shown
from vehest.sources.mdf.layout import ChannelPlace, Contents, Conversion, DataGroup, Field, Group, Piece

_HEAD_BYTES = 24
_COUNTS_OPEN, _LAST_BLOCK_OPEN = 0x01, 0x04  # flags of a file that was not closed
_VLSD_GROUP, _REMOTE_MASTER = 0x01, 0x08  # flags of a channel group
_ALL_INVALID, _MAY_BE_INVALID = 0x01, 0x02  # flags of a channel
_VALUE, _MASTER, _VIRTUAL_MASTER, _VIRTUAL = 0, 2, 3, 6  # types of channels
_TIME = 1  # kind of synchronisation
_KINDS = {
    0: "unsigned",
    1: "unsigned",
    2: "signed",
    3: "signed",
    4: "real",
    5: "real",
    6: "text",
    7: "text",
    8: "text",
    9: "text",
    17: "text",
}
_BIG_ENDIAN = (1, 3, 5)
_DEEPEST = 8  # conversions within conversions
_MOST_REFERENCES = 2**16 + 4
_PACKINGS = {2: "Zstandard", 3: "Zstandard", 4: "LZ4", 5: "LZ4"}


def read_version4(file: BlockFile, version: str, unfinished: int) -> Contents:
    """Groups and channels of a file.

    Args:
        file: the file.
        version: as it says.
        unfinished: flags of what its writer left to be completed; 0 for a file that was closed.

    Raises:
        DataError: it is damaged, or holds what is not read.
    """
    links, head = _block(file, 64, b"##HD", 6, "<Q2h4B")
    groups: list[Group] = []
    trails, address = _Trails(file), links[0]
    while address:
        trails.data_groups.step(address)
        address = _read_data_group(file, address, groups, trails)
    start = _start(head[0], head[1], head[2], head[3])
    return Contents(
        version=version,
        start=start,
        groups=groups,
        field=lambda place: _field(file, place),
        pieces=lambda data: _pieces(file, data.address, bool(unfinished & _LAST_BLOCK_OPEN)),
        counted=not unfinished & _COUNTS_OPEN,
    )


class _Trails:
    def __init__(self, file: BlockFile) -> None:
        self.data_groups, self.groups, self.channels = (Trail(file, what) for what in ("data groups", "channel groups", "channels"))


def _block(file: BlockFile, address: int, kind: bytes, links: int, layout: str) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """A block's first links, 0 for those it lacks, and the numbers behind its links."""
    _, present = _head(file, address, kind)
    numbers = file.unpack(layout, address + _HEAD_BYTES + 8 * present) if layout else ()
    read = min(links, present)
    return (*file.unpack(f"<{read}Q", address + _HEAD_BYTES), *(0 for _ in range(links - read))), numbers


def _head(file: BlockFile, address: int, kind: bytes) -> tuple[int, int]:
    """Length and number of links of a block."""
    head = file.read(address, _HEAD_BYTES)
    if head[:4] != kind:
        raise file.damaged(f"at byte {address} stands {head[:4]!r} instead of {kind!r}")
    length, links = int.from_bytes(head[8:16], "little"), int.from_bytes(head[16:24], "little")
    if length < _HEAD_BYTES + 8 * links or address + length > file.size:
        raise file.damaged(f"the {kind.decode()[2:]} block at byte {address} is cut: {length} bytes, {links} links")
    return length, links


def _text(file: BlockFile, address: int) -> str:
    """A text, or what the element TX of a comment holds."""
    if not address:
        return ""
    if address in file.texts:
        return file.texts[address]
    kind = file.read(address, 4)
    if kind not in (b"##TX", b"##MD"):
        raise file.damaged(f"at byte {address} stands {kind!r} instead of a text")
    length, links = _head(file, address, kind)
    begin = _HEAD_BYTES + 8 * links
    written = file.keep_text(address, file.read(address + begin, length - begin), "utf-8")
    if kind == b"##MD":
        found = re.search(r"<TX\b[^<>]{0,1000}>([^<]*)</TX>", written)
        file.texts[address] = html.unescape(found[1]).strip() if found else ""
    return file.texts[address]


def _read_data_group(file: BlockFile, address: int, groups: list[Group], trails: _Trails) -> int:
    """Read a data group; returns the next one's address."""
    (following, first, blocks), (id_bytes,) = _block(file, address, b"##DG", 3, "<B")
    if id_bytes not in (0, 1, 2, 4, 8):
        raise file.damaged(f"records are numbered by {id_bytes} bytes")
    data = DataGroup(blocks, id_bytes)
    group_address = first
    while group_address:
        if group_address != first and not id_bytes:
            raise file.damaged("several groups share blocks whose records are not numbered")
        trails.groups.step(group_address)
        group_address = _read_group(file, group_address, data, groups, trails)
    return following


def _read_group(file: BlockFile, address: int, data: DataGroup, groups: list[Group], trails: _Trails) -> int:
    layout = "<2Q2H4x2I"
    (following, channel, name), (record_id, samples, flags, _, record_bytes, invalidation_bytes) = _block(file, address, b"##CG", 3, layout)
    if flags & _REMOTE_MASTER:
        raise file.unsupported("stores its signals by columns (MDF 4.2)", "save it by rows, for example as MDF 4.10")
    group = Group(len(groups), _text(file, name), samples, record_id, record_bytes, invalidation_bytes, data)
    if record_id in data.sizes:
        raise file.damaged(f"two groups number their records {record_id}")
    data.sizes[record_id] = None if flags & _VLSD_GROUP else record_bytes + invalidation_bytes
    groups.append(group)
    waiting = [channel]  # a structure's parts wait behind what follows it
    while waiting:
        at = waiting.pop()
        if at:
            trails.channels.step(at)
            links, (kind, synchronised) = _block(file, at, b"##CN", 3, "<2B")
            is_time = kind in (_MASTER, _VIRTUAL_MASTER) and synchronised == _TIME
            group.channels.append(ChannelPlace(at, _text(file, links[2]), is_time))
            waiting.append(links[0])
            if links[1]:
                waiting.append(_first_part(file, links[1]))
    return following


def _first_part(file: BlockFile, address: int) -> int:
    """The first channel of a structure, also of an array of structures; 0 where there is none."""
    trail = Trail(file, "arrays")
    while address:
        trail.step(address)
        if file.read(address, 4) != b"##CA":
            return address
        (address,), _ = _block(file, address, b"##CA", 1, "")
    return 0


def _field(file: BlockFile, place: ChannelPlace) -> Field:
    links, numbers = _block(file, place.address, b"##CN", 8, "<4B4I")
    kind, _, coding, bit, byte, bits, flags, invalid_bit = numbers
    meaning = _KINDS.get(coding, "other") if kind in (_VALUE, _MASTER) and not links[1] else "other"
    if kind in (_VIRTUAL, _VIRTUAL_MASTER):
        meaning = "number"
    elif kind == 1 and _KINDS.get(coding) == "text":  # of any length
        meaning = "text"
    where = f"signal '{shown(place.name)}'"
    whole = meaning in ("unsigned", "signed", "number")
    return Field(
        kind=meaning,  # type: ignore[arg-type]
        big_endian=coding in _BIG_ENDIAN,
        byte=byte,
        bit=bit,
        bits=bits,
        invalid_bit=invalid_bit if flags & _MAY_BE_INVALID else None,
        all_invalid=bool(flags & _ALL_INVALID),
        unit=_conversion_unit(file, links[4]) or _text(file, links[6]),
        conversion=_conversion(file, links[4], where, whole) if meaning not in ("text", "other") else conversions.same,
    )


def _conversion_unit(file: BlockFile, address: int) -> str:
    return _text(file, _block(file, address, b"##CC", 2, "")[0][1]) if address else ""


def _conversion(file: BlockFile, address: int, where: str, whole: bool, depth: int = 0) -> Conversion:
    """What a conversion block says."""
    if not address:
        return conversions.same
    file.follow()
    if depth > _DEEPEST:
        raise file.damaged(f"{where}: its conversions nest deeper than {_DEEPEST} levels")
    _, links = _head(file, address, b"##CC")
    if links > _MOST_REFERENCES:
        raise file.damaged(f"{where}: a conversion refers to {links} blocks")
    references = file.unpack(f"<{links}Q", address + _HEAD_BYTES)[4:]
    kind, _, _, _, count = file.unpack("<2B3H", address + _HEAD_BYTES + 8 * links)
    values = np.frombuffer(file.read(address + _HEAD_BYTES + 8 * links + 24, 8 * count), "<f8")

    def referenced(number: int) -> Conversion:
        target = references[number] if number < len(references) else 0
        if target and file.read(target, 4) == b"##CC":
            return _conversion(file, target, where, whole, depth + 1)
        return conversions.text if target or number < len(references) - 1 else conversions.same

    if kind == 0:
        return conversions.same
    if kind == 1 and count >= 2:
        return conversions.linear(float(values[0]), float(values[1]))
    if kind == 2 and count >= 6:
        return conversions.rational(values.tolist())
    if kind == 3:
        return conversions.formula(file, where, _text(file, references[0]) if references else "")
    if kind in (4, 5) and count >= 2:
        raw, physical = values[: count // 2 * 2 : 2], values[1::2]
        if not (np.diff(raw) >= 0).all():
            raise file.damaged(f"{where}: the points of its table do not ascend")
        return conversions.table(raw, physical, interpolated=kind == 4)
    if kind == 6 and count >= 4:
        rows = values[: (count - 1) // 3 * 3].reshape(-1, 3)
        return conversions.ranges(rows[:, 0], rows[:, 1], rows[:, 2], float(values[(count - 1) // 3 * 3]), whole)
    if kind == 7:
        return conversions.choice(values, referenced, lambda: referenced(count))
    if kind == 8:
        lower, upper = values[: count // 2 * 2 : 2], values[1::2]
        return conversions.range_choice(lower, upper, referenced, lambda: referenced(count // 2), whole)
    if kind in (9, 10, 11):
        return conversions.text
    raise file.damaged(f"{where}: a conversion of kind {kind} with {count} values")


def _pieces(file: BlockFile, address: int, is_last_open: bool) -> list[Piece]:
    """Data blocks behind an address, in their order."""
    if not address:
        return []
    kind = file.read(address, 4)
    if kind == b"##HL":
        (address,), _ = _block(file, address, b"##HL", 1, "")
        if not address:
            return []
        kind = file.read(address, 4)
    if kind != b"##DL":
        return [_piece(file, address, is_last_open)]
    blocks: list[int] = []
    trail = Trail(file, "lists of data blocks")
    while address:
        trail.step(address)
        _, links = _head(file, address, b"##DL")
        file.follow(links)
        address, *listed = file.unpack(f"<{links}Q", address + _HEAD_BYTES) if links else (0,)
        blocks += [block for block in listed if block]
    return [_piece(file, block, is_last_open and block == blocks[-1]) for block in blocks]


def _piece(file: BlockFile, address: int, is_open: bool) -> Piece:
    """One data block."""
    kind = file.read(address, 4)
    if kind == b"##DT":
        if is_open and int.from_bytes(file.read(address + 8, 8), "little") <= _HEAD_BYTES:
            length = file.size - address  # the writer did not come to say how long it became
        else:
            length, _ = _head(file, address, b"##DT")
        return Piece(address + _HEAD_BYTES, length - _HEAD_BYTES, length - _HEAD_BYTES)
    if kind in (b"##LD", b"##DV"):
        raise file.unsupported("stores its signals by columns (MDF 4.2)", "save it by rows, for example as MDF 4.10")
    if kind != b"##DZ":
        raise file.damaged(f"at byte {address} stands {kind!r} instead of data")
    length, links = _head(file, address, b"##DZ")
    packing, columns, unpacked, packed = file.unpack("<2xBxI2Q", address + _HEAD_BYTES + 8 * links)
    if packing in _PACKINGS:
        raise file.unsupported(f"is compressed by {_PACKINGS[packing]}", "save it uncompressed or deflated")
    if packing > 1 or 48 + 8 * links + packed > length:
        raise file.damaged(f"a compressed block of {packed} bytes, packed by method {packing}, stands in one of {length}")
    return Piece(address + 48 + 8 * links, packed, unpacked, True, columns if packing == 1 else 0)


def _start(nanoseconds: int, offset: int, summer: int, flags: int) -> str:
    """When the measurement started: local time where the file says so, else with the offset to UTC it names."""
    try:
        moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=nanoseconds // 1000)
        if flags & 1:
            return moment.replace(tzinfo=None).isoformat()
        return moment.astimezone(timezone(timedelta(minutes=offset + summer) if flags & 2 else timedelta(0))).isoformat()
    except (OverflowError, ValueError):
        return ""
