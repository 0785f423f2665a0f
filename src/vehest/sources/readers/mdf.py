"""Signals of ASAM MDF 2, 3 and 4 by asammdf. A file that holds a formula is refused before any
sample is read.

file -> groups and channels -> conversions checked -> raw samples -> physical values and times
"""

from __future__ import annotations

import io
import math
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import asammdf
import numpy as np
from asammdf.blocks import mdf_v3, mdf_v4, v2_v3_blocks, v4_blocks
from asammdf.blocks import v2_v3_constants as v3
from asammdf.blocks import v4_constants as v4

from vehest.constants import FloatArray
from vehest.data.errors import DataError, first_of, printable, suggestion
from vehest.data.limits import check_limit
from vehest.sources.limited import Arrays
from vehest.sources.not_measured import marks_not_measured

FINISHED = b"MDF     "  # first bytes of a file
UNFINISHED = b"UnFinMF "  # first bytes of a file that its logger did not close
EVALUATED = {
    v2_v3_blocks.ChannelConversion: {
        v3.CONVERSION_TYPE_FORMULA,
        v3.CONVERSION_TYPE_EXPO,
        v3.CONVERSION_TYPE_LOGH,
    },
    v4_blocks.ChannelConversion: {v4.CONVERSION_TYPE_ALG},
}
"""Types of conversion for which a file is refused: formulas, and those of version 3 that readers
compute in contradicting ways.
"""
RANGES = {
    v2_v3_blocks.ChannelConversion: {v3.CONVERSION_TYPE_TABX, v3.CONVERSION_TYPE_RTABX},
    v4_blocks.ChannelConversion: {
        v4.CONVERSION_TYPE_RTAB,
        v4.CONVERSION_TYPE_TABX,
        v4.CONVERSION_TYPE_RTABX,
    },
}
"""Types of conversion by ranges, for which whole numbers differ from real ones: whole numbers
belong to both ends of a range.
"""
# options with which asammdf opens a file: databases that are attached are not read
OPTIONS: Any = {"process_bus_logging": False}
COMPARED = 10_000  # largest number of names with which a misspelt one is compared
# names of channels that hold raw frames of a bus
BUS_FRAMES = ("CAN_DataFrame", "LIN_Frame", "ETH_Frame", "FLX_Frame")


def read(
    file: Path, requests: Mapping[str, tuple[str, int | str | None]] | None
) -> tuple[Arrays, dict[str, Any]]:
    """Signals with the times of their groups.

    Parameters
    ----------
    file : Path
        ASAM MDF 2, 3 or 4.
    requests : mapping or None
        Key -> name of a signal, and number or name of its group where the name occurs in several;
        None for every signal of numbers whose group has times.

    Returns
    -------
    arrays : dict
        ``KEY``, physical values in the file's unit, NaN where marked invalid, and ``stamps GROUP``
        [s], shape (T,) each.
    summary : dict
        ``version``, ``start``, ``signals`` (key -> name, group, its title and the unit) and
        ``skipped`` (reasons).

    Raises
    ------
    DataError
        The file is no MDF, is damaged, holds a formula or more than the limits allow, or a wanted
        signal cannot be read.
    """
    forbid_evaluation()
    with open(file, "rb") as stream:
        head = stream.read(64)
        if not head.startswith((FINISHED, UNFINISHED)):
            raise DataError(
                f"'{file}' is not an MDF file: it does not begin with 'MDF'; is it of another "
                "format, or compressed?"
            )
        stream.seek(0)
        # an unfinished file is completed by asammdf in place
        content = io.BytesIO(stream.read()) if head.startswith(UNFINISHED) else stream
        try:
            measurement = asammdf.MDF(content, **OPTIONS)
        except Exception as error:
            reason = printable(" ".join(str(error).split())[:160]) or type(error).__name__
            raise DataError(
                f"'{file}' cannot be read as MDF ({reason}); is it truncated or damaged?"
            ) from None
        _refuse_formulas(measurement, file)
        places = (
            _located(measurement, requests, file)
            if requests is not None
            else _numbered(measurement, file)
        )
        arrays: Arrays = {}
        skipped: list[str] | None = [] if requests is None else None
        for group in dict.fromkeys(group for group, _ in places.values()):
            indices = {key: index for key, (at, index) in places.items() if at == group}
            with _or_skip(skipped, file):
                arrays |= _group_of(measurement, group, indices, file, skipped)
        signals = {}
        for key, (group, index) in places.items():
            if key in arrays:
                channel = measurement.groups[group].channels[index]
                unit = str((channel.conversion and channel.conversion.unit) or channel.unit or "")
                signals[key] = {
                    "name": channel.name,
                    "group": group,
                    "title": _title(measurement, group),
                    "unit": unit,
                }
        return arrays, {
            "version": measurement.version,
            "start": measurement.header.start_time.isoformat(),
            "signals": signals,
            "skipped": skipped or [],
        }


def with_signals(
    file: Path,
    seconds: list[float],
    signals: list[tuple[str, list[float], str, str, dict[str, str]]],
) -> tuple[Arrays, dict[str, Any]]:
    """A measurement of version 4 with a group of signals more.

    Parameters
    ----------
    file : Path
        The measurement, which is not changed.
    seconds : list of float
        Times of the new group, shape (T,) [s].
    signals : list of tuple
        Of each signal name, values, shape (T,), unit, comment and, where values are codes, code ->
        text of each; codes are stored as integers, other values as float64.

    Returns
    -------
    arrays : dict
        ``content``, the bytes of the new file.
    summary : dict
        Empty.

    Raises
    ------
    DataError
        The measurement is of another version.
    """
    forbid_evaluation()
    with open(file, "rb") as stream:
        measurement = asammdf.MDF(io.BytesIO(stream.read()), **OPTIONS)
        new = io.BytesIO()
        if measurement.version < "4":
            raise DataError(
                f"'{file}' is of MDF {measurement.version}, which gets no channels; write a .mat "
                "file, or save the log as MDF 4"
            )
        group = []
        for name, values, unit, comment, texts in signals:
            table: dict[str, object] = {
                key: entry
                for k, (code, text) in enumerate(texts.items())
                for key, entry in ((f"val_{k}", int(code)), (f"text_{k}", text))
            }
            samples = np.array(values, dtype=np.int32 if texts else np.float64)
            group.append(
                asammdf.Signal(samples, np.array(seconds), unit, name, table or None, comment)
            )
        measurement.append(group, acq_name="vehest", common_timebase=True)
        measurement.save(new)
        return {"content": np.frombuffer(new.getvalue(), dtype=np.uint8)}, {}


@contextmanager
def _or_skip(skipped: list[str] | None, file: Path) -> Iterator[None]:
    """Keep an error as a line of ``skipped``, where there is one."""
    try:
        yield
    except DataError as error:
        if skipped is None:
            raise
        skipped.append(str(error).removeprefix(f"'{file}': "))


def forbid_evaluation() -> None:
    """Replace the evaluators of formulas: rational conversions then take asammdf's plain
    arithmetic, formulas end in an error.
    """

    def refuse_evaluation(*_: Any, **__: Any) -> NoReturn:
        raise TypeError("formulas are not evaluated")

    for module in (v2_v3_blocks, v4_blocks):
        for name in ("evaluate", "lambdify", "symbols"):
            setattr(module, name, refuse_evaluation)
    for module in (mdf_v3, mdf_v4):
        setattr(module, "NamedTemporaryFile", lambda **_: io.BytesIO())  # noqa: B010


def _refuse_formulas(measurement: Any, file: Path) -> None:
    """Refuse, by a `DataError`, a file of which any signal, wanted or not, has one of
    `EVALUATED`.
    """
    for group in measurement.groups:
        for channel in group.channels:
            for conversion in _conversions(channel.conversion):
                if conversion.conversion_type in EVALUATED[type(conversion)]:
                    raise DataError(
                        f"'{file}': signal '{_short_name(channel.name)}' has a conversion by a "
                        "formula, which is not evaluated; "
                        f"export it as plain numbers, or with a linear conversion"
                    )


def _conversions(conversion: Any) -> Iterator[Any]:
    """A conversion and those inside it."""
    waiting = [conversion]
    visited = set()
    while waiting:
        block = waiting.pop()
        if type(block) in EVALUATED and id(block) not in visited:
            visited.add(id(block))
            yield block
            waiting += (block.referenced_blocks or {}).values()


def _numbered(measurement: Any, file: Path) -> dict[str, tuple[int, int]]:
    """Key of every signal -> its group and place."""
    places = [(channel.name, g, index) for g, index, channel in _channels(measurement)]
    check_limit("columns", len(places), f"'{file}' has {len(places)} signals")
    often = Counter(name for name, *_ in places)
    return {
        (f"{name} (group {g})" if often[name] > 1 else name): (g, index)
        for name, g, index in places
    }


def _channels(measurement: Any) -> Iterator[tuple[int, int, Any]]:
    """Group, place and channel of every signal that is no clock."""
    for g, group in enumerate(measurement.groups):
        for index, channel in enumerate(group.channels):
            if index != measurement.masters_db.get(g):
                yield g, index, channel


def _located(
    measurement: Any, requests: Mapping[str, tuple[str, int | str | None]], file: Path
) -> dict[str, tuple[int, int]]:
    """Key -> group and place of its signal; `DataError` where a name is unknown or ambiguous.

    In versions before 4 a signal is also found by its display names.
    """
    places: dict[str, list[tuple[int, int]]] = {}
    for g, index, channel in _channels(measurement):
        for name in dict.fromkeys(
            (channel.name, *(channel.display_names if measurement.version < "4" else ()))
        ):
            places.setdefault(name, []).append((g, index))
    return {
        key: _place_of(measurement, places, name, group, file)
        for key, (name, group) in requests.items()
    }


def _place_of(
    measurement: Any,
    places: Mapping[str, list[tuple[int, int]]],
    name: str,
    group: int | str | None,
    file: Path,
) -> tuple[int, int]:
    """Group and place of the one signal of a name, in the group of a number or name if one is
    given.
    """
    candidates = places.get(name, [])
    if not candidates:
        signals = [signal for signal in list(places)[:COMPARED] if len(signal) < 200]
        meant = printable(suggestion(name, signals))
        if not meant and any(signal.startswith(BUS_FRAMES) for signal in places):
            meant = (
                "; it holds undecoded frames of a bus: decode them with their description, for "
                "example by asammdf's extract_bus_logging"
            )
        raise DataError(
            f"'{file}' has no signal '{name}'{meant or '; correct the map in conf/dataset'}"
        )
    matching = [
        place
        for place in candidates
        if group is None or group in (place[0], _group_name(measurement, place[0]))
    ]
    titles = list(dict.fromkeys(_title(measurement, g) for g, _ in matching or candidates))
    groups = first_of(titles, 12)
    if not matching:
        raise DataError(
            f"'{file}': signal '{name}' is not in group '{group}', but in {groups}; correct group"
        )
    if len(matching) > 1:
        advice = (
            "say which by number or name with group: …" if len(titles) > 1 else "rename all but one"
        )
        raise DataError(
            f"'{file}': signal '{name}' stands {len(matching)} times, in group {groups}; {advice}"
        )
    return matching[0]


def _group_of(
    measurement: Any, group: int, indices: Mapping[str, int], file: Path, skipped: list[str] | None
) -> Arrays:
    """Times of a group and its signals.

    A signal that cannot be read is an error, or a line in ``skipped``.
    """
    title = _title(measurement, group)
    described = measurement.groups[group]
    clock = measurement.masters_db.get(group)
    indices_read = {"": clock, **indices}
    location_of = {
        key: f"'{file}': signal '{_short_name(described.channels[index].name)}' of group {title}"
        for key, index in indices_read.items()
        if index is not None
    }
    first = location_of[next(iter(indices))]
    if (
        clock is None
        or getattr(described.channels[clock], "sync_type", v4.SYNC_TYPE_TIME) != v4.SYNC_TYPE_TIME
    ):
        raise DataError(f"{first} has no time stamps: its group has no master channel of time")
    count = described.channel_group.cycles_nr
    check_limit("samples", count, f"'{file}': group {title} says that it holds {count} samples")
    record = described.channel_group.samples_byte_nr + (
        0 if described.uses_ld else _invalidation_bytes(described)
    )
    present = sum(
        min(block.original_size, block.block_limit or block.original_size)
        for block in described.get_data_blocks()
    )
    if present < count * record:
        raise DataError(
            f"{first} holds {present // record} samples, its header says {count}; the file is "
            "truncated or damaged"
        )
    read: dict[str, int] = {}
    for key, index in indices_read.items():
        with _or_skip(skipped if key else None, file):
            _require_number(measurement, group, index, location_of[key])
            read[key] = index
    arrays = {}
    samples = measurement.select(
        [(None, group, index) for index in read.values()], raw=True, copy_master=False
    )
    for (key, index), raw in zip(read.items(), samples, strict=True):
        with _or_skip(skipped if key else None, file):
            conversion = described.channels[index].conversion
            arrays[key or f"stamps {group}"] = _physical(
                raw.samples, raw.invalidation_bits, conversion, location_of[key]
            )
    return arrays


def _require_number(measurement: Any, group: int, index: int, location: str) -> None:
    """Refuse, by a `DataError`, a signal that is no number, or whose bits lie outside of its
    records.
    """
    described = measurement.groups[group]
    channel = described.channels[index]
    if described.channel_dependencies[index]:
        raise DataError(
            f"{location} holds an array or structure; numbers are needed: name another signal"
        )
    if channel.conversion_addr and channel.conversion is None:  # asammdf would give the raw numbers
        raise DataError(f"{location} has a conversion that cannot be read; the file is damaged")
    if measurement.version < "4":
        first = 8 * getattr(channel, "additional_byte_offset", 0) + channel.start_offset
        end = first + channel.bit_count
    elif channel.channel_type in (v4.CHANNEL_TYPE_VIRTUAL, v4.CHANNEL_TYPE_VIRTUAL_MASTER):
        end = 0
    else:
        end = 8 * channel.byte_offset + channel.bit_offset + channel.bit_count
    marked = getattr(channel, "flags", 0) & v4.FLAG_CN_INVALIDATION_PRESENT
    outside = marked and channel.pos_invalidation_bit >= 8 * _invalidation_bytes(described)
    if outside or end > 8 * described.channel_group.samples_byte_nr:
        raise DataError(f"{location} stands outside of its group's records; the file is damaged")


def _invalidation_bytes(group: Any) -> int:
    """Bytes of each record that mark invalid samples; 0 before version 4."""
    return int(getattr(group.channel_group, "invalidation_bytes_nr", 0))


def _physical(raw: np.ndarray, invalid: Any, conversion: Any, location: str) -> FloatArray:
    """Physical values, float64; invalid samples become NaN and meet no conversion."""
    if raw.dtype.kind not in "biuf" or raw.ndim != 1:
        kind = "text" if raw.dtype.kind in "SU" else "an array or structure"
        raise DataError(f"{location} holds {kind}; numbers are needed: name another signal")
    valid = slice(None) if invalid is None else ~np.asarray(invalid, dtype=bool)
    physical = raw[valid]
    if conversion is None or conversion.conversion_type not in RANGES[type(conversion)]:
        physical = physical.astype(np.float64)
    if conversion is not None and len(physical):
        with np.errstate(all="ignore"):
            if (
                type(conversion) is v4_blocks.ChannelConversion
                and conversion.conversion_type == v4.CONVERSION_TYPE_RTAB
            ):
                physical = _of_ranges(physical, conversion)
            else:
                physical = conversion.convert(physical, as_object=True)
    if physical.dtype.kind == "O":  # numbers with texts among them, as a conversion gives them
        physical = np.array([_measured(value) for value in physical], dtype=object)
    if physical.dtype.kind in "SU" or (
        physical.dtype.kind == "O" and any(isinstance(value, bytes | str) for value in physical)
    ):
        raise DataError(
            f"{location} holds text; numbers are needed: name another signal, or one without a "
            "conversion to text"
        )
    values = np.full(len(raw), np.nan)
    values[valid] = physical
    return values


def _measured(value: Any) -> Any:
    """Result of a conversion; NaN for a text that says that nothing was measured."""
    text = value.decode("utf-8", errors="replace") if isinstance(value, bytes) else value
    return math.nan if isinstance(text, str) and marks_not_measured(text) else value


def _of_ranges(raw: np.ndarray, conversion: Any) -> FloatArray:
    """Values of ranges: whole numbers belong to both ends of one, which asammdf gets wrong, real
    numbers not to the upper.
    """
    count = (conversion.val_param_nr - 1) // 3
    rows = np.array(
        sorted(
            (conversion[f"lower_{k}"], conversion[f"upper_{k}"], conversion[f"phys_{k}"])
            for k in range(count)
        )
    )
    lower, upper, physical = rows.reshape(-1, 3).T
    at = np.maximum(np.searchsorted(lower, raw, side="right") - 1, 0)
    is_below = raw < upper[at] if raw.dtype.kind == "f" else raw <= upper[at]
    return np.where((lower[at] <= raw) & is_below, physical[at], conversion.default)


def _group_name(measurement: Any, group: int) -> str:
    """Name of a group: that of its acquisition, or before version 4 its comment."""
    described = measurement.groups[group].channel_group
    return str(described.acq_name if measurement.version >= "4" else described.comment)


def _title(measurement: Any, group: int) -> str:
    """Number of a group, with its name where it has one, for messages."""
    name = _group_name(measurement, group)
    return f"{group} '{_short_name(name)}'" if name else str(group)


def _short_name(name: str) -> str:
    """A name for messages, printable, cut off after 120 characters."""
    return printable(name if len(name) <= 120 else name[:120] + "…")
