"""Which signals of a bus are the channels that a model reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from vehest.data.channels import CHANNELS, channel
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.units import factor_to_si
from vehest.sources.base import open_source
from vehest.sources.can import CanSource, Wanted, channel_values, channels_by_message
from vehest.sources.can.database import Database, read_database, read_dbc
from vehest.sources.columns import Column
from vehest.sources.unit_spellings import plain_unit, require_unit


@dataclass(frozen=True)
class BusSignals:
    """Signals of a bus as channels.

    Args:
        database: messages that carry them.
        wanted: channel -> its message and signal.
        factors: channel -> what a value in the unit of the DBC is multiplied with to be in SI units and ISO 8855 signs.
        bus: number or name of the bus, where a log holds several.
    """

    database: Database
    wanted: Mapping[str, Wanted]
    factors: Mapping[str, float]
    bus: int | str | None = None

    @property
    def messages(self) -> dict[str, list[str]]:
        """Message -> the channels that it carries."""
        return channels_by_message(self.wanted)

    def samples(self, values: Mapping[str, float], channels: list[str]) -> dict[str, float]:
        """Channel -> value [SI] of what a frame carries; NaN where it says that nothing was measured."""
        return {name: value * self.factors[name] for name, value in channel_values(values, channels, self.wanted).items()}


def from_dataset(dataset: Mapping[str, Any], needed: Sequence[str], optional: Sequence[str] = (), dbc: Path | None = None) -> BusSignals:
    """The signals that a data set of the source ``can`` declares.

    Args:
        dataset: its configuration.
        needed: channels that a model reads.
        optional: those of them that it can do without.
        dbc: in place of the data set's.

    Raises:
        ConfigurationError: the data set is of another source, or declares no such channel.
        MissingError: there is no DBC.
        DataError: it cannot be used, or lacks a signal.
    """
    name = dataset.get("name")
    if dataset.get("source") != "can":
        raise ConfigurationError(f"data set '{name}' is of source '{dataset.get('source')}'; a bus needs one of source 'can'")
    declared = dataset.get("channels") or {}
    _require_channels(needed, optional, declared, f"data set '{name}' declares none; channels that transforms make are not there online")
    kept = {channel: entry for channel, entry in declared.items() if channel in needed}
    told = {**dataset, "channels": kept, "gappy": None, "transforms": None, "reference_point": None, "raster": None}
    told["rate_hz"] = dataset.get("rate_hz") or 100.0
    told |= {} if dbc is None else {"dbc": str(dbc)}
    source = open_source({key: value for key, value in told.items() if value is not None})
    assert isinstance(source, CanSource)
    database, wanted = source.wanted()
    columns = {channel: source.channels[channel] for channel in wanted}
    if dataset.get("file_units", "check") != "ignore":
        _require_units(database, wanted, columns)
    return BusSignals(database, wanted, _factors(columns), dataset.get("bus"))


def from_names(dbc: Path, needed: Sequence[str], optional: Sequence[str] = (), told: Sequence[str] = ()) -> BusSignals:
    """Signals that are told, and those that are called like channels.

    Args:
        dbc: describes the bus; its units count.
        needed: channels that a model reads.
        optional: those of them that it can do without.
        told: ``ay=-IMU.AccLat:g``: a channel, the sign where it counts the other way than ISO 8855, the signal, the unit where the DBC's is
            not understood.

    Raises:
        ConfigurationError: a word that cannot be understood, a unit that is not known, or a channel without a signal.
        MissingError: there is no DBC.
        DataError: it cannot be used, or lacks a signal.
    """
    entries = dict(_told(word) for word in told)
    unknown = sorted(set(entries) - set(needed))
    if unknown:
        raise ConfigurationError(f"--signals names '{unknown[0]}', which the model does not read; it reads {', '.join(needed)}")
    named = {signal.name for message in read_dbc(dbc) for signal in message.signals}
    found = {name: entries.get(name, Column(name, "")) for name in needed if name in entries or name in named}
    _require_channels(needed, optional, found, f"no signal of '{dbc}' is called so; say which one it is: --signals CHANNEL=MESSAGE.SIGNAL")
    database = read_database(dbc, [column.column for column in found.values()])
    wanted, columns = {}, {}
    for name, column in found.items():
        message, signal = database.places[column.column]
        wanted[name] = Wanted(message, signal)
        columns[name] = column if column.unit else _with_unit(column, name, message.units[signal], dbc)
    _require_units(database, wanted, columns)
    return BusSignals(database, wanted, _factors(columns))


def _told(word: str) -> tuple[str, Column]:
    name, equals, rest = word.strip().partition("=")
    sign: Literal[1, -1] = -1 if rest.startswith("-") else 1
    signal, _, unit = rest.removeprefix("-").partition(":")
    if not equals or not signal:
        raise ConfigurationError(f"--signals takes CHANNEL=MESSAGE.SIGNAL, for example ay=-IMU.AccLat:m/s^2, not '{word}'")
    if name not in CHANNELS:
        raise ConfigurationError(f"--signals: '{name}' is no channel; docs/channels.md lists them")
    if unit and plain_unit(unit) in (None, "another unit"):
        raise ConfigurationError(f"--signals: '{unit}' is no unit of channel '{name}'; write for example {CHANNELS[name].unit}")
    return name, Column(signal, plain_unit(unit) or "" if unit else "", sign)


def _with_unit(column: Column, name: str, written: str, dbc: Path) -> Column:
    unit = plain_unit(written)
    try:
        factor_to_si(unit or "?", channel(name).unit)
    except DataError:
        what = f"'{dbc}' gives signal '{column.column}' the unit '{written}', which channel '{name}' cannot have"
        raise ConfigurationError(f"{what}; say it: --signals {name}={column.column}:{channel(name).unit}") from None
    return Column(column.column, str(unit), column.sign)


def _require_channels(needed: Sequence[str], optional: Sequence[str], there: Mapping[str, Any], fix: str) -> None:
    for name in needed:
        if name not in there and name not in optional:
            raise ConfigurationError(f"the model reads channel '{name}', and {fix}")


def _require_units(database: Database, wanted: Mapping[str, Wanted], columns: Mapping[str, Column]) -> None:
    for name, one in wanted.items():
        where = f"'{database.file}': signal '{one.signal}' for channel '{name}'"
        require_unit(one.message.units[one.signal], columns[name], channel(name).unit, where, "give the unit that is true")


def _factors(columns: Mapping[str, Column]) -> dict[str, float]:
    return {name: column.sign * column.factor * factor_to_si(column.unit, channel(name).unit) for name, column in columns.items()}
