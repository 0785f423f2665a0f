"""Which signals of a bus are the channels that a model reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vehest.data.channels import CHANNELS
from vehest.data.errors import ConfigurationError
from vehest.data.units import factor_to_si
from vehest.sources.base import open_source
from vehest.sources.can import CanSource, ChannelSignal
from vehest.sources.can.database import Database, read_dbc
from vehest.sources.unit_spellings import plain_unit, require_unit

# options of a data set that concern recordings only, not a bus
FOR_RECORDINGS = (
    "gappy",
    "transforms",
    "reference_point",
    "raster",
)


@dataclass(frozen=True)
class BusSignals:
    """Signals of a bus that carry the channels of a model, and how their values become channels."""

    database: Database  # messages that carry them
    by_channel: Mapping[str, ChannelSignal]  # channel -> its message and signal
    # channel -> factor from the unit of the DBC to SI units and ISO 8855 signs
    factors: Mapping[str, float]
    bus: int | str | None = None  # number or name of the bus, where a log holds several


def from_dataset(
    dataset: Mapping[str, Any],
    required: Sequence[str],
    optional: Sequence[str] = (),
    dbc: Path | None = None,
) -> BusSignals:
    """Signals that a data set of the source ``can`` declares for the channels of a model.

    Parameters
    ----------
    dataset : mapping
        Configuration of the data set.
    required : sequence of str
        Channels that the model reads.
    optional : sequence of str
        Those of them that may be missing.
    dbc : Path or None
        Takes the place of the data set's.

    Returns
    -------
    BusSignals
        Factors contain sign, factor and unit of each channel's declaration; offsets are the DBC's.

    Raises
    ------
    ConfigurationError
        The data set is of another source, or declares no such channel.
    MissingError
        There is no DBC.
    DataError
        The DBC cannot be used, lacks a signal, or contradicts a declared unit.
    """
    location = f"data set '{dataset.get('name')}'"
    declared = dataset.get("channels") or {}
    if dataset.get("source") != "can":
        raise ConfigurationError(
            f"{location} is of source '{dataset.get('source')}'; a bus needs one of source 'can'"
        )
    _require_channels(
        required,
        optional,
        declared,
        f"{location} declares none; channels that transforms make are not there online",
    )
    options = {
        name: value
        for name, value in dataset.items()
        if value is not None and name not in FOR_RECORDINGS
    }
    options |= {
        "channels": {name: declared[name] for name in declared if name in required},
        "rate_hz": 100.0,
    }
    source = open_source(options if dbc is None else {**options, "dbc": str(dbc)})
    assert isinstance(source, CanSource)
    database, by_channel = source.signals_of_channels()
    factors = {}
    for name, signal in by_channel.items():
        column = source.channels[name]
        unit = CHANNELS[name].unit
        if dataset.get("file_units") != "ignore":
            location = f"'{database.file}': signal '{signal.signal}' for channel '{name}'"
            require_unit(
                signal.message.units[signal.signal],
                column,
                unit,
                location,
                "give the unit that is true",
            )
        factors[name] = column.sign * column.factor * factor_to_si(column.unit, unit)
    return BusSignals(database, by_channel, factors, dataset.get("bus"))


def from_names(
    dbc: Path, required: Sequence[str], optional: Sequence[str] = (), words: Sequence[str] = ()
) -> BusSignals:
    """Signals that words name, and those that are called like channels, in the units of the DBC.

    Parameters
    ----------
    dbc : Path
        Describes the bus.
    required, optional : sequence of str
        Channels that the model reads, and those of them that may be missing.
    words : sequence of str
        Such as ``ay=-IMU.AccLat:g``: sign, message, signal and unit.

    Raises
    ------
    ConfigurationError
        A word cannot be understood, a unit is not known, or a channel has no signal.
    MissingError
        There is no DBC.
    DataError
        The DBC cannot be used, or lacks a signal.
    """
    entries = dict(map(_entry, words))
    if unknown := sorted(set(entries) - set(required)):
        raise ConfigurationError(
            f"--signals names '{unknown[0]}', which the model does not read; it reads "
            f"{', '.join(required)}"
        )
    units = {}
    for message in read_dbc(dbc):
        for signal in message.signals:
            units[signal.name] = units[f"{message.name}.{signal.name}"] = signal.unit or ""
    entries |= {
        name: {"column": name} for name in required if name in units and name not in entries
    }
    _require_channels(
        required,
        optional,
        entries,
        f"no signal of '{dbc}' is called so; name one: --signals CHANNEL=MESSAGE.SIGNAL",
    )
    for name, entry in entries.items():
        column = entry["column"]
        si_unit = CHANNELS[name].unit
        written = entry.get("unit") or units.get(column, si_unit)
        entry["unit"] = plain_unit(written)
        if entry["unit"] in (None, "another unit"):
            raise ConfigurationError(
                f"'{written}' of signal '{column}' is no unit of '{name}'; write --signals "
                f"{name}={column}:{si_unit}"
            )
    return from_dataset(
        {"name": "signals", "source": "can", "dbc": str(dbc), "channels": entries},
        required,
        optional,
    )


def _entry(word: str) -> tuple[str, dict[str, Any]]:
    """Channel and declaration of ``CHANNEL=MESSAGE.SIGNAL``, with a minus before the signal and
    ``:UNIT`` behind it if need be.
    """
    name, _, target = word.strip().partition("=")
    signal, _, unit = target.removeprefix("-").partition(":")
    if not signal:
        raise ConfigurationError(
            "--signals takes CHANNEL=MESSAGE.SIGNAL, for example ay=-IMU.AccLat:m/s^2, not "
            f"'{word}'"
        )
    return name, {"column": signal, "unit": unit, "sign": -1 if target.startswith("-") else 1}


def _require_channels(
    required: Sequence[str], optional: Sequence[str], available: Mapping[str, Any], fix: str
) -> None:
    """Refuse, by a `ConfigurationError`, a channel that is neither available nor optional."""
    for name in required:
        if name not in available and name not in optional:
            raise ConfigurationError(f"the model reads channel '{name}', and {fix}")
