"""What both versions of MDF describe: groups of channels, and where a channel's bits stand in a record."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from vehest.constants import FloatArray

Conversion = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Piece:
    """One data block.

    Args:
        address: of its bytes.
        packed: how many there are in the file.
        unpacked: how many they stand for.
        is_deflated: whether they are compressed.
        columns: of the matrix that was transposed before; 0 where none was.
    """

    address: int
    packed: int
    unpacked: int
    is_deflated: bool = False
    columns: int = 0


@dataclass(frozen=True)
class Field:
    """Where a channel's raw values stand, and what they mean.

    Args:
        kind: whole numbers without or with sign, real numbers, the record's number; text or something else, which is not read.
        big_endian: whether the most significant byte comes first.
        byte: of the record at which it begins.
        bit: of that byte, counted from the least significant.
        bits: how many it has.
        invalid_bit: of the invalidation bytes that says whether a sample holds; None where all hold.
        all_invalid: whether none does.
        unit: as the file writes it.
        conversion: from raw to physical values.
    """

    kind: Literal["unsigned", "signed", "real", "number", "text", "other"]
    big_endian: bool
    byte: int
    bit: int
    bits: int
    invalid_bit: int | None
    all_invalid: bool
    unit: str
    conversion: Conversion

    def is_outside(self, record_bytes: int, invalidation_bytes: int) -> bool:
        """Whether it reaches beyond its record."""
        if self.invalid_bit is not None and self.invalid_bit >= 8 * invalidation_bytes:
            return True
        return self.kind != "number" and 8 * self.byte + self.bit + self.bits > 8 * record_bytes


@dataclass(frozen=True)
class ChannelPlace:
    """A channel that was met: where it is described, and whether it is its group's clock."""

    address: int
    name: str
    is_time: bool


@dataclass
class DataGroup:
    """Groups whose records stand in the same blocks.

    Args:
        address: of the blocks; 0 where there are none.
        id_bytes: length of the number before each record that says whose it is.
        repeated_id: whether it stands behind the record, too.
        sizes: record number -> bytes of the record; None where each says its own length.
    """

    address: int
    id_bytes: int
    repeated_id: bool = False
    sizes: dict[int, int | None] = field(default_factory=dict)


@dataclass
class Group:
    """Channels of one raster.

    Args:
        number: counted from 0 through the file.
        name: of the acquisition, in version 3 the comment.
        samples: how many records there are, as the file says.
        record_id: its records' number.
        record_bytes: of a record's values.
        invalidation_bytes: behind them, which say what holds.
        data: where its records stand.
        channels: in their order, the clock included.
    """

    number: int
    name: str
    samples: int
    record_id: int
    record_bytes: int
    invalidation_bytes: int
    data: DataGroup
    channels: list[ChannelPlace] = field(default_factory=list)

    @property
    def title(self) -> str:
        """Number and name, for messages."""
        return f"{self.number} '{self.name}'" if self.name else str(self.number)

    def clock(self) -> ChannelPlace | None:
        """The channel of its times."""
        return next((channel for channel in self.channels if channel.is_time), None)


@dataclass(frozen=True)
class Contents:
    """What a file says that it holds.

    Args:
        version: of the format.
        start: when the measurement started, ISO 8601; empty where it does not say.
        groups: in the file's order.
        field: describes a channel fully.
        pieces: data blocks of a data group, in their order.
        counted: whether groups say how many records they have.
    """

    version: str
    start: str
    groups: list[Group]
    field: Callable[[ChannelPlace], Field]
    pieces: Callable[[DataGroup], list[Piece]]
    counted: bool = True

    def places(self) -> Mapping[str, list[tuple[Group, ChannelPlace]]]:
        """Channels that are no clocks, by name."""
        places: dict[str, list[tuple[Group, ChannelPlace]]] = {}
        for group in self.groups:
            for channel in group.channels:
                if not channel.is_time:
                    places.setdefault(channel.name, []).append((group, channel))
        return places
