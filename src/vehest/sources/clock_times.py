"""Times of day in text, with or without a date."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.compute as compute

from vehest.constants import FloatArray

DAY = 86_400.0  # s
WRITTEN = (
    r"^\s*(?:(?P<date>\d{4}-\d{2}-\d{2}|\d{1,2}\.\d{1,2}\.\d{4})[T ]+)?"
    r"(?P<hour>\d{1,2}):(?P<minute>\d{2}):(?P<second>\d{2}(?:[.,]\d+)?)\s*(?:Z|UTC|[+-]\d{2}:?\d{2})?\s*$"
)


def seconds_of_text(column: pa.ChunkedArray) -> FloatArray | None:
    """Times ``10:59:30.25``, ``2024-05-03T10:59:30.25Z`` or ``3.5.2024 10:59:30,25`` in seconds, (N,); None for other text.

    With a date they count from 1970, without one from midnight, and on beyond the next. The zone is not read.

    Args:
        column: strings, (N,).
    """
    text = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    found = compute.extract_regex(text, pattern=WRITTEN)
    if not len(found) or found.null_count:
        return None
    seconds = compute.cast(compute.replace_substring(found.field("second"), ",", "."), pa.float64())
    hours, minutes = (compute.cast(found.field(part), pa.float64()) for part in ("hour", "minute"))
    times = np.asarray(hours) * 3600.0 + np.asarray(minutes) * 60.0 + np.asarray(seconds)
    dates = found.field("date").to_pylist() if compute.any(compute.not_equal(found.field("date"), "")).as_py() else []
    if dates:
        days = _days(dates)
        return None if days is None else times + DAY * days
    return past_midnight(times)


def past_midnight(times: FloatArray) -> FloatArray:
    """Times since midnight that go on past the next [s], (N,), of times of day."""
    return np.asarray(times + DAY * np.concatenate([[0.0], np.cumsum(np.diff(times) < -0.5 * DAY)]), dtype=np.float64)


def _days(dates: list[str]) -> FloatArray | None:
    """Days since 1970, (N,); None where one is no date."""
    known: dict[str, float] = {}
    for date in set(dates):
        parts = date.split(".")
        plain = date if len(parts) != 3 else f"{int(parts[2]):04d}-{int(parts[1]):02d}-{int(parts[0]):02d}"
        try:
            known[date] = float(np.datetime64(plain, "D").astype(np.int64))
        except ValueError:
            return None
    return np.array([known[date] for date in dates])
