"""Revs Vehicle Dynamics Database (Kegelman & Gerdes, Stanford Digital Repository).

Layouts: ``text``, a folder a recording and a text file a channel, as re-laid by Leanza, Reina & Blanco-Claraco 2021.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vehest.data.channels import channel
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import FloatArray, Recording
from vehest.sources.base import Source, existing_folder, require_files
from vehest.sources.columns import columns_from_config, time_column_from_config, uniform_clock

LAYOUTS = ("text",)


class RevsSource(Source):
    """Recordings of the Revs database.

    Options: ``path`` (folder), ``layout``, ``recordings`` (folders in path), ``time`` and ``channels`` (columns, units, signs).
    """

    keys = frozenset({"path", "layout", "recordings", "time", "channels"})

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        super().__init__(dataset)
        if dataset.get("layout") not in LAYOUTS:
            raise ConfigurationError(f"data set '{self.name}': layout '{dataset.get('layout')}' is not one of: {', '.join(LAYOUTS)}")
        self.columns = columns_from_config(dataset.get("channels") or {}, self.name)
        self.time = time_column_from_config(dataset.get("time"), self.name)

    def ids(self) -> list[str]:
        """The recordings that the data set names."""
        return [str(name) for name in self.dataset.get("recordings") or []]

    def inputs(self) -> dict[str, str | Path]:
        """Every text file that is read."""
        return {f"{name}/{file.name}": file for name in self.ids() for file in self._files(name)}

    def read(self, recording_id: str) -> Recording:
        """Read the text files of one recording."""
        self._files(recording_id)
        stamps = self.time.to_si(_read_numbers(self._file(recording_id, self.time.column)), "s")
        clock = uniform_clock(stamps, f"'{self._file(recording_id, self.time.column)}'")
        channels = {}
        for name, column in self.columns.items():
            file = self._file(recording_id, column.column)
            samples = _read_numbers(file)
            if len(samples) != len(stamps):
                raise DataError(f"'{file}' holds {len(samples)} samples, the time file {len(stamps)}; the copy is incomplete")
            channels[name] = column.to_si(samples, channel(name).unit)
        return Recording(
            id=recording_id,
            vehicle=str(self.dataset.get("vehicle", "unknown")),
            rate_hz=clock.rate_hz,
            start_time=clock.start_time,
            channels=channels,
            kind="real",
            provenance={"dataset": self.name, "source": "revs", "layout": "text"},
        )

    def _file(self, recording_id: str, column: str) -> Path:
        return existing_folder(self.dataset.get("path"), self.name) / recording_id / f"{column}.txt"

    def _files(self, recording_id: str) -> list[Path]:
        folder = existing_folder(self.dataset.get("path"), self.name) / recording_id
        existing_folder(folder, self.name)
        files = [folder / f"{column}.txt" for column in sorted({self.time.column, *(c.column for c in self.columns.values())})]
        require_files(files, self.name)
        return files


def _read_numbers(file: Path) -> FloatArray:
    """One number a line."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that there are no numbers is said below
            values = np.loadtxt(file, dtype=np.float64, ndmin=1, encoding="utf-8-sig")
    except OSError as error:
        raise DataError(f"'{file}' cannot be read ({error.strerror or error}); check the disk and its permissions") from None
    except ValueError as error:
        raise DataError(
            f"'{file}' holds something that is not a number ({str(error).splitlines()[0]}); repair or remove the line"
        ) from None
    if values.size == 0:
        raise DataError(f"'{file}' holds no numbers; the copy is incomplete")
    if values.ndim != 1:
        raise DataError(f"'{file}' holds {values.shape[1]} numbers a line; one is expected")
    return values


SOURCE = RevsSource
