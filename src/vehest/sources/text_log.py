"""Source of tables of text as loggers write them: a row of units, empty cells of slow signals,
marks of missing samples, clock times.

Otherwise as `vehest.sources.tabular`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from vehest.constants import FloatArray
from vehest.sources.clocks import bridged
from vehest.sources.tabular import TabularOptions, TabularSource

CLOCK = "clock"  # unit of times that are written as a clock's
LONGEST_BRIDGE = 10.0  # s, largest value of ``bridge``


@dataclass(frozen=True)
class TextLogOptions(TabularOptions):
    """Options of the source; docs/sources/text_log.md describes them."""

    # number of lines between the names and the rows
    rows_below_names: Annotated[int, Field(ge=0, le=100)] = 0
    # longest gap that is filled by a straight line [s]
    bridge: Annotated[float, Field(gt=0, le=LONGEST_BRIDGE)] | None = None
    missing: tuple[str, ...] | None = None  # cells that mark a missing sample


class TextLogSource(TabularSource):
    """Tables of text, a recording each."""

    options_type = TextLogOptions
    version = "2"

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        time = dataset.get("time")
        clock = None
        if isinstance(time, Mapping) and time.get("unit") == CLOCK:
            dataset = {**dataset, "time": {**time, "unit": "s"}}
            clock = str(time.get("column"))
        super().__init__(dataset)
        below = self.options.rows_below_names
        missing = self.options.missing or ()
        self.layout = replace(self.layout, rows_below_names=below, missing=missing, clock=clock)

    def column_values(self, file: Path, selected: list[str]) -> dict[str, FloatArray]:
        """Columns without the rows that the data set leaves out, and with lines across gaps of at
        most ``bridge`` [s].

        Gaps are counted by the column of times or, without one, by ``rate_hz``.
        """
        values = super().column_values(file, selected)
        longest = self.options.bridge
        if longest is None:
            return values
        clock = self.time.column if self.time is not None else None
        if self.time is not None and clock in values:
            times = self.time.to_si(values[clock], "s")
        else:
            times = np.arange(len(next(iter(values.values())))) / (self.options.rate_hz or 1.0)
        return {
            name: samples if name == clock else bridged(samples, times, longest)
            for name, samples in values.items()
        }


SOURCE = TextLogSource
