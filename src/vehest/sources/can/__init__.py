"""Logs of a CAN bus: frames decoded by a DBC, signals of different rates brought to one clock.

Which signal is which channel, and in which unit and sign, is declared in conf/dataset, as is the DBC; one that says otherwise is refused.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from vehest.alignment.checks import checks_of_clock
from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.limits import check_limit
from vehest.data.text_files import first_line
from vehest.sources.base import matching_files, require_files
from vehest.sources.can.database import Database, Message, read_database
from vehest.sources.can.logs import frames_of
from vehest.sources.signals import Signal, SignalOptions, SignalSource

FEWEST = 2


@dataclass(frozen=True)
class CanOptions(SignalOptions):
    """Options of the source, by type; what is None is not said."""

    files: str = "*.asc"
    dbc: str | None = None
    bus: Annotated[int | str | None, "number or name of a bus, as the log counts them"] = None


@dataclass(frozen=True)
class Wanted:
    """The signal that becomes a channel.

    Args:
        message: that carries it.
        signal: its name.
        invalid: values that mean that nothing was measured, in the unit of the DBC.
    """

    message: Message
    signal: str
    invalid: frozenset[float] = frozenset()


class CanSource(SignalSource):
    """Logs, a recording each; their frames are decoded by the data set's ``dbc``, those of one ``bus`` where a log holds several."""

    options_type = CanOptions
    keys = SignalSource.keys | {"dbc", "bus"}
    pattern = "*.asc"
    own_keys = frozenset({"invalid"})

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        super().__init__(dataset)
        if not dataset.get("dbc"):
            raise ConfigurationError(f"{self.where}: dbc must name the DBC file that describes the bus, for example dbc: ${{root}}/car.dbc")
        self.dbc = Path(str(dataset["dbc"])).expanduser()
        self.invalid = {name: self._invalid(name, dataset["channels"][name].get("invalid")) for name in self.channels}

    def inputs(self) -> dict[str, str | Path]:
        """The logs and the DBC.

        Raises:
            MissingError: one of them is not there.
        """
        require_files([self.dbc], self.name)
        return {**{file.name: file for file in matching_files(self.dataset, self.pattern)}, self.dbc.name: self.dbc}

    def wanted(self) -> tuple[Database, dict[str, Wanted]]:
        """The DBC, and the signal of each channel.

        Raises:
            MissingError: there is no DBC, or a package is not installed.
            DataError: it cannot be used, or lacks a signal.
        """
        require_files([self.dbc], self.name)
        database = read_database(self.dbc, [declared.column.column for declared in self.channels.values()])
        found = {}
        for name, declared in self.channels.items():
            message, signal = database.places[declared.column.column]
            found[name] = Wanted(message, signal, frozenset(message.physical(signal, raw) for raw in self.invalid[name]))
        return database, found

    def _read_signals(self, file: Path) -> tuple[dict[str, Signal], dict[str, Any]]:
        database, wanted = self.wanted()
        series = read_series(file, database, wanted, self.dataset.get("bus"))
        signals = {}
        for name, (stamps, values) in series.items():
            message = wanted[name].message
            where = f"'{file}': message '{message.name}', which carries '{wanted[name].signal}',"
            for finding in checks_of_clock(stamps):
                if finding.check == "clock":
                    raise DataError(f"{where}: {finding.message}; where two buses carry it, say which by bus: …")
            signals[name] = Signal(f"message '{message.name}'", stamps, values, message.units[wanted[name].signal])
        rates = {signal.origin.removeprefix("message ").strip("'"): round(signal.rate_hz, 3) for signal in signals.values()}
        return signals, {"dbc": self.dbc.name, "messages": rates}

    def _invalid(self, channel: str, entry: Any) -> tuple[int, ...]:
        values = entry if isinstance(entry, list | tuple) else [] if entry is None else [entry]
        if any(isinstance(value, bool) or not isinstance(value, int) for value in values) or len(values) > 100:
            raise ConfigurationError(
                f"{self.where}: channel '{channel}': invalid must list raw values that mean 'not measured', not {entry}"
            )
        return tuple(values)


def decoded(
    file: Path, database: Database, wanted: Mapping[str, Wanted], bus: int | str | None = None
) -> Iterator[tuple[Any, dict[str, float]]]:
    """Frames of a log that carry anything that is wanted, each with its values, channel -> value in the unit of the DBC; NaN: invalid.

    Raises:
        MissingError: there is no such file, or a package is not installed.
        DataError: it is damaged or more than the limits, or a frame is shorter than the DBC says.
    """
    channels_of = channels_by_message(wanted)
    for frame in frames_of(file):
        message = database.messages.get((frame.arbitration_id, frame.is_extended_id))
        if message is None or not is_on(frame, bus):
            continue
        try:
            values = message.decode(frame.data)
        except DataError as error:
            raise DataError(f"'{file}', at {frame.timestamp:.6f} s: {error}; is the file truncated, or the DBC another car's?") from None
        yield frame, channel_values(values, channels_of[message.name], wanted)


def channels_by_message(wanted: Mapping[str, Wanted]) -> dict[str, list[str]]:
    """Message -> the channels that its signals become."""
    found: dict[str, list[str]] = {}
    for name, one in wanted.items():
        found.setdefault(one.message.name, []).append(name)
    return found


def channel_values(values: Mapping[str, float], channels: list[str], wanted: Mapping[str, Wanted]) -> dict[str, float]:
    """Values of the channels that a frame carries; NaN where it says that nothing was measured."""
    found = {}
    for name in channels:
        one = wanted[name]
        if one.signal in values:
            value = values[one.signal]
            found[name] = float("nan") if value in one.invalid else value
    return found


def is_on(frame: Any, bus: int | str | None) -> bool:
    """Whether a frame was on a bus, by its name or its number, which logs count from 1 and python-can from 0."""
    return bus is None or frame.channel == (bus - 1 if isinstance(bus, int) and not isinstance(bus, bool) else bus)


def read_series(
    file: Path, database: Database, wanted: Mapping[str, Wanted], bus: int | str | None = None
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Stamps [s] and values of each channel, in the unit of the DBC.

    Raises:
        MissingError: there is no such file, or a package is not installed.
        DataError: the log cannot be used, or a signal never occurs.
    """
    stamps = {name: array("d") for name in wanted}
    values = {name: array("d") for name in wanted}
    count = 0
    try:
        for frame, found in decoded(file, database, wanted, bus):
            for name, value in found.items():
                stamps[name].append(frame.timestamp)
                values[name].append(value)
            count += len(found)
            check_limit("memory", 8 * count, f"'{file}' holds {count} values or more")
    except MemoryError as error:
        raise DataError(f"'{file}' asks for more memory than there is ({first_line(error)}); read fewer signals of it") from None
    for name, one in wanted.items():
        if len(stamps[name]) < FEWEST:
            raise DataError(never_occurs(file, name, one, len(stamps[name]), bus))
    return {name: (np.array(stamps[name]), np.array(values[name])) for name in wanted}


def never_occurs(file: Path, channel: str, wanted: Wanted, count: int, bus: int | str | None) -> str:
    """What is said of a signal that a log does not hold."""
    message = wanted.message
    often = "occurs once only" if count else "never occurs"
    on = "" if bus is None else f" on bus {bus}"
    kind = "extended identifier" if message.extended else "identifier"
    return (
        f"'{file}': signal '{wanted.signal}' for channel '{channel}' {often}{on}: message '{message.name}' carries it, with the {kind} "
        f"{message.frame_id:#x}; leave the channel out, or correct dbc, bus or the map of channels"
    )


SOURCE = CanSource
