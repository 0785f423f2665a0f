"""Raw values out of records: whole numbers of any number of bits, and real numbers."""

from __future__ import annotations

import numpy as np

from vehest.constants import FloatArray
from vehest.sources.mdf.data_blocks import Bytes
from vehest.sources.mdf.layout import Field


def is_number(field: Field) -> bool:
    """Whether a field is coded in a way that `raw_values` knows."""
    if field.kind == "real":
        return field.bit == 0 and field.bits in (16, 32, 64)
    return field.kind == "number" or (1 <= field.bits <= 64 and field.bit < 8 and field.bit + field.bits <= 64)


def raw_values(records: Bytes, field: Field, first: int) -> FloatArray:
    """Raw values of a channel.

    Args:
        records: shape (N, bytes of a record).
        field: where it stands.
        first: number of the first record.

    Returns:
        shape (N,).
    """
    if field.kind == "number":
        return first + np.arange(len(records), dtype=np.float64)
    length = (field.bit + field.bits + 7) // 8
    cut = records[:, field.byte : field.byte + length]
    order = ">" if field.big_endian else "<"
    if field.kind == "real":
        return np.ascontiguousarray(cut).view(f"{order}f{length}")[:, 0].astype(np.float64)
    width = next(size for size in (1, 2, 4, 8) if size >= length)
    padded = np.zeros((len(records), width), np.uint8)
    padded[:, width - length if field.big_endian else 0 : width if field.big_endian else length] = cut
    numbers = padded.view(f"{order}u{width}")[:, 0].astype(np.uint64) >> np.uint64(field.bit)
    unused = np.uint64(64 - field.bits)
    numbers = numbers << unused
    return (numbers.view(np.int64) >> unused.astype(np.int64) if field.kind == "signed" else numbers >> unused).astype(np.float64)


def invalid_samples(records: Bytes, field: Field, record_bytes: int) -> np.ndarray:
    """Which samples are marked as invalid, shape (N,)."""
    if field.all_invalid:
        return np.ones(len(records), dtype=bool)
    if field.invalid_bit is None:
        return np.zeros(len(records), dtype=bool)
    return (records[:, record_bytes + field.invalid_bit // 8] >> (field.invalid_bit % 8) & 1).astype(bool)
