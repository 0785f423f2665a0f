"""From a file's columns to channels: units and signs, declared in conf/dataset.

mapping from conf/dataset -> `Column`, checked -> samples in the file's unit -> samples in the
channel's SI unit, signs by ISO 8855
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from vehest.constants import FloatArray
from vehest.data.channels import channel
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import HIGHEST_RATE
from vehest.data.schema import validated
from vehest.data.units import factor_to_si

# channel -> its declaration in conf/dataset
ChannelMap = Annotated[dict[str, Any], "a mapping from a channel to its column and unit"]
ChannelNames = Annotated[tuple[str, ...], "a list of channels"]  # names of channels
# name of a column; YAML reads 3 as a number
ColumnName = Annotated[str, BeforeValidator(lambda name: str(name) if type(name) is int else name)]
Positive = Annotated[float, Field(gt=0)]  # number above 0
Rate = Annotated[float, Field(gt=0, le=HIGHEST_RATE)]  # sampling rate [Hz]
RunNumber = Annotated[int, Field(ge=0)]  # number of a run


@dataclass(frozen=True)
class Column:
    """Declaration of a column that becomes a channel."""

    column: ColumnName  # name of the column in the file
    unit: str  # unit of its values in the file
    sign: Literal[1, -1] = 1  # 1, or -1 where the file counts the other way round than ISO 8855
    # factor that brings the file's values to ``unit``, such as 1 / wheel radius
    factor: Annotated[float, "a number other than 0"] = 1.0

    def to_si(self, values: FloatArray, si_unit: str) -> FloatArray:
        """Values in SI units and ISO 8855 signs.

        Parameters
        ----------
        values : FloatArray
            Samples as the file has them, any shape.
        si_unit : str
            The channel's unit.

        Returns
        -------
        FloatArray
            ``values`` times sign, factor and conversion; ``values`` itself, not a copy, where these
            multiply to 1.
        """
        factor = self.sign * self.factor * factor_to_si(self.unit, si_unit)
        return values if factor == 1.0 else values * factor


@dataclass(frozen=True)
class SampledColumn(Column):
    """Declaration of a column in which some numbers mean that nothing was measured, or of which
    another one holds the sign.
    """

    # numbers, in the file's unit, that mean that nothing was measured
    invalid: Annotated[tuple[float, ...], "a list of numbers, in the file's unit"] = ()
    sign_column: ColumnName | None = None  # 0 where values are positive, 1 where negative

    @property
    def column_names(self) -> list[str]:
        """The columns of the file that it needs."""
        return [self.column] if self.sign_column is None else [self.column, self.sign_column]

    def measured(self, file: Path, columns: Mapping[str, FloatArray]) -> FloatArray:
        """Values in the file's unit, NaN where nothing was measured.

        Parameters
        ----------
        file : Path
            For errors.
        columns : mapping
            Each of `column_names` -> samples in the file's unit, shape (T,); those within 1e-6,
            relatively, of a number of ``invalid`` were not measured.

        Raises
        ------
        DataError
            The column of the sign has a value besides 0, 1 and NaN.
        """
        values = columns[self.column]
        is_code = [np.isclose(values, code, rtol=1e-6, atol=0.0) for code in self.invalid]
        values = np.where(np.any(is_code, axis=0), np.nan, values) if is_code else values
        if self.sign_column is None:
            return values
        signs = columns[self.sign_column]
        others = signs[~np.isin(signs, (0.0, 1.0)) & ~np.isnan(signs)]
        if len(others):
            raise DataError(
                f"'{file}': column '{self.sign_column}', the sign of '{self.column}', holds "
                f"{others[0]:g}; 0 (positive) and 1 (negative) can be read: write the signed value "
                "to one column"
            )
        return signed(values, signs)


def signed(magnitudes: FloatArray, signs: FloatArray) -> FloatArray:
    """Magnitudes (T,), negative where their sign (T,) is 1, NaN where that is missing."""
    return magnitudes * (1.0 - 2.0 * signs)


def measured_columns(
    file: Path, columns: Mapping[str, Column], values: Mapping[str, FloatArray]
) -> dict[str, FloatArray]:
    """Columns of a table, NaN where a channel's declaration says that nothing was measured.

    Parameters
    ----------
    file : Path
        For errors.
    columns : mapping
        Channel -> its declaration; only those of `SampledColumn` count.
    values : mapping
        Name of a column -> samples in the file's unit, shape (T,); left unchanged.
    """
    measured = {**values}
    for column in columns.values():
        if isinstance(column, SampledColumn) and values.keys() >= {*column.column_names}:
            measured[column.column] = column.measured(file, values)
    return measured


def names_read(columns: Mapping[str, Column]) -> list[str]:
    """Columns of a table that channels need, each once."""
    names = [
        column.column_names if isinstance(column, SampledColumn) else [column.column]
        for column in columns.values()
    ]
    return list(dict.fromkeys(chain.from_iterable(names)))


def columns_from_config(
    entries: Mapping[str, Any], dataset: str, kind: type[Column] = Column
) -> dict[str, Column]:
    """A data set's declarations of channels.

    Parameters
    ----------
    entries : mapping
        Channel -> its entry in conf/dataset.
    dataset : str
        Name of the data set, for messages.
    kind : type
        Class of the declarations, whose fields are the keys of an entry.

    Returns
    -------
    dict
        Channel -> its declaration, in the order of ``entries``.

    Raises
    ------
    ConfigurationError
        A channel, unit or key is unknown, or a unit is of another quantity than the channel.
    """
    columns = {}
    for name, entry in entries.items():
        location = f"data set '{dataset}': channel '{name}'"
        try:
            columns[str(name)] = column_from_config(entry, location, channel(str(name)).unit, kind)
        except DataError as error:
            raise ConfigurationError(f"{location}: {error}") from None
    return columns


def column_from_config(
    entry: Any, location: str, si_unit: str, kind: type[Column] = Column
) -> Column:
    """A declaration whose unit is convertible.

    Parameters
    ----------
    entry : mapping
        The declaration in conf/dataset.
    location : str
        Data set and channel, for messages.
    si_unit : str
        Unit to which the declared one must be convertible.
    kind : type
        Class of the declaration.

    Raises
    ------
    ConfigurationError
        A key is unknown or missing, a value is of the wrong type, the factor is 0, or the unit is
        unknown or of another quantity.
    """
    column = validated(kind, entry, location, error=ConfigurationError)
    if column.factor == 0:
        raise ConfigurationError(f"{location}: factor must be a number other than 0")
    try:
        factor_to_si(column.unit, si_unit)
    except DataError as error:
        raise ConfigurationError(f"{location}: {error}") from None
    return column
