"""Times of day in text, with or without a date, and durations.

text -> parts, by `CLOCK` or `DURATION` -> order of day and month, where there is a date -> seconds
"""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from vehest.constants import FloatArray

DAY = 86_400.0  # s
HOUR = 3600.0  # s
MAX_STEP = 20.0 * DAY  # s, largest step; with a larger one day and month were interchanged
# matches a time of day, with or without a date
CLOCK = (
    r"^\s*(?:(?P<date>\d{4}[-/.]?\d{1,2}[-/.]?\d{1,2}|\d{1,2}[-/. ]\w{1,3}[-/. ]\d{2,4})[T _]+"
    r"|(?P<days>\d+) days?,? *|(?:\d{4}[-:/ ])?(?P<day_of_year>\d{3})[-:/T ])?"
    r"(?:(?P<hour>\d{1,2}):?(?P<minute>\d{2}):?(?P<second>\d{2}(?:[.,:]\d*)?)"
    r"|(?P<minutes>\d{1,3}):(?P<seconds>\d{2}[.,]\d+))"
    r"\s*(?P<half>[AaPp])?(?:\.?[Mm]\.?)?\s*(?:Z|UTC|[+-]\d{2}:?\d{2})?\s*$"
)
# matches a duration
DURATION = (
    r"(?i)^(?P<date>)(?P<day_of_year>)(?P<half>)(?P<minutes>)(?P<seconds>)\s*"
    r"(?:P(?:(?P<days>\d+)D)?T(?:(?P<hour>\d+)H)?(?:(?P<minute>\d+)M)?)?"
    r"(?:(?P<second>\d+(?:[.,]\d+)?)\s*s(?:ec)?)?\s*$"
)
# matches date and time in digits alone, to the microsecond
DIGITS = r"^\s*(\d{8})(\d{6})(\d{0,6})\s*$"
# matches the three parts of a date
DATE = r"^(?P<first>\d{4}|\d{1,2})[-/. ]?(?P<second>\d{1,2})[-/. ]?(?P<third>\d+)$"
# first letters of the months, in order
MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")


def seconds_of_text(column: pa.ChunkedArray) -> FloatArray | None:
    """Times that are written as a clock's, in seconds.

    ``10:59:30.25``, ``59:30.25``, ``10:59:30:250``, ``105930.25``, ``2024-05-03T10:59:30.25Z``,
    ``20240503T105930``, ``20240503105930250``, ``2024-124-10:59:30.25``, ``124:10:59:30``,
    ``3.5.2024 10:59:30,25``, ``03-May-2024 10:59:30``, ``5/3/24 10:59:30 AM`` and
    ``0 days 00:00:30.25``, or as a duration, ``PT1M30.25S`` or ``90.25 s``. The zone is not
    read. Where the year does not come first, the day does as in Europe, or the month as in the
    United States where AM or PM is written; the other order holds if this one makes impossible
    dates or a step of `MAX_STEP` or more.

    Parameters
    ----------
    column : pyarrow.ChunkedArray
        Texts, shape (N,), all of them times of a clock or all durations.

    Returns
    -------
    FloatArray or None
        Times, shape (N,) [s]: with a date since 1970, without one since midnight, and on beyond the
        next. None where one is missing, or any is other text.
    """
    from pyarrow import compute

    texts = compute.replace_substring_regex(column.combine_chunks(), DIGITS, r"\1T\2.\3")
    for pattern in (CLOCK, DURATION):
        parts = compute.extract_regex(texts, pattern=pattern)
        if len(parts) and not parts.null_count:
            break
    else:
        return None

    def number(name: str) -> FloatArray:
        plain = compute.replace_substring_regex(parts.field(name), "[,:]", ".")
        filled = compute.replace_substring_regex(plain, "^$", "0")
        return np.asarray(compute.cast(filled, pa.float64()))

    half = np.asarray(compute.utf8_lower(parts.field("half")))
    hours = np.where(half == "", number("hour"), number("hour") % 12.0) + 12.0 * (half == "p")
    minutes = number("minute") + number("minutes")
    times = hours * HOUR + minutes * 60.0 + number("second") + number("seconds")
    dates = compute.utf8_lower(parts.field("date"))
    if compute.all(compute.equal(dates, "")).as_py():
        days = number("days") + number("day_of_year")
        return times + DAY * days if days.any() else past_midnight(times)
    for month_number, name in enumerate(MONTHS, 1):
        dates = compute.replace_substring(dates, name, str(month_number))
    dates = compute.extract_regex(dates, pattern=DATE)
    if dates.null_count:
        return None
    first, second, third = (
        np.asarray(compute.cast(field, pa.int64())) for field in dates.flatten()
    )
    year = np.where(third < 100, third + 2000, third)
    orders = [(year, first, second), (year, second, first)]  # of the United States, of Europe
    if first.min() > 31:
        orders = [(first, second, third)]
    elif not (half != "").any():
        orders.reverse()
    for order in orders:
        years, months, days = order
        if months.min() >= 1 and months.max() <= 12 and days.min() >= 1 and days.max() <= 31:
            first_days = (12 * (years - 1970) + months - 1).astype("datetime64[M]")
            since_1970 = first_days.astype("datetime64[D]").astype(np.int64) + days - 1
            dated = times + DAY * since_1970
            if order is orders[-1] or np.abs(np.diff(dated)).max(initial=0.0) < MAX_STEP:
                return dated
    return None


def past_midnight(times: FloatArray) -> FloatArray:
    """Times since midnight that go on past the next, of times of day.

    Midnight is a step from the last hour of a day to the first of the next. Any other step back,
    such as that after a stray 23:59:59, stays a step back.

    Parameters
    ----------
    times : FloatArray
        Times of day, shape (N,) [s], from 0 to 86 400.

    Returns
    -------
    FloatArray
        The same times with a day added for each midnight before them, shape (N,) [s].
    """
    is_midnight = (times[:-1] > DAY - HOUR) & (times[1:] < HOUR)
    return times + DAY * np.concatenate([[0.0], np.cumsum(is_midnight)])
