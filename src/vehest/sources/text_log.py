"""Tables of text with a row of units below the names, as many loggers write them; all else as in `vehest.sources.tabular`."""

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
from vehest.sources.table_rows import kept_rows
from vehest.sources.tabular import TabularOptions, TabularSource
from vehest.sources.text_tables import check_size, table_stream

BLOCK = 1 << 22


@dataclass(frozen=True)
class TextLogOptions(TabularOptions):
    """Options of the source, by type; what is None is not said."""

    rows_below_names: int = 1


class TextLogSource(TabularSource):
    """Tables of text, a recording each.

    Options: those of ``tabular``, and ``rows_below_names``, lines between the names and the numbers.
    """

    options_type = TextLogOptions
    keys = TabularSource.keys | {"rows_below_names"}

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        super().__init__(dataset)
        self.below = int(dataset.get("rows_below_names", TextLogOptions.rows_below_names))
        if not 0 <= self.below <= 100:
            raise ConfigurationError(f"data set '{self.name}': rows_below_names must be a number of lines up to 100, not {self.below}")

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
            column_types=dict.fromkeys(wanted, pa.float64()), include_columns=wanted, decimal_point=str(self.dataset.get("decimal", "."))
        )
        try:
            with table_stream(file) as stream:
                table = pc.read_csv(stream, options, pc.ParseOptions(delimiter=str(self.dataset.get("delimiter", ","))), kinds)
        except DAMAGE as error:
            raise DataError(f"'{file}' cannot be read as a table of numbers ({printable(first_line(error))})") from None
        values = {name: np.asarray(table.column(name).to_numpy(), dtype=np.float64) for name in wanted}
        dropped = self.dropped.get(file.stem)
        if dropped is None:
            return values
        kept = kept_rows(len(next(iter(values.values()))), dropped, file)
        return {name: samples[kept] for name, samples in values.items()}


SOURCE = TextLogSource
