"""Frames of a CAN bus, decoded by a DBC: frames of a message as rows of bytes -> signals, each with
the stamps of the frames that carry it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import DataError, printable
from vehest.sources.can import other_sources
from vehest.sources.can.database import message_of, read_dbc
from vehest.sources.can.logs import Frames, read_frames
from vehest.sources.clocks import clock_fault
from vehest.sources.surveys.log import Log, RawColumn

MIN_BITS = 6  # smallest length of a signal that may be a channel; one of a single bit may be a sign
Rows = NDArray[np.uint8]  # bytes of frames, one frame a row


def survey_frames(file: Path, dbc: Path) -> Log:
    """Every signal of a DBC that a log of a bus has; of several buses the one with most frames.

    Raises
    ------
    MissingError
        There is no such file, or a package that reads it is not installed.
    DataError
        The log or the DBC is damaged, or no message of the DBC occurs in the log.
    """
    described: dict[tuple[int, bool], Any] = {}
    for message in read_dbc(dbc):
        described.setdefault((message.frame_id, message.is_extended_frame), message)
    frames = read_frames(file, described)
    arrays = frames.arrays
    if not len(arrays["time"]):
        raise DataError(
            f"'{file}' has no frame of a message of '{dbc}'; name the DBC of this bus"
            + other_sources(read_frames(file), [*described.values()])
        )
    skipped = [frames.cut_end] if frames.cut_end else []
    options: dict[str, Any] = {"dbc": str(dbc)}
    counts = np.bincount(arrays["bus"])
    busiest = int(np.argmax(counts))
    if np.count_nonzero(counts) > 1:
        bus = frames.buses[busiest]
        options["bus"] = bus + 1 if isinstance(bus, int) else bus
        skipped.append(f"buses other than {options['bus']}, which has most frames of the DBC")
    columns: list[RawColumn] = []
    for key, message in described.items():
        stamps, rows = _rows_of(frames, key, busiest)
        if len(stamps) < 2:
            continue
        fault = clock_fault(stamps)
        if rows.shape[1] < message.length:
            fault = f"its frames have {rows.shape[1]} of {message.length} bytes"
        if fault:
            skipped.append(f"message '{printable(message.name)}': {fault}")
            continue
        columns += _columns_of(message, stamps, rows, dbc, skipped)
    return Log(file, "can", tuple(columns), options, skipped=tuple(skipped))


def _rows_of(frames: Frames, key: tuple[int, bool], bus: int) -> tuple[FloatArray, Rows]:
    """Stamps of a message's frames on a bus [s], (N,), and their bytes, (N, shortest length)."""
    arrays = frames.arrays
    lengths = arrays["length"].astype(np.int64)
    starts = np.cumsum(lengths) - lengths
    is_message = (
        (arrays["identifier"] == key[0]) & (arrays["extended"] == key[1]) & (arrays["bus"] == bus)
    )
    shortest = int(lengths[is_message].min(initial=64))
    places = starts[is_message][:, None] + np.arange(shortest)
    return arrays["time"][is_message], arrays["data"][places]


def _columns_of(
    message: Any, stamps: FloatArray, rows: Rows, dbc: Path, skipped: list[str]
) -> list[RawColumn]:
    """Columns of a message's signals that may be a channel or a sign; NaN where nothing was
    measured.
    """
    signals = {signal.name: signal for signal in message.signals}
    columns = []
    for name, signal in signals.items():
        if 1 < signal.length < MIN_BITS:
            continue
        try:
            described = message_of(message, [name], dbc)
        except DataError as error:
            skipped.append(str(error))
            continue
        carried = _carries(signal, signals, rows)
        raw = _raw_values(signal, rows[carried])
        values = float(signal.scale) * raw + float(signal.offset)
        lowest, highest = described.reserved(name)
        invalid = np.isin(values, list(described.not_measured(name)))
        values[invalid | ((values >= lowest) & (values <= highest))] = np.nan
        if np.isfinite(values).any() and np.count_nonzero(carried) > 1:
            place = {"column": f"{message.name}.{name}"}
            scaling = float(signal.scale), float(signal.offset)
            columns.append(
                RawColumn(
                    place["column"],
                    signal.unit or "",
                    values,
                    place,
                    stamps[carried],
                    scaling=scaling,
                )
            )
    return columns


def _carries(signal: Any, signals: Mapping[str, Any], rows: Rows) -> NDArray[np.bool_]:
    """Frames, (N,), whose multiplexers select a signal."""
    carried = np.ones(len(rows), np.bool_)
    while signal.multiplexer_ids is not None:  # `message_of` refuses a chain without an end
        above = signals[signal.multiplexer_signal]
        carried &= np.isin(_raw_values(above, rows), list(signal.multiplexer_ids))
        signal = above
    return carried


def _raw_values(signal: Any, rows: Rows) -> FloatArray:
    """Raw values of a signal, (N,), from frames of N rows of bytes."""
    if signal.byte_order == "little_endian":
        bits = np.unpackbits(rows, axis=1, bitorder="little")
        bits = bits[:, signal.start : signal.start + signal.length][:, ::-1]
    else:  # a DBC counts bits of a byte from its lowest one, and names the signal's highest one
        start = 8 * (signal.start // 8) + 7 - signal.start % 8
        bits = np.unpackbits(rows, axis=1)[:, start : start + signal.length]
    if signal.is_float:
        numbers = np.packbits(bits, axis=1).view(f">f{signal.length // 8}")
        return np.asarray(numbers[:, 0], np.float64)
    values = bits @ 2.0 ** np.arange(signal.length)[::-1]
    return values - bits[:, 0] * 2.0**signal.length if signal.is_signed else values
