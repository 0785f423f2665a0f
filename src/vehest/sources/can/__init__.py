"""Logs of a CAN bus: frames decoded by a DBC, signals of different rates brought to one clock.

Which signal is which channel, and in which unit and sign, is declared in conf/dataset, as is the
DBC; one that says otherwise is refused.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import MISSING
from vehest.sources.base import require_files
from vehest.sources.can.database import Database, Message, read_database
from vehest.sources.can.logs import Frames, read_frames
from vehest.sources.clocks import require_clock
from vehest.sources.columns import ColumnName
from vehest.sources.signals import Signal, SignalChannel, SignalOptions, SignalSource

EXTENDED = 1 << 31  # bit of an extended identifier in the number that a DBC writes
GROUP_OF_J1939 = 0x03FFFF00  # bits of an identifier without priority and source address


@dataclass(frozen=True)
class CanOptions(SignalOptions):
    """Options of the source, by type; None leaves an option open."""

    files: str = "*.asc"  # pattern of the logs in ``path``
    dbc: str | None = None  # file that describes the messages
    # number or name of the bus whose frames are read; None: all
    bus: Annotated[int | str | None, "number or name of a bus, as the log counts them"] = None


@dataclass(frozen=True)
class CanChannel(SignalChannel):
    """A channel's signal, with raw values that mean that nothing was measured."""

    # raw values that mean that nothing was measured
    invalid: Annotated[int | tuple[int, ...], "raw values that mean 'not measured'"] = ()
    sign_column: ColumnName | None = None  # signal of the message, 1 where values are negative


@dataclass(frozen=True)
class ChannelSignal:
    """The signal that becomes a channel."""

    message: Message  # message that carries the signal
    signal: str  # name of the signal
    # values that mean that nothing was measured, in the unit of the DBC
    invalid: frozenset[float] = frozenset()
    # lowest and highest value of a range that means the same, in the unit of the DBC
    reserved: tuple[float, float] = (math.nan, math.nan)
    # signal of the same message that is 1 where the value is negative
    sign_signal: str | None = None

    @property
    def signals(self) -> set[str]:
        """Signals that a frame must carry."""
        return {self.signal} if self.sign_signal is None else {self.signal, self.sign_signal}

    def value(self, values: Mapping[str, float]) -> float:
        """The value of a frame's signals, in the unit of the DBC; NaN where it is no measurement.

        Parameters
        ----------
        values : mapping
            Signal -> value in the DBC's unit, `signals` among them.
        """
        value = values[self.signal]
        if value in self.invalid or self.reserved[0] <= value <= self.reserved[1]:
            return math.nan
        sign = 0.0 if self.sign_signal is None else values[self.sign_signal]
        return {0.0: value, 1.0: -value}.get(sign, math.nan)


class CanSource(SignalSource):
    """Logs, a recording each.

    Their frames are decoded by the data set's ``dbc``, those of one ``bus`` where a log holds
    several.
    """

    options_type = CanOptions
    options: CanOptions
    channel_type = CanChannel

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        super().__init__(dataset)
        if not self.options.dbc:
            raise ConfigurationError(
                f"{self.location}: dbc must name the DBC file that describes the bus, for example "
                f"dbc: ${{root}}/car.dbc"
            )
        self.dbc = Path(self.options.dbc).expanduser()

    def inputs(self) -> dict[str, str | Path]:
        """The logs and the DBC, by their names.

        Raises
        ------
        MissingError
            One of them is not there.
        """
        require_files([self.dbc], self.name)
        return {**super().inputs(), self.dbc.name: self.dbc}

    def signals_of_channels(self) -> tuple[Database, dict[str, ChannelSignal]]:
        """The DBC, and the signal of each channel.

        Values that count as not measured are those that the data set declares (raw), those whose
        name in the DBC says so, and those that J1939 reserves.

        Returns
        -------
        database : Database
            The messages that carry the signals, alone.
        by_channel : dict
            Channel -> its signal.

        Raises
        ------
        MissingError
            There is no DBC, or the package that reads it is not installed.
        DataError
            The DBC is damaged, or lacks a signal.
        """
        require_files([self.dbc], self.name)
        signs = [declared.sign_column for declared in self.channels.values()]
        columns = [declared.column for declared in self.channels.values()]
        database = read_database(self.dbc, [*columns, *filter(None, signs)])
        by_channel = {}
        for name, declared in self.channels.items():
            message, signal = database.places[declared.column]
            invalid = (declared.invalid,) if isinstance(declared.invalid, int) else declared.invalid
            sign_signal = None
            if declared.sign_column:
                sign_message, sign_signal = database.places[declared.sign_column]
                if sign_message is not message:
                    raise DataError(
                        f"'{self.dbc}': signal '{sign_signal}', the sign of channel '{name}', is "
                        f"in message '{sign_message.name}', '{signal}' in '{message.name}'; only "
                        "a sign in the same message can be declared: decode the log, and write "
                        "the signed value to one column"
                    )
            declared_invalid = frozenset(message.physical(signal, raw) for raw in invalid)
            by_channel[name] = ChannelSignal(
                message,
                signal,
                declared_invalid | message.not_measured(signal),
                message.reserved(signal),
                sign_signal,
            )
        return database, by_channel

    def _read_signals(self, file: Path) -> tuple[dict[str, Signal], dict[str, Any]]:
        """The signal of each channel, and an entry for the provenance, as of `SignalSource`."""
        database, by_channel = self.signals_of_channels()
        bus = self.options.bus
        stamps, values = ({name: array("d") for name in by_channel} for _ in range(2))
        frames = read_frames(file, database.messages)
        for frame, samples in decoded(frames, database, by_channel, bus):
            for name, value in samples.items():
                stamps[name].append(frame.timestamp)
                values[name].append(value)
        signals = {}
        rates = {}
        for name, described in by_channel.items():
            if len(stamps[name]) < 2:
                senders = [] if stamps[name] else [described.message.described]
                others = other_sources(read_frames(file), senders)
                text = never_occurs(file, name, described, len(stamps[name]), bus)
                raise DataError(text + others)
            times = np.array(stamps[name])
            origin = f"message '{described.message.name}'"
            location = f"'{file}': {origin}, which carries '{described.signal}',"
            require_clock(times, location, "cut the log there, or leave repeated frames out")
            unit = described.message.units[described.signal]
            signals[name] = Signal(origin, times, np.array(values[name]), unit)
            rates[described.message.name] = round(signals[name].rate_hz, 3)
        left_out = {MISSING: {"": [f"not read: {frames.cut_end}"]}} if frames.cut_end else {}
        return signals, {"dbc": self.dbc.name, "messages": rates, **left_out}


def decoded(
    frames: Frames,
    database: Database,
    by_channel: Mapping[str, ChannelSignal],
    bus: int | str | None = None,
) -> Iterator[tuple[Any, dict[str, float]]]:
    """Frames of a log that carry wanted signals, with their values.

    Frames of other messages, or on another bus, are passed over.

    Parameters
    ----------
    frames : Frames
        Frames in the order of the log.
    database : Database
        Describes the wanted messages.
    by_channel : mapping
        Channel -> its signal.
    bus : int, str or None
        See `is_on`.

    Yields
    ------
    frame : can.Message
        With ``timestamp`` [s].
    values : dict
        Channel -> value in the DBC's unit, NaN where the frame says that nothing was measured; only
        of channels whose signals the frame carries.

    Raises
    ------
    DataError
        A frame is shorter than the DBC says, or without ``bus`` a message comes on several buses.
    """
    channels_of = channels_by_message(by_channel)
    if bus is None:
        require_one_bus(frames, database.messages)
    for frame in frames:
        message = database.messages.get((frame.arbitration_id, frame.is_extended_id))
        if message is None or not is_on(frame, bus):
            continue
        try:
            values = message.decode(frame.data)
        except DataError as error:
            raise DataError(
                f"'{frames.file}', at {frame.timestamp:.6f} s: {error}; is the file truncated, or "
                "the DBC another car's?"
            ) from None
        yield frame, channel_values(values, channels_of[message.name], by_channel)


def require_one_bus(frames: Frames, messages: Mapping[tuple[int, bool], Message]) -> None:
    """Refuse a log in which frames of one message come on several buses.

    Raises
    ------
    DataError
        Such a message, with its buses as logs count them.
    """
    arrays = frames.arrays
    for (identifier, is_extended), message in messages.items():
        is_message = (arrays["identifier"] == identifier) & (arrays["extended"] == is_extended)
        buses = [frames.buses[number] for number in np.unique(arrays["bus"][is_message])]
        if len(buses) > 1:
            names = [str(bus + 1 if isinstance(bus, int) else bus) for bus in buses]
            raise DataError(
                f"'{frames.file}': message '{message.name}' comes on the buses "
                f"{', '.join(names)}; say which by bus: {names[0]}"
            )


def channels_by_message(by_channel: Mapping[str, ChannelSignal]) -> dict[str, list[str]]:
    """Message -> the channels that its signals become."""
    channels: dict[str, list[str]] = {}
    for name, signal in by_channel.items():
        channels.setdefault(signal.message.name, []).append(name)
    return channels


def channel_values(
    values: Mapping[str, float], channels: list[str], by_channel: Mapping[str, ChannelSignal]
) -> dict[str, float]:
    """Values of the channels that a frame carries; NaN where it says that nothing was measured.

    Parameters
    ----------
    values : mapping
        Signal -> value in the DBC's unit, of one frame.
    channels : list of str
        Channels that the frame's message may carry; those whose signal is not in ``values`` are
        left out.
    by_channel : mapping
        Channel -> its signal.
    """
    return {
        name: by_channel[name].value(values)
        for name in channels
        if by_channel[name].signals <= values.keys()
    }


def is_on(frame: Any, bus: int | str | None) -> bool:
    """Whether a frame was on a bus, by its name or its number.

    Logs count buses from 1, and python-can from 0; ``bus`` is as logs count. None is every bus.
    """
    return bus is None or frame.channel == (
        bus - 1 if isinstance(bus, int) and not isinstance(bus, bool) else bus
    )


def never_occurs(
    file: Path, channel: str, signal: ChannelSignal, count: int, bus: int | str | None
) -> str:
    """Text of the error for a signal that a log does not hold.

    Parameters
    ----------
    file : Path
        The log.
    channel : str
        Channel that lacks its signal.
    signal : ChannelSignal
        The signal and its message.
    count : int
        Samples found: none, or one, which makes no clock.
    bus : int, str or None
        The bus that was looked at, None for all.
    """
    message = signal.message
    often = "occurs once only" if count else "never occurs"
    on = "" if bus is None else f" on bus {bus}"
    kind = "extended identifier" if message.described.is_extended_frame else "identifier"
    return (
        f"'{file}': signal '{signal.signal}' for channel '{channel}' {often}{on}: message "
        f"'{message.name}' carries it, with the {kind} {message.described.frame_id:#x}; leave the "
        "channel out, or correct dbc, bus or the map of channels"
    )


def other_sources(frames: Frames, messages: Sequence[Any]) -> str:
    """Further text of this error where frames of a J1939 message of the DBC, as cantools describes
    it, come from other source addresses than the DBC says.
    """
    arrays = frames.arrays
    identifiers = np.unique(arrays["identifier"][arrays["extended"] == 1])
    for message in messages:
        group = GROUP_OF_J1939 & message.frame_id
        senders = [int(sender) for sender in identifiers if sender & GROUP_OF_J1939 == group]
        if senders and message.is_extended_frame:
            return (
                f". The log has {', '.join(map(hex, senders[:8]))}, the same parameter group of "
                f"J1939 from another source address as message '{message.name}'; for it write BO_ "
                f"{senders[0] | EXTENDED} in the DBC, instead of {message.frame_id | EXTENDED}"
            )
    return ""


SOURCE = CanSource
