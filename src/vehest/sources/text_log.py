"""Source of tables of text as loggers write them: a row of units, empty cells of slow signals, marks of missing samples, clock times.

Otherwise as `vehest.sources.tabular`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError
from vehest.sources.columns import Column
from vehest.sources.tables import TextLayout
from vehest.sources.tabular import TabularOptions, TabularSource

CLOCK = "clock"
"""Unit of times that are written as a clock's."""
LONGEST_BRIDGE = 10.0  # s


@dataclass(frozen=True)
class TextLogOptions(TabularOptions):
    """Options of the source; docs/sources/text_log.md describes them."""

    rows_below_names: int = 0
    bridge: float | None = None
    missing: tuple[str, ...] | None = None


class TextLogSource(TabularSource):
    """Tables of text, a recording each."""

    options_type = TextLogOptions

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        super().__init__(dataset)
        bridge = self.options.bridge
        if bridge is not None and not 0.0 < bridge <= LONGEST_BRIDGE:
            raise ConfigurationError(f"{self.where}: bridge must be a time up to {LONGEST_BRIDGE:g} s, not {bridge}")

    def _time_column(self, entry: Any) -> Column:
        if isinstance(entry, Mapping) and entry.get("unit") == CLOCK:
            column = super()._time_column({**entry, "unit": "s"})
            self.written_clock = column.column
            return column
        return super()._time_column(entry)

    def _layout(self) -> TextLayout:
        below = self.options.rows_below_names
        if not 0 <= below <= 100:
            raise ConfigurationError(f"{self.where}: rows_below_names must be a number of lines up to 100, not {below}")
        return replace(super()._layout(), rows_below_names=below, missing=self.options.missing or ())

    def _values(self, file: Path, wanted: list[str]) -> dict[str, FloatArray]:
        """Columns without the rows that the data set leaves out, and without gaps that are short enough."""
        values, longest = super()._values(file, wanted), self.options.bridge
        if longest is None:
            return values
        clock = self.time.column if self.time is not None else None
        if self.time is not None and self.time.column in values:
            times = self.time.to_si(values[self.time.column], "s")
        else:
            times = np.arange(len(next(iter(values.values())))) / float(self.options.rate_hz or 1.0)
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
