"""Times of day in text, with or without a date."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from vehest.constants import FloatArray

DAY = 86_400.0  # s
HOUR = 3600.0  # s
WRITTEN = (
    r"^\s*(?:(?P<date>\d{4}-\d{2}-\d{2}|\d{1,2}\.\d{1,2}\.\d{4})[T ]+)?"
    r"(?P<hour>\d{1,2}):(?P<minute>\d{2}):(?P<second>\d{2}(?:[.,]\d+)?)\s*(?:Z|UTC|[+-]\d{2}:?\d{2})?\s*$"
)


def seconds_of_text(column: pa.ChunkedArray) -> FloatArray | None:
    """Times ``10:59:30.25``, ``2024-05-03T10:59:30.25Z`` or ``3.5.2024 10:59:30,25`` in seconds, (N,); None for other text.

    With a date they count from 1970, without one from midnight, and on beyond the next. The zone is not read.
    """
    from pyarrow import compute

    found = compute.extract_regex(column.combine_chunks(), pattern=WRITTEN)
    if not len(found) or found.null_count:
        return None
    seconds = compute.replace_substring(found.field("second"), ",", ".")
    hours, minutes, seconds = (
        compute.cast(part, pa.float64())
        for part in (found.field("hour"), found.field("minute"), seconds)
    )
    times = np.asarray(hours) * 3600.0 + np.asarray(minutes) * 60.0 + np.asarray(seconds)
    dates = found.field("date")
    if not compute.any(compute.not_equal(dates, "")).as_py():
        return past_midnight(times)
    padded = compute.replace_substring_regex(dates, r"\b(\d)\.", r"0\1.")
    try:
        days = (
            compute.replace_substring_regex(padded, r"^(\d+)\.(\d+)\.(\d+)$", r"\3-\2-\1")
            .cast(pa.date32())
            .cast(pa.int32())
        )
    except pa.ArrowInvalid:
        return None
    return np.asarray(times + DAY * np.asarray(days), dtype=np.float64)


def past_midnight(times: FloatArray) -> FloatArray:
    """Times since midnight that go on past the next [s], (N,), of times of day.

    Midnight is a step from the last hour of a day to the first of the next. Any other step back, such as that after a stray 23:59:59,
    stays a step back.
    """
    is_midnight = (times[:-1] > DAY - HOUR) & (times[1:] < HOUR)
    return np.asarray(
        times + DAY * np.concatenate([[0.0], np.cumsum(is_midnight)]), dtype=np.float64
    )
