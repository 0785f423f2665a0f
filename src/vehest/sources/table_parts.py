"""Large tables in parts, so that hours need little memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import repeat, takewhile
from pathlib import Path

from vehest.constants import FloatArray
from vehest.data.limits import check_limit
from vehest.data.parquet import ROWS_AT_A_TIME
from vehest.data.recording import part_slices
from vehest.sources.clocks import Clock, even_clock
from vehest.sources.table_rows import TimeColumn
from vehest.sources.tables import TextLayout, column_parts, is_parquet, is_text

LARGE = 1 << 25  # smallest size of a table of text that is read in parts [bytes]


def is_large(file: Path) -> bool:
    """Whether a table is Parquet, or of so much text that it is worth reading it in parts."""
    return is_parquet(file) or (is_text(file) and file.stat().st_size >= LARGE)


def even_parts(
    file: Path, time: TimeColumn, selected: Sequence[str], layout: TextLayout
) -> Iterator[tuple[dict[str, FloatArray], Clock, list[int]]]:
    """Columns of a table in parts, if its clock is even as a block-wise reading can tell.

    Parameters
    ----------
    file : Path
        Table of text, perhaps packed, or Parquet.
    time : TimeColumn
        Its column of times, which neither wraps nor needs sorting.
    selected : sequence of str
        Columns that are read.
    layout : TextLayout
        Layout of a table of text.

    Yields
    ------
    values : dict
        Column -> float64, shape (T,).
    clock : Clock
        Of the part.
    part : list of int
        Number of the part, from 1, and of all parts. There is none where the clock is uneven.

    Raises
    ------
    MissingError, DataError
        As `column_parts` does; the table has more rows than the limits allow.
    """
    blocks = column_parts(file, [time.column], layout, repeat(ROWS_AT_A_TIME))
    clock = even_clock(
        time.to_si(block[time.column], "s")
        for block in takewhile(lambda block: len(block[time.column]), blocks)
    )
    if clock is None:
        return
    check_limit("samples", clock.n_samples, f"'{file}' has {clock.n_samples} rows")
    slices = part_slices(clock.n_samples, clock.rate_hz)
    lengths = (rows.stop - rows.start for rows in slices)
    parts = column_parts(file, selected, layout, lengths)
    for number, (rows, values) in enumerate(zip(slices, parts, strict=True), 1):
        yield values, clock.part(rows), [number, len(slices)]
