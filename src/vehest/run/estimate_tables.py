"""Reads estimates of v or β from tables of any tool, and from those of `vehest estimate`.

table, columns that the user names -> column, unit and sign -> clock, shifted -> `Estimate`
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from vehest.alignment.checks import checks_of_recording, merged_findings
from vehest.data.derived import STANDSTILL_SPEED
from vehest.data.errors import ConfigurationError, DataError, counted, listed, printable, suggestion
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.store import is_stored_estimate, read_estimate
from vehest.data.units import factor_to_si
from vehest.run.printing import complain, note
from vehest.run.reference_checks import CHECKS_OF_SIGNS_AND_UNITS
from vehest.run.time_shift import Series, estimate_shift
from vehest.sources.base import read_single
from vehest.sources.named_columns import NamedColumn, written_unit
from vehest.sources.surveys.tables import shape_of, unit_in_name
from vehest.sources.tables import TextLayout, column_names, is_parquet, is_text
from vehest.sources.unit_spellings import plain_unit

CHANNELS_OF_QUANTITIES = {"time": "time", "vy": "vy_ref", "sideslip": "sideslip_ref"}
"""Quantity that ``--column`` names -> ``time``, or the channel as which its column is read."""
SPELLINGS = {
    "time": ("time", "t", "timestamp", "zeit"),
    "vy_ref": ("vy", "v", "vlat", "lateralvelocity", "vyest", "vyhat", "vehestvy"),
    "sideslip_ref": (
        "sideslip",
        "beta",
        "β",
        "slip",
        "slipangle",
        "sideslipangle",
        "betaest",
        "betahat",
        "vehestsideslip",
    ),
}
"""``time``, or channel as which a column is read -> accepted names of the column, without spaces,
underscores, case and units.
"""
OF_VEHEST = frozenset({"band_vy", "band_sideslip", "health_reason"})
"""Columns that only estimates of vehest have, by which these are recognised."""
# ``time``, or channel -> unit where neither the column's name nor the user states one
DEFAULT_UNITS = {"time": "s", "vy_ref": "m/s", "sideslip_ref": "rad"}
# unit of time in a column's name -> as vehest spells it
TIME_UNITS = {"s": "s", "sec": "s", "ms": "ms", "us": "us", "µs": "us", "ns": "ns"}
AUTO = "auto"  # value of ``--shift`` for a shift by correlation


def parse_columns(words: Sequence[str]) -> list[NamedColumn]:
    """Parse the ``QUANTITY=COLUMN`` words of ``--column``.

    Parameters
    ----------
    words : sequence of str
        Such as ``sideslip=Beta:deg`` or ``vy=-V``, where ``:UNIT`` and the sign are optional.

    Raises
    ------
    ConfigurationError
        An unknown quantity or no column.
    """
    columns = []
    for word in words:
        quantity, _, text = word.partition("=")
        if quantity not in CHANNELS_OF_QUANTITIES:
            meant = suggestion(quantity, CHANNELS_OF_QUANTITIES) or ";"
            raise ConfigurationError(
                f"--column {printable(word)}: '{printable(quantity)}' is no quantity of an "
                f"estimate{meant} there are {listed(list(CHANNELS_OF_QUANTITIES))}, as in --column "
                "sideslip=Beta:deg"
            )
        if not text.strip("-"):
            raise ConfigurationError(f"--column {printable(word)} names no column")
        columns.append(NamedColumn(CHANNELS_OF_QUANTITIES[quantity], text))
    return columns


def parse_shift(text: str) -> float | None:
    """Parse ``--shift``: seconds, or None for ``auto``.

    Parameters
    ----------
    text : str
        A number, or ``auto``.

    Raises
    ------
    ConfigurationError
        Anything else.
    """
    if text == AUTO:
        return None
    with suppress(ValueError):
        if math.isfinite(seconds := float(text)):
            return seconds
    raise ConfigurationError(
        f"--shift must be a number of seconds or auto, not '{printable(text)}'"
    )


def read_estimate_table(
    file: Path,
    drive: Recording,
    columns: Sequence[NamedColumn] = (),
    shift: float | None = 0.0,
) -> Estimate:
    """Read v or β from a table of any tool, or of ``vehest estimate``.

    Columns are found by name, whatever their case; a unit in brackets or at the end of a name
    counts, else v is in m/s and β in rad. Where only β is there, v = u tan β with the recording's
    u, and 0 at standstill. Prints a warning where unit or sign contradict the recording.

    Parameters
    ----------
    file : Path
        CSV, Parquet or MAT-file. An estimate of ``vehest estimate`` in Parquet is read as it is.
    drive : Recording
        That was estimated.
    columns : sequence of NamedColumn
        Take precedence over columns that are found by name; those that the table lacks are ignored.
    shift : float or None
        Seconds that are added to the times; None: by correlation with the reference.

    Returns
    -------
    Estimate
        ``vy`` [m/s] and ``sideslip`` [rad] on an even clock, shifted to that of the recording.

    Raises
    ------
    DataError
        No time or neither v nor β, an unknown unit, or an ambiguous shift.
    """
    if file.suffix == ".parquet" and is_stored_estimate(file):
        return read_estimate(file)
    layout = _layout(file)
    names = column_names(file, layout)
    if is_parquet(file) and OF_VEHEST.intersection(names):
        complain(
            f"warning: '{file}' has columns of 'vehest estimate' "
            f"({counted(sorted(OF_VEHEST.intersection(names)))}), but not its "
            "description: another program has written it anew; it is read like another tool's table"
        )
    declared = _columns_of(file, names, columns)
    time = declared.pop("time", None)
    channel = next((name for name in ("vy_ref", "sideslip_ref") if name in declared), None)
    if time is None or channel is None:
        raise DataError(_missing_columns(file, names, time is None))
    options = {
        "name": file.stem,
        "source": "text_log" if layout.rows_below_names else "tabular",
        "vehicle": "unknown",
        "clock": "interpolate",
        "gappy": [channel],
        "time": {key: time[key] for key in ("column", "unit")},
        "channels": {channel: declared[channel]},
    }
    plain = asdict(TextLayout())
    options |= {name: value for name, value in asdict(layout).items() if value != plain[name]}
    table = read_single(options, file)
    table = replace(table, start_time=table.start_time + _seconds(file, table, drive, shift))
    _warn_of_estimate(file, str(declared[channel]["column"]), table, drive)
    vx = np.interp(table.time, drive.time, drive["vx"])
    vy = table[channel]
    if channel == "sideslip_ref":
        # at standstill the angle is noise, of which a tangent can make any velocity
        vy = vx * np.tan(np.where(np.abs(vx) < STANDSTILL_SPEED, 0.0, table[channel]))
    return Estimate(
        drive.id,
        file.stem,
        table.rate_hz,
        table.start_time,
        {"vy": vy, "sideslip": np.arctan2(vy, vx)},
    )


def names_of_table(file: Path) -> list[str]:
    """Names of a table's columns, in their order.

    Raises
    ------
    DataError
        It cannot be read.
    """
    return column_names(file, _layout(file))


def _layout(file: Path) -> TextLayout:
    """Delimiter, decimal mark, encoding and lines beside the rows of a table of text."""
    return shape_of(file).layout if is_text(file) else TextLayout()


def _columns_of(
    file: Path, names: Sequence[str], columns: Sequence[NamedColumn]
) -> dict[str, dict[str, str | int]]:
    """Entries for time and channels of a table, each with column, unit and sign, as a data set
    declares them.
    """
    declared: dict[str, dict[str, str | int]] = {}
    for named in columns:
        place = named.find(names)
        if place is not None:
            name, stated, sign = place
            unit = unit_of(named.channel, name, file, stated)
            declared[named.channel] = {"column": name, "unit": unit, "sign": sign}
    is_chosen = not {"vy_ref", "sideslip_ref"}.isdisjoint(declared)
    for quantity, accepted in SPELLINGS.items():
        for name in names if quantity == "time" or not is_chosen else ():
            if quantity not in declared and _plain_names(name) & set(accepted):
                declared[quantity] = {"column": name, "unit": unit_of(quantity, name, file)}
    return declared


def _plain_names(name: str) -> set[str]:
    """A column's name without case, blanks, underscores and brackets, both with and without the
    unit that it ends in.
    """
    bare = re.sub(r"[\[(].*?[\])]", "", name).strip()
    forms = {bare, re.sub(r"[_\s]+[^_\s]+$", "", bare) if unit_in_name(bare) else bare}
    if bare.lower().rpartition("_")[2] in TIME_UNITS:
        forms.add(bare.rpartition("_")[0])
    return {re.sub(r"[\s_]", "", form).lower() for form in forms}


def _missing_columns(file: Path, names: Sequence[str], is_time: bool) -> str:
    """Message on what a table lacks, on the accepted names, and on how to name a column."""
    if is_time:
        lacks = f"no column time [s] (accepted names: {', '.join(SPELLINGS['time'])}"
        remedy = "--column time=NAME"
    else:
        accepted = ", ".join((*SPELLINGS["vy_ref"], *SPELLINGS["sideslip_ref"]))
        lacks = f"no column vy [m/s] or sideslip [rad] (accepted names: {accepted}"
        remedy = "--column sideslip=NAME:deg"
    return f"'{file}' has {lacks}; it has {printable(counted(names))}); name it, as in {remedy}"


def unit_of(quantity: str, name: str, file: Path, stated: str = "") -> str:
    """Unit of a column: the stated one, that in the column's name, or the default.

    Parameters
    ----------
    quantity : str
        ``time``, ``vy_ref`` or ``sideslip_ref``.
    name : str
        Of the column, as the file has it.
    file : Path
        Named in errors.
    stated : str
        Unit that the user gave; it takes precedence.

    Returns
    -------
    str
        As vehest spells it.

    Raises
    ------
    DataError
        An unknown one.
    """
    text = stated or written_unit(name)
    if quantity == "time" and not text and (last := name.lower().rpartition("_")[2]) in TIME_UNITS:
        text = last if "_" in name else ""
    if not text:
        return DEFAULT_UNITS[quantity]
    unit = TIME_UNITS.get(text) if quantity == "time" else plain_unit(text)
    if unit is None:
        accepted = ", ".join(TIME_UNITS) if quantity == "time" else "m/s, km/h, rad, deg and others"
        raise DataError(
            f"'{file}': column '{printable(name)}' has the unknown unit '{printable(text)}' (known "
            f"are {accepted}); convert it, or rename the column"
        )
    try:
        factor_to_si(unit, DEFAULT_UNITS[quantity])
    except DataError:
        raise DataError(
            f"'{file}': column '{printable(name)}' is in '{printable(text)}', which is no unit of "
            f"{quantity.removesuffix('_ref')}; name its unit, as in --column sideslip=NAME:deg"
        ) from None
    return unit


def _seconds(file: Path, table: Recording, drive: Recording, shift: float | None) -> float:
    """Seconds to add to the times of a table; an estimated shift is printed."""
    if shift is not None:
        return shift
    (channel,) = table.channels
    reference = drive["vy_ref"]
    if channel == "sideslip_ref":
        reference = np.arctan2(reference, drive["vx"])
    try:
        estimated = estimate_shift(
            Series(table.time, table[channel]), Series(drive.time, reference)
        )
    except DataError as error:
        raise DataError(f"'{file}': {error}") from None
    note(
        f"'{file}': shifted by {estimated.seconds:.3f} s, where it correlates best with the "
        "reference "
        f"({estimated.correlation:.3f}); this compensates for a delay of the estimate as well"
    )
    return estimated.seconds


def _warn_of_estimate(file: Path, column: str, table: Recording, drive: Recording) -> None:
    """Print a warning where an estimate has another unit or sign than its column says, by the
    channels of the recording.
    """
    (channel,) = table.channels
    measured = drive.without_references()
    values = np.interp(measured.time, table.time, table[channel], left=np.nan, right=np.nan)
    together = replace(
        measured,
        channels={**measured.channels, channel: values},
        gappy=measured.gappy | {channel},
    )
    for finding in merged_findings([checks_of_recording(table), checks_of_recording(together)]):
        concerns = finding.channel == channel or (
            not finding.channel and channel in finding.message
        )
        if concerns and finding.check in CHECKS_OF_SIGNS_AND_UNITS:
            complain(
                f"warning: '{file}': column '{printable(column)}', read as {channel}: "
                f"{finding.message}"
            )
