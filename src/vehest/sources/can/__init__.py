"""Logs of a CAN bus: frames decoded by a DBC, signals of different rates brought to one clock.

Which signal is which channel, and in which unit and sign, is declared in conf/dataset, as is the DBC; one that says otherwise is refused.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from vehest.data.errors import ConfigurationError, DataError
from vehest.sources.base import require_files
from vehest.sources.can.database import Database, Message, read_database
from vehest.sources.can.logs import Frames, read_frames
from vehest.sources.clocks import require_clock
from vehest.sources.signals import Signal, SignalChannel, SignalOptions, SignalSource


@dataclass(frozen=True)
class CanOptions(SignalOptions):
    """Options of the source, by type; None leaves an option open."""

    files: str = "*.asc"
    dbc: str | None = None
    bus: Annotated[int | str | None, "number or name of a bus, as the log counts them"] = None


@dataclass(frozen=True)
class CanChannel(SignalChannel):
    """A channel's signal, with raw values that mean that nothing was measured."""

    invalid: Annotated[int | tuple[int, ...], "raw values that mean 'not measured'"] = ()


@dataclass(frozen=True)
class Wanted:
    """The signal that becomes a channel."""

    message: Message  # that carries it
    signal: str
    invalid: frozenset[float] = (
        frozenset()
    )  # values that mean that nothing was measured, in the unit of the DBC
    reserved: tuple[float, float] = (math.nan, math.nan)  # range of further ones, likewise

    def is_measured(self, value: float) -> bool:
        """Whether a value, in the unit of the DBC, is a measurement."""
        return value not in self.invalid and not self.reserved[0] <= value <= self.reserved[1]


class CanSource(SignalSource):
    """Logs, a recording each; their frames are decoded by the data set's ``dbc``, those of one ``bus`` where a log holds several."""

    options_type = CanOptions
    options: CanOptions
    channel_type = CanChannel

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        super().__init__(dataset)
        if not self.options.dbc:
            raise ConfigurationError(
                f"{self.where}: dbc must name the DBC file that describes the bus, for example dbc: ${{root}}/car.dbc"
            )
        self.dbc = Path(self.options.dbc).expanduser()

    def inputs(self) -> dict[str, str | Path]:
        """The logs and the DBC; raises `MissingError` where one of them is not there."""
        require_files([self.dbc], self.name)
        return {**super().inputs(), self.dbc.name: self.dbc}

    def wanted(self) -> tuple[Database, dict[str, Wanted]]:
        """The DBC, and the signal of each channel; raises `MissingError` without DBC or package, `DataError` where a signal is missing."""
        require_files([self.dbc], self.name)
        database = read_database(self.dbc, [declared.column for declared in self.channels.values()])
        found = {}
        for name, declared in self.channels.items():
            message, signal = database.places[declared.column]
            invalid = (declared.invalid,) if isinstance(declared.invalid, int) else declared.invalid
            declared_invalid = frozenset(message.physical(signal, raw) for raw in invalid)
            found[name] = Wanted(
                message,
                signal,
                declared_invalid | message.not_measured(signal),
                message.reserved(signal),
            )
        return database, found

    def _read_signals(self, file: Path) -> tuple[dict[str, Signal], dict[str, Any]]:
        database, wanted = self.wanted()
        bus = self.options.bus
        stamps, values = ({name: array("d") for name in wanted} for _ in range(2))
        for frame, found in decoded(read_frames(file, database.messages), database, wanted, bus):
            for name, value in found.items():
                stamps[name].append(frame.timestamp)
                values[name].append(value)
        signals = {}
        rates = {}
        for name, one in wanted.items():
            if len(stamps[name]) < 2:
                raise DataError(never_occurs(file, name, one, len(stamps[name]), bus))
            times = np.array(stamps[name])
            where = f"'{file}': message '{one.message.name}', which carries '{one.signal}',"
            require_clock(times, where, "where two buses carry it, say which by bus: …")
            origin = f"message '{one.message.name}'"
            signals[name] = Signal(
                origin, times, np.array(values[name]), one.message.units[one.signal]
            )
            rates[one.message.name] = round(signals[name].rate_hz, 3)
        return signals, {"dbc": self.dbc.name, "messages": rates}


def decoded(
    frames: Frames, database: Database, wanted: Mapping[str, Wanted], bus: int | str | None = None
) -> Iterator[tuple[Any, dict[str, float]]]:
    """Frames of a log with a wanted message, each with its values, channel -> value in the DBC's unit; NaN: invalid; raises `DataError`."""
    channels_of = channels_by_message(wanted)
    for frame in frames:
        message = database.messages.get((frame.arbitration_id, frame.is_extended_id))
        if message is None or not is_on(frame, bus):
            continue
        try:
            values = message.decode(frame.data)
        except DataError as error:
            raise DataError(
                f"'{frames.file}', at {frame.timestamp:.6f} s: {error}; is the file truncated, or the DBC another car's?"
            ) from None
        yield frame, channel_values(values, channels_of[message.name], wanted)


def channels_by_message(wanted: Mapping[str, Wanted]) -> dict[str, list[str]]:
    """Message -> the channels that its signals become."""
    found: dict[str, list[str]] = {}
    for name, one in wanted.items():
        found.setdefault(one.message.name, []).append(name)
    return found


def channel_values(
    values: Mapping[str, float], channels: list[str], wanted: Mapping[str, Wanted]
) -> dict[str, float]:
    """Values of the channels that a frame carries; NaN where it says that nothing was measured."""
    found = {
        name: values[wanted[name].signal] for name in channels if wanted[name].signal in values
    }
    return {
        name: value if wanted[name].is_measured(value) else math.nan
        for name, value in found.items()
    }


def is_on(frame: Any, bus: int | str | None) -> bool:
    """Whether a frame was on a bus, by its name or its number, which logs count from 1 and python-can from 0."""
    return bus is None or frame.channel == (
        bus - 1 if isinstance(bus, int) and not isinstance(bus, bool) else bus
    )


def never_occurs(
    file: Path, channel: str, wanted: Wanted, count: int, bus: int | str | None
) -> str:
    """Error text for a signal that a log does not hold."""
    message = wanted.message
    often = "occurs once only" if count else "never occurs"
    on = "" if bus is None else f" on bus {bus}"
    kind = "extended identifier" if message.described.is_extended_frame else "identifier"
    return (
        f"'{file}': signal '{wanted.signal}' for channel '{channel}' {often}{on}: message '{message.name}' carries it, with the {kind} "
        f"{message.described.frame_id:#x}; leave the channel out, or correct dbc, bus or the map of channels"
    )


SOURCE = CanSource
