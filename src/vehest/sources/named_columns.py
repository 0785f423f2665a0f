"""Columns that a user names in a word: ``-AccY:m/s²``; and those of a DataFrame as a recording."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS, channel
from vehest.data.errors import ConfigurationError, DataError, printable, suggestion
from vehest.data.recording import Recording
from vehest.sources.base import open_source
from vehest.sources.surveys.tables import unit_in_name
from vehest.sources.tables import listed
from vehest.sources.tabular import TabularSource
from vehest.sources.unit_spellings import plain_unit

if TYPE_CHECKING:
    import pandas as pd

TIME = "time"  # name of the column of times among channels


@dataclass(frozen=True)
class NamedColumn:
    """A column that the user names: ``sideslip=-Beta_CarMaker:deg``."""

    channel: str  # ``time``, or the channel that it is read as
    text: str  # a sign, the name and a unit, as they were given

    def find(self, names: Sequence[str]) -> tuple[str, str, int] | None:
        """The column in a table.

        A name that is in the table as it was given is taken so, even if it begins with a minus sign
        or has a colon in it.

        Parameters
        ----------
        names : sequence of str
            Columns of the table.

        Returns
        -------
        tuple or None
            Name, unit (empty if none is stated) and sign, 1 or -1; None if the table lacks it.
        """
        for sign, text in ((1, self.text), (-1, self.text.removeprefix("-"))):
            if text in names:
                return text, "", sign
            name, _, unit = text.rpartition(":")
            if name in names:
                return name, unit, sign
        return None


def written_unit(name: str) -> str:
    """The unit that a column's name contains, as it is written there; empty where there is none."""
    bracketed = re.search(r"[\[(](.*?)[\])]", name)
    return bracketed[1] if bracketed else unit_in_name(name)


def declare_columns(
    columns: Mapping[str, str], names: Sequence[str], units: Mapping[str, str], where: str
) -> dict[str, Any]:
    """Options ``time`` and ``channels`` of a data set whose columns a user names.

    Parameters
    ----------
    columns : mapping
        Channel, or ``time``, -> its column, with a sign before and a unit behind, as in
        ``-AccY:m/s²``. A unit may be in the column's name or in ``units``; a column that is called
        like its channel is in SI units.
    names : sequence of str
        Columns of the table.
    units : mapping
        Column -> unit, of those for which it is known.
    where : str
        Table, for messages.

    Raises
    ------
    ConfigurationError
        There is no such channel or column, or its unit is not known.
    """
    declared: dict[str, dict[str, Any]] = {}
    for name, text in columns.items():
        key = f"columns={{'{printable(name)}': '{printable(text)}'}}"
        if name != TIME and name not in CHANNELS:
            meant = suggestion(name, [TIME, *CHANNELS]) or "; 'vehest data channels' lists them"
            raise ConfigurationError(f"{where}: {key}: there is no channel '{name}'{meant}")
        place = NamedColumn(name, text).find(names)
        if place is None:
            meant = suggestion(text.lstrip("-").rpartition(":")[0] or text, names) or ";"
            raise ConfigurationError(
                f"{where}: {key}: there is no such column{meant} it has {listed(names)}"
            )
        column, stated, sign = place
        si_unit = "s" if name == TIME else channel(name).unit
        unit = (
            stated
            or units.get(column)
            or written_unit(column)
            or (si_unit if name in (column, TIME) else "")
        )
        if not unit:
            raise ConfigurationError(
                f"{where}: {key}: the unit of column '{printable(column)}' is not known; "
                f"write '{printable(column)}:{si_unit}', or whatever it is"
            )
        plain = unit if name == TIME else plain_unit(unit) or unit
        declared[name] = {"column": column, "unit": plain, "sign": sign}
    time = declared.pop(TIME, None)
    return ({"time": time} if time else {}) | ({"channels": declared} if declared else {})


def read_frame(
    frame: pd.DataFrame, dataset: Mapping[str, Any], columns: Mapping[str, str]
) -> Recording:
    """A recording of a DataFrame, as a table of text with its columns would be.

    Parameters
    ----------
    frame : DataFrame
        A column a channel; times in a column, or as index: seconds, time stamps or time
        differences. ``frame.attrs["units"]`` may have the columns' units, ``frame.attrs["name"]``
        its name.
    dataset : mapping
        Data set that describes the columns, of source ``tabular``.
    columns : mapping
        As of `declare_columns`; they take precedence over those of the data set.

    Raises
    ------
    ConfigurationError
        As `declare_columns`.
    DataError
        There is no time, a column holds no numbers, or the recording cannot be used.
    """
    if TIME not in columns and TIME not in frame.columns and frame.index.dtype.kind in "fMm":
        frame = frame.rename_axis(index=TIME)
    if frame.index.name is not None:
        frame = frame.reset_index()
    names = [str(name) for name in frame.columns]
    declared = declare_columns(columns, names, frame.attrs.get("units", {}), "DataFrame")
    source = open_source({**dataset, **declared})
    if not isinstance(source, TabularSource):
        raise ConfigurationError(f"DataFrame: {source.location} describes no table")
    if not source.columns_of(names):
        raise DataError(
            f"DataFrame: no column is named like a channel (it has {listed(names)}); "
            "name them, as in columns={'vx': 'Speed:km/h', 'ay': '-AccY:m/s²'}"
        )
    columns_read = source.columns_read(names)
    for name in columns_read:
        if names.count(name) != 1:
            raise DataError(
                f"DataFrame has {names.count(name) or 'no'} columns '{printable(name)}' (it has "
                f"{listed(names)}); rename all but one, or name another, as in "
                "columns={'time': 'Timestamp:s'}"
            )
    table = {name: _numbers(frame.iloc[:, names.index(name)]) for name in columns_read}
    return source.recording_of(table, str(frame.attrs.get("name", "frame")))


def _numbers(column: pd.Series) -> FloatArray:
    """Values of a column, of time stamps and differences in seconds; `DataError` for text."""
    if column.dtype.kind in "mM":
        return column.to_numpy().astype(f"{column.dtype.kind}8[ns]").astype(np.int64) / 1e9
    try:
        return column.to_numpy(np.float64, na_value=np.nan)
    except (TypeError, ValueError):
        raise DataError(
            f"DataFrame: column '{printable(str(column.name))}' contains text; numbers are needed"
        ) from None
