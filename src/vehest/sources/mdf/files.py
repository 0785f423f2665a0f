"""Signals of ASAM MDF files: physical values with their times, and one clear line for what cannot be used.

vehest reads the format itself. A reader that also converts, finishes and decodes measurements hands a file's formulas to an interpreter,
unpacks its attachments and follows its links in circles; here nothing that a file holds is executed, unpacked to disk or followed twice.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vehest.alignment.checks import checks_of_clock
from vehest.constants import FloatArray
from vehest.data.errors import DataError, printable
from vehest.data.files import regular_file
from vehest.data.limits import check_limit
from vehest.sources.mdf.blocks import BlockFile, shown
from vehest.sources.mdf.conversions import TextError
from vehest.sources.mdf.data_blocks import records_of
from vehest.sources.mdf.layout import ChannelPlace, Contents, Field, Group
from vehest.sources.mdf.values import invalid_samples, is_number, raw_values
from vehest.sources.mdf.version3 import read_version3
from vehest.sources.mdf.version4 import read_version4
from vehest.sources.signals import Signal

FINISHED, UNFINISHED = b"MDF     ", b"UnFinMF "
COMPARED = 10_000  # names that a misspelt one is compared with
BUS_FRAMES = ("CAN_DataFrame", "LIN_Frame", "ETH_Frame", "FLX_Frame")


@dataclass(frozen=True)
class Wanted:
    """Where a signal stands.

    Args:
        name: of the signal in the file.
        group: number or name of its channel group, where the name occurs in several.
    """

    name: str
    group: int | str | None = None


@dataclass(frozen=True)
class Measurement:
    """What is read of a file.

    Args:
        signals: by the names under which they are wanted.
        version: of the format.
        start: when the measurement started, ISO 8601.
    """

    signals: Mapping[str, Signal]
    version: str
    start: str


def read_measurement(path: Path, wanted: Mapping[str, Wanted]) -> Measurement:
    """Read signals of an MDF file of version 2, 3 or 4.

    Raises:
        MissingError: there is no such file.
        DataError: the file cannot be read or is more than the limits, or a signal is not there, ambiguous, no number, or without
            usable times.
    """
    try:
        with open(regular_file(path), "rb") as stream:
            file = BlockFile(stream, path)
            contents = _contents(file)
            places = contents.places()
            found = {name: _locate(places, one, path) for name, one in wanted.items()}
            signals: dict[str, Signal] = {}
            for group in {id(group): group for group, _ in found.values()}.values():
                signals |= _signals(file, contents, group, {name: place for name, (one, place) in found.items() if one is group})
            return Measurement({name: signals[name] for name in wanted}, contents.version, contents.start)
    except OSError as error:
        raise DataError(f"cannot read '{path}': {error.strerror or error}; check the disk and its permissions") from None
    except MemoryError:
        raise DataError(f"'{path}' asks for more memory than there is; is it damaged? otherwise read fewer signals of it") from None


def names_in_groups(path: Path) -> list[tuple[str, int]]:
    """Signals that a file says it holds, clocks left out, with the number of each one's group.

    Raises:
        MissingError: there is no such file.
        DataError: it cannot be read or is more than the limits.
    """
    try:
        with open(regular_file(path), "rb") as stream:
            groups = _contents(BlockFile(stream, path)).groups
    except OSError as error:
        raise DataError(f"cannot read '{path}': {error.strerror or error}; check the disk and its permissions") from None
    return [(channel.name, group.number) for group in groups for channel in group.channels if not channel.is_time]


def _contents(file: BlockFile) -> Contents:
    """What the file says that it holds."""
    head = file.read(0, min(file.size, 64))
    if not head.startswith((FINISHED, UNFINISHED)):
        raise DataError(f"'{file.path}' is not an MDF file: it does not begin with 'MDF'; is it of another format, or compressed?")
    if len(head) < 64:
        raise file.damaged("its head is incomplete")
    number = int.from_bytes(head[28:30], "little")
    version = printable(head[8:16].split(b"\0", 1)[0].decode("latin-1").strip())
    unfinished = int.from_bytes(head[60:62], "little") if head.startswith(UNFINISHED) else 0
    if 200 <= number < 400:
        return read_version3(file, version, unfinished)
    if 400 <= number < 500:
        return read_version4(file, version, unfinished)
    raise file.unsupported(f"is of version {number / 100:.2f}", "versions 2, 3 and 4 are")


def _signals(file: BlockFile, contents: Contents, group: Group, places: Mapping[str, ChannelPlace]) -> dict[str, Signal]:
    """Signals of one group."""
    clock = group.clock()
    first = next(iter(places.values()))
    if clock is None:
        raise DataError(f"{_where(file, first, group)} has no time stamps: its group has no master channel of time")
    fields = {name: contents.field(place) for name, place in places.items()}
    times = contents.field(clock)
    for place, field in [*((places[name], field) for name, field in fields.items()), (clock, times)]:
        where = _where(file, place, group)
        if field.is_outside(group.record_bytes, group.invalidation_bytes):
            raise DataError(f"{where} stands outside of its group's records; the file is damaged")
        _require_number(field, where)
    columns, count = _columns(file, contents, group, [times, *fields.values()])
    if contents.counted and count != group.samples:
        raise DataError(
            f"{_where(file, first, group)} holds {count} samples, its header says {group.samples}; the file is truncated or damaged"
        )
    stamps = _physical(times, columns[0], _where(file, clock, group))
    for finding in checks_of_clock(stamps):
        if finding.check == "clock":
            raise DataError(f"{_where(file, first, group)}: {finding.message}; repair the measurement, or cut the range out")
    signals = {}
    for number, (name, field) in enumerate(fields.items(), start=1):
        values = _physical(field, columns[number], _where(file, places[name], group))
        signals[name] = Signal(f"group {shown(group.title)}", stamps, values, field.unit)
        columns[number] = np.empty(0)
    return signals


def _columns(file: BlockFile, contents: Contents, group: Group, fields: Sequence[Field]) -> tuple[list[FloatArray], int]:
    """Raw values of channels, NaN where they are marked as invalid, and how many there are of each."""
    parts: list[list[FloatArray]] = [[] for _ in fields]
    count = 0
    pieces = contents.pieces(group.data)
    for records in records_of(file, pieces, group, group.samples if contents.counted else None):
        for part, field in zip(parts, fields, strict=True):
            values = raw_values(records, field, count)
            if field.all_invalid or field.invalid_bit is not None:
                values[invalid_samples(records, field, group.record_bytes)] = np.nan
            part.append(values)
        count += len(records)
        n_values = count * len(fields)
        check_limit("memory", 8 * n_values, f"'{file.path}': group {shown(group.title)} holds {n_values} values or more")
    columns = []
    while parts:
        part = parts.pop(0)
        columns.append(np.concatenate(part) if part else np.empty(0))
    return columns, count


def _physical(field: Field, raw: FloatArray, where: str) -> FloatArray:
    """Physical values; invalid samples stay NaN and meet no conversion."""
    valid = ~np.isnan(raw) if field.all_invalid or field.invalid_bit is not None else None
    try:
        with np.errstate(all="ignore"):
            if valid is None or valid.all():
                return np.asarray(field.conversion(raw), dtype=np.float64)
            raw[valid] = field.conversion(raw[valid])
            return raw
    except TextError:
        raise _no_number(where, "text") from None


def _require_number(field: Field, where: str) -> None:
    if field.kind in ("text", "other"):
        raise _no_number(where, "text" if field.kind == "text" else "an array or structure")
    if not is_number(field):
        raise DataError(f"{where} is coded in {field.bits} bits from bit {field.bit} on, as no number is; the file is damaged")


def _no_number(where: str, what: str) -> DataError:
    return DataError(f"{where} holds {what}; numbers are needed: name another signal, or one without a conversion to text")


def _where(file: BlockFile, place: ChannelPlace, group: Group) -> str:
    return f"'{file.path}': signal '{shown(place.name)}' of group {shown(group.title)}"


def _locate(places: Mapping[str, list[tuple[Group, ChannelPlace]]], wanted: Wanted, path: Path) -> tuple[Group, ChannelPlace]:
    """A signal's group and its place in it."""
    found = places.get(wanted.name, [])
    if not found:
        raise DataError(f"'{path}' has no signal '{wanted.name}' ({_near(places, wanted.name)}); correct the map in conf/dataset")
    kept = [(group, place) for group, place in found if wanted.group is None or wanted.group in (group.number, group.name)]
    titles = list(dict.fromkeys(shown(group.title) for group, _ in kept or found))
    groups = ", ".join(titles[:12]) + (", …" if len(titles) > 12 else "")
    if not kept:
        raise DataError(f"'{path}': signal '{wanted.name}' is not in group '{wanted.group}', but in {groups}; correct group")
    if len(titles) > 1:
        raise DataError(f"'{path}': signal '{wanted.name}' stands in several groups: {groups}; say which by number or name with group: …")
    if len(kept) > 1:
        raise DataError(f"'{path}': signal '{wanted.name}' stands {len(kept)} times in group {groups}; rename all but one")
    return kept[0]


def _near(places: Mapping[str, object], name: str) -> str:
    names = {known: known.lower() for known in list(places)[:COMPARED] if len(known) < 200}
    close = difflib.get_close_matches(name.lower(), list(names.values()), n=3, cutoff=0.6)
    if close:
        return "near it: " + ", ".join(shown(known) for known, lower in names.items() if lower in close[:3])
    if any(known.startswith(BUS_FRAMES) for known in names):
        return "it holds undecoded frames of a bus: decode them with their description, for example by asammdf's extract_bus_logging"
    return f"it has {len(places)} signals"
