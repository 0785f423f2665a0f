"""Times of day in text, with or without a date."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from vehest.constants import FloatArray

DAY = 86_400.0  # s
HOUR = 3600.0  # s
MAX_STEP = 20.0 * DAY  # s, beyond which day and month were mistaken for one another
WRITTEN = (
    r"^\s*(?:(?P<date>\d{4}[-/.]?\d{1,2}[-/.]?\d{1,2}|\d{1,2}[-/. ]\w{1,3}[-/. ]\d{2,4})[T _]+"
    r"|(?P<days>\d+) days?,? *)?"
    r"(?:(?P<hour>\d{1,2}):?(?P<minute>\d{2}):?(?P<second>\d{2}(?:[.,:]\d+)?)"
    r"|(?P<minutes>\d{1,3}):(?P<seconds>\d{2}[.,]\d+))"
    r"\s*(?P<half>[AaPp])?(?:\.?[Mm]\.?)?\s*(?:Z|UTC|[+-]\d{2}:?\d{2})?\s*$"
)
DATE = r"^(?P<first>\d{4}|\d{1,2})[-/. ]?(?P<second>\d{1,2})[-/. ]?(?P<third>\d+)$"
MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")


def seconds_of_text(column: pa.ChunkedArray) -> FloatArray | None:
    """Times that are written as a clock's, in seconds, (N,); None for other text.

    ``10:59:30.25``, ``59:30.25``, ``10:59:30:250``, ``105930.25``, ``2024-05-03T10:59:30.25Z``,
    ``20240503T105930``, ``3.5.2024 10:59:30,25``, ``03-May-2024 10:59:30``, ``5/3/24 10:59:30 AM``
    and ``0 days 00:00:30.25``. With a date they count from 1970, without one from midnight, and on
    beyond the next. The zone is not read.
    """
    from pyarrow import compute

    matched = compute.extract_regex(column.combine_chunks(), pattern=WRITTEN)
    if not len(matched) or matched.null_count:
        return None
    is_short = compute.not_equal(matched.field("minutes"), "")
    second = compute.if_else(is_short, matched.field("seconds"), matched.field("second"))
    hours, minutes, seconds = (
        np.asarray(compute.cast(part, pa.float64()))
        for part in (
            compute.if_else(is_short, "0", matched.field("hour")),
            compute.if_else(is_short, matched.field("minutes"), matched.field("minute")),
            compute.replace_substring_regex(second, "[,:]", "."),
        )
    )
    half = compute.utf8_lower(matched.field("half"))
    is_afternoon = np.asarray(compute.cast(compute.equal(half, "p"), pa.int8()))
    is_halved = np.asarray(compute.cast(compute.not_equal(half, ""), pa.int8()))
    hours = np.where(is_halved, hours % 12.0, hours) + 12.0 * is_afternoon
    times = hours * HOUR + minutes * 60.0 + seconds
    dates = matched.field("date")
    if compute.all(compute.equal(dates, "")).as_py():
        days = compute.if_else(compute.equal(matched.field("days"), ""), "0", matched.field("days"))
        counted = np.asarray(compute.cast(days, pa.float64()))
        return past_midnight(times) if not counted.any() else times + DAY * counted
    dates = compute.utf8_lower(dates)
    for number, name in enumerate(MONTHS, 1):
        dates = compute.replace_substring(dates, name, str(number))
    parts = compute.extract_regex(dates, pattern=DATE)
    if parts.null_count:
        return None
    first, second, third = (
        np.asarray(compute.cast(parts.field(name), pa.int64()))
        for name in ("first", "second", "third")
    )
    year = np.where(third < 100, third + 2000, third)
    orders = [(year, first, second), (year, second, first)]  # of the United States, of Europe
    if first.min() > 31:
        orders = [(first, second, third)]
    elif not is_halved.any():
        orders.reverse()
    for is_last, (year, month, day) in zip((len(orders) == 1, True), orders, strict=False):
        if month.min() >= 1 and month.max() <= 12 and day.min() >= 1 and day.max() <= 31:
            dated = np.asarray(times + DAY * _days(year, month, day), dtype=np.float64)
            if is_last or np.abs(np.diff(dated)).max(initial=0.0) < MAX_STEP:
                return dated
    return None


def _days(
    year: NDArray[np.int64], month: NDArray[np.int64], day: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Days since 1970 of dates, (N,)."""
    months = (12 * (year - 1970) + month - 1).astype("datetime64[M]")
    return np.asarray((months.astype("datetime64[D]")).astype(np.int64) + day - 1)


def past_midnight(times: FloatArray) -> FloatArray:
    """Times since midnight that go on past the next [s], (N,), of times of day.

    Midnight is a step from the last hour of a day to the first of the next. Any other step back,
    such as that after a stray 23:59:59, stays a step back.
    """
    is_midnight = (times[:-1] > DAY - HOUR) & (times[1:] < HOUR)
    return np.asarray(
        times + DAY * np.concatenate([[0.0], np.cumsum(is_midnight)]), dtype=np.float64
    )
