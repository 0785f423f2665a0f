"""What recordings and estimates share: one uniform clock, and how a notebook shows them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import abbreviated

if TYPE_CHECKING:
    import pandas as pd

MAX_REPR_CHANNELS = 4  # names in a `repr`, which is to fit on a line


class TimeSeries(ABC):
    """Channels of T samples each; sample k holds for ``start_time + k / rate_hz``."""

    rate_hz: float  # sampling rate [Hz]
    start_time: float  # time of the first sample [s]
    channels: Mapping[str, FloatArray]  # name -> samples, (T,)

    @property
    @abstractmethod
    def label(self) -> str:
        """Text that identifies the series in messages."""

    @property
    @abstractmethod
    def units(self) -> dict[str, str]:
        """Channel -> SI unit."""

    def __len__(self) -> int:
        return len(next(iter(self.channels.values())))

    @property
    def time(self) -> FloatArray:
        """Sample times [s], shape (T,)."""
        return self.start_time + np.arange(len(self)) / self.rate_hz

    @property
    def duration(self) -> float:
        """Time from the first sample to the end of the last sampling interval [s]."""
        return len(self) / self.rate_hz

    @property
    def end_time(self) -> float:
        """End of the last sampling interval [s]."""
        return self.start_time + self.duration

    def _describe(self) -> str:
        """Class, label, duration and rate, for ``repr``."""
        return f"{type(self).__name__} {self.label}: {self.duration:.5g} s at {self.rate_hz:.6g} Hz"

    def __repr__(self) -> str:
        names = list(self.channels)
        return f"<{self._describe()}; {abbreviated(names, MAX_REPR_CHANNELS)}>"

    def _repr_html_(self) -> str:
        """Table of the channels for a notebook: unit, range, missing samples."""
        rows = []
        for name, values in self.channels.items():
            finite = values[np.isfinite(values)]
            limits = (f"{finite.min():.4g}", f"{finite.max():.4g}") if finite.size else ("–", "–")
            cells = (escape(name), self.units[name], *limits, str(values.size - finite.size))
            rows.append("".join(f"<td>{cell}</td>" for cell in cells))
        header = "".join(f"<th>{name}</th>" for name in ("channel", "unit", "min", "max", "NaN"))
        body = "".join(f"<tr>{row}</tr>" for row in (header, *rows))
        return f"<p>{escape(self._describe())}</p><table>{body}</table>"

    def _table(self) -> dict[str, FloatArray]:
        """Columns of the table of all samples, ``time`` first, shape (T,) each."""
        return {"time": self.time, **self.channels}

    def _table_units(self) -> dict[str, str]:
        """Column of the table -> its unit."""
        return {"time": "s", **self.units}

    def to_pandas(self) -> pd.DataFrame:
        """The samples as a table on an index ``time`` [s].

        Of a recording the channels in SI units; of an estimate the columns that `vehest estimate`
        writes: its quantities in SI units, entries of the covariance, if there is one, and the
        sideslip angle and its band also in degrees.

        Returns
        -------
        DataFrame
            ``attrs["units"]`` maps each column, and ``time``, to its unit.
        """
        import pandas as pd

        columns = self._table()
        units = self._table_units()
        frame = pd.DataFrame(columns).set_index("time")
        frame.attrs["units"] = {name: units[name] for name in columns}
        return frame
