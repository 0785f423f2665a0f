"""Tables of text as loggers write them: a row of units below the names, cells that are empty where a slow signal has no sample, marks for
such cells, and times that are written as a clock's.

All else is as in `vehest.sources.tabular`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError, printable
from vehest.data.parquet import DAMAGE
from vehest.data.text_files import first_line
from vehest.sources.clock_times import seconds_of_text
from vehest.sources.table_rows import kept_rows
from vehest.sources.tabular import TabularOptions, TabularSource
from vehest.sources.text_tables import check_size, table_stream

BLOCK = 1 << 22
CLOCK = "clock"
"""Unit of times that are written as a clock's."""
LONGEST_BRIDGE = 10.0  # s


@dataclass(frozen=True)
class TextLogOptions(TabularOptions):
    """Options of the source, by type; what is None is not said."""

    rows_below_names: int = 0
    bridge: float | None = None
    missing: tuple[str, ...] = ()


class TextLogSource(TabularSource):
    """Tables of text, a recording each.

    Options: those of ``tabular``, ``rows_below_names``, lines between the names and the numbers, ``bridge``, the longest time without a
    sample that a straight line bridges [s]; at either end the nearest sample stands for it; and ``missing``, marks of cells without a
    sample. The unit of ``time`` may be ``clock``: a time of day or a date with it.
    """

    options_type = TextLogOptions
    keys = TabularSource.keys | {"rows_below_names", "bridge", "missing"}

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        time = dataset.get("time")
        written = isinstance(time, Mapping) and time.get("unit") == CLOCK
        super().__init__({**dataset, "time": {**time, "unit": "s"}} if written and isinstance(time, Mapping) else dataset)
        self.dataset = dict(dataset)
        self.written_clock = self.time.column if written and self.time is not None else ""
        self.missing = [str(mark) for mark in dataset.get("missing") or ()]
        self.below = int(dataset.get("rows_below_names", TextLogOptions.rows_below_names))
        if not 0 <= self.below <= 100:
            raise ConfigurationError(f"data set '{self.name}': rows_below_names must be a number of lines up to 100, not {self.below}")
        self.bridge = dataset.get("bridge")
        if self.bridge is not None and not 0.0 < self.bridge <= LONGEST_BRIDGE:
            raise ConfigurationError(f"data set '{self.name}': bridge must be a time up to {LONGEST_BRIDGE:g} s, not {self.bridge}")

    def _values(self, file: Path, wanted: list[str]) -> dict[str, FloatArray]:
        """Columns of numbers, without the rows that the data set leaves out."""
        check_size(file, len(wanted))
        options = pc.ReadOptions(
            block_size=BLOCK,
            skip_rows=int(self.dataset.get("skip_rows", 0)),
            skip_rows_after_names=self.below,
            encoding=str(self.dataset.get("encoding", "utf8")),
        )
        kinds = pc.ConvertOptions(
            column_types={name: pa.string() if name == self.written_clock else pa.float64() for name in wanted},
            include_columns=wanted,
            decimal_point=str(self.dataset.get("decimal", ".")),
            null_values=[*pc.ConvertOptions().null_values, *self.missing],
        )
        try:
            with table_stream(file) as stream:
                table = pc.read_csv(stream, options, pc.ParseOptions(delimiter=str(self.dataset.get("delimiter", ","))), kinds)
        except DAMAGE as error:
            raise DataError(f"'{file}' cannot be read as a table of numbers ({printable(first_line(error))})") from None
        values = {name: self._numbers(table, name, file) for name in wanted}
        dropped = self.dropped.get(file.stem)
        if dropped is not None:
            kept = kept_rows(len(next(iter(values.values()))), dropped, file)
            values = {name: samples[kept] for name, samples in values.items()}
        return values if self.bridge is None else self._bridged(values, self.bridge)

    def _numbers(self, table: pa.Table, name: str, file: Path) -> FloatArray:
        column = table.column(name)
        if name != self.written_clock:
            return np.asarray(column.to_numpy(), dtype=np.float64)
        seconds = seconds_of_text(column)
        if seconds is None:
            raise DataError(f"'{file}': column '{name}' holds other text than times such as 10:59:30.25 or 2024-05-03T10:59:30.25")
        return seconds

    def _bridged(self, values: dict[str, FloatArray], longest: float) -> dict[str, FloatArray]:
        """Without gaps that are short enough."""
        clock = self.time.column if self.time is not None else None
        n_rows = len(next(iter(values.values())))
        if clock is not None and clock in values:
            assert self.time is not None
            times = self.time.to_si(values[clock], "s")
        else:
            times = np.arange(n_rows) / float(self.dataset.get("rate_hz") or 1.0)
        return {name: samples if name == clock else bridged(samples, times, longest) for name, samples in values.items()}


def bridged(samples: FloatArray, times: FloatArray, longest: float) -> FloatArray:
    """Samples with straight lines across gaps, (T,).

    Args:
        samples: NaN where there is none, (T,).
        times: of the samples [s], (T,); where they go backwards a run begins, which no line reaches across.
        longest: time between two samples that a line may bridge [s].
    """
    known = np.flatnonzero(np.isfinite(samples))
    if not 0 < len(known) < len(samples):
        return samples
    places = np.arange(len(samples))
    before = known[np.maximum(np.searchsorted(known, places, side="right") - 1, 0)]
    after = known[np.minimum(np.searchsorted(known, places, side="left"), len(known) - 1)]
    near = (np.abs(times[after] - times[before]) <= longest * (1.0 + 1e-9)) & (np.abs(times - times[before]) <= longest * (1.0 + 1e-9))
    return np.where(np.isfinite(samples) | near, np.interp(places, known, samples[known]), np.nan)


SOURCE = TextLogSource
