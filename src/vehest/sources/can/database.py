"""Signals of a DBC file, by cantools.

DBC -> lengths of messages and signals, looked at since cantools makes lists as long -> cantools ->
wanted signals with their multiplexers
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vehest.data.errors import DataError, printable, suggestion
from vehest.data.files import regular_file
from vehest.data.limits import check_limit
from vehest.data.text_files import first_line
from vehest.sources.limited import require_package
from vehest.sources.not_measured import marks_not_measured

COMPARED = 10_000  # largest number of names with which a misspelt one is compared
RESERVED_BYTE = 0xFB  # smallest highest byte of a value that J1939-71 reserves
RESERVED_LENGTHS = (8, 12, 16, 24, 32)  # bits, lengths of signals that have reserved values
UNASSIGNED = "VECTOR__INDEPENDENT_SIG_MSG"  # name of the message of signals that no message sends
# matches messages and signals of a DBC that are too long for cantools' lists
_TOO_LONG = re.compile(
    r"\b(?:BO_\s+\d+\s+\w+\s*:\s*\d{5,}|SG_\s+\w+(?:\s+[mM]\w*)?\s*:\s*(?:\d+\s*\|\s*)?\d{6,})"
)


@dataclass(frozen=True)
class Message:
    """A message of which signals are wanted."""

    described: Any  # message as cantools describes it
    units: Mapping[str, str]  # wanted signal -> its unit as the DBC writes it
    # coders of cantools: one for all signals that every frame carries, and one for each that is
    # multiplexed
    coders: Sequence[Any]

    @property
    def name(self) -> str:
        """Name of the message in the DBC."""
        return str(self.described.name)

    def decode(self, data: bytes | bytearray) -> dict[str, float]:
        """Wanted signals that a frame carries, in the DBC's unit.

        Bytes beyond the message's length are ignored. Signals that the frame's multiplexer leaves
        out are left out here.

        Raises
        ------
        DataError
            The frame is shorter than the DBC says.
        """
        length = self.described.length
        if len(data) < length:
            raise DataError(
                f"a frame of message '{self.name}' holds {len(data)} of the {length} bytes that "
                "the DBC says"
            )
        decoded: dict[str, float] = {}
        frame = bytes(data[:length])
        for coder in self.coders:
            try:
                values = coder.decode(frame, decode_choices=False)
            # of cantools, for a multiplexer's value that the signal does not go with
            except Exception:
                continue
            decoded |= {name: float(value) for name, value in values.items() if name in self.units}
        return decoded

    def physical(self, signal: str, raw: int) -> float:
        """A raw value of a signal in the unit of the DBC: scaled and shifted, not named."""
        described = self.described.get_signal_by_name(signal)
        return float(described.raw_to_scaled(raw, decode_choices=False))

    def not_measured(self, signal: str) -> frozenset[float]:
        """Values, in the unit of the DBC, whose names say that nothing was measured.

        The value 0 is kept where the signal may be 0: a car that stands sends it.
        """
        described = self.described.get_signal_by_name(signal)
        return frozenset(
            value
            for raw, name in (described.choices or {}).items()
            if marks_not_measured(str(name), signal)
            and ((value := self.physical(signal, raw)) != 0.0 or _is_outside(described, value))
        )

    def reserved(self, signal: str) -> tuple[float, float]:
        """Range of the values that J1939-71 reserves for errors and for what is not available.

        Raw values from 0xFB in the highest byte. Without the attribute that names the protocol,
        an extended frame counts whose DBC declares a maximum below these values.

        Returns
        -------
        tuple of float
            Lowest and highest of them in the unit of the DBC, both included; NaN without any.
        """
        described = self.described.get_signal_by_name(signal)
        length = described.length
        if described.is_signed or described.is_float or length not in RESERVED_LENGTHS:
            return math.nan, math.nan
        first = self.physical(signal, RESERVED_BYTE << (length - 8))
        last = self.physical(signal, (1 << length) - 1)
        is_j1939 = self.described.protocol == "j1939" or (
            self.described.is_extended_frame and _is_outside(described, first)
        )
        return (min(first, last), max(first, last)) if is_j1939 else (math.nan, math.nan)


def _is_outside(described: Any, value: float) -> bool:
    """Whether a value lies outside of the range that the DBC declares, if it declares one."""
    low = -math.inf if described.minimum is None else described.minimum
    high = math.inf if described.maximum is None else described.maximum
    return bool(low < high and not low <= value <= high)


@dataclass(frozen=True)
class Database:
    """Messages of a DBC that hold wanted signals."""

    file: Path  # the DBC
    messages: Mapping[tuple[int, bool], Message]  # (identifier, whether it is extended) -> message
    places: Mapping[str, tuple[Message, str]]  # wanted name -> its message and signal
    identifiers: frozenset[tuple[int, bool]]  # identifiers of all messages in the file


def read_dbc(file: Path) -> list[Any]:
    """Messages of a DBC, as cantools holds them.

    The text is UTF-8, or else Windows-1252. Signals that no message sends are left out.

    Raises
    ------
    MissingError
        There is no such file, or cantools is not installed.
    DataError
        It is longer than ``limits.text_bytes``, damaged, declares no message, or a message or
        signal of impossible length.
    """
    size = regular_file(file).stat().st_size
    check_limit("text_bytes", size, f"'{file}' is {size} bytes long")
    require_package("cantools", "bus", "reading CAN")
    from cantools.database import load_string

    raw = file.read_bytes()
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:  # "°" and umlauts of the usual code page are no UTF-8
        text = raw.decode("cp1252", errors="replace")
    if impossible := _TOO_LONG.search(text):
        raise DataError(
            f"'{file}' declares a message or signal of impossible length: "
            f"{printable(' '.join(impossible[0].split())[:80])}"
        )
    try:
        messages = [
            message
            for message in load_string(text, "dbc", strict=False).messages
            if message.name != UNASSIGNED
        ]
    except Exception as error:  # of cantools and its parser, of any kind
        raise DataError(
            f"'{file}' cannot be read as a DBC ({printable(first_line(error))})"
        ) from None
    if not messages:
        raise DataError(f"'{file}' declares no message; is it a DBC file?")
    return messages


def read_database(file: Path, selected: Sequence[str]) -> Database:
    """Messages of a DBC that carry wanted signals.

    Parameters
    ----------
    file : Path
        The DBC.
    selected : sequence of str
        Names of signals, as ``Message.Signal`` where several messages have one of that name.

    Raises
    ------
    MissingError
        There is no such file, or cantools is not installed.
    DataError
        The DBC is damaged, lacks a signal or has it several times, or declares one that cannot be
        decoded; or two messages have one identifier.
    """
    described = read_dbc(file)
    places_of: dict[str, list[tuple[Any, str]]] = {}
    for message in described:
        for signal in message.signals:
            for name in (f"{message.name}.{signal.name}", signal.name):
                places_of.setdefault(name, []).append((message, signal.name))
    chosen = {name: _only_place(places_of, name, file) for name in selected}
    messages: dict[tuple[int, bool], Message] = {}
    for message, _ in chosen.values():
        key = _identifier(message)
        if key not in messages:
            names = [signal for candidate, signal in chosen.values() if candidate is message]
            messages[key] = message_of(message, list(dict.fromkeys(names)), file)
        elif messages[key].described is not message:
            raise DataError(
                f"'{file}': two messages have the identifier {message.frame_id:#x}; remove one"
            )
    places = {
        name: (messages[_identifier(message)], signal) for name, (message, signal) in chosen.items()
    }
    return Database(file, messages, places, frozenset(map(_identifier, described)))


def _identifier(message: Any) -> tuple[int, bool]:
    """Identifier of cantools' message and whether it is extended, which together are unique on a
    bus.
    """
    return message.frame_id, message.is_extended_frame


def _only_place(
    places_of: Mapping[str, Sequence[tuple[Any, str]]], name: str, file: Path
) -> tuple[Any, str]:
    """The one message and signal of a name; `DataError` where there is none, or more than one."""
    places = places_of.get(name, ())
    if len(places) > 1:
        names = ", ".join(f"{message.name}.{signal}" for message, signal in places[:8])
        raise DataError(
            f"'{file}': signal '{name}' stands in several messages; write one of {names}"
        )
    if not places:
        meant = printable(suggestion(name, list(places_of)[:COMPARED]))
        raise DataError(f"'{file}' has no signal '{name}'{meant}")
    return places[0]


def message_of(message: Any, selected: Sequence[str], file: Path) -> Message:
    """A message of cantools with its wanted signals and their multiplexers alone.

    Raises
    ------
    DataError
        A signal has no finite scale, lies outside of the message, or has no multiplexer.
    """
    from cantools.database.can import Message as Coder

    location = f"'{file}': message '{message.name}'"
    signals = {signal.name: signal for signal in message.signals}
    chains = [_chain(signals, name, location) for name in selected]
    plain = [chain[0] for chain in chains if len(chain) == 1]
    coders = []
    for names in filter(None, [plain, *(chain for chain in chains if len(chain) > 1)]):
        parts = [signals[name] for name in names]
        for signal in parts:
            if not 0.0 < abs(signal.scale) < 1e30 or not abs(signal.offset) < 1e30:
                raise DataError(
                    f"{location}: signal '{signal.name}' has the scale {signal.scale} and offset "
                    f"{signal.offset}; correct the DBC"
                )
        try:
            identity = message.frame_id, message.name, message.length
            coders.append(Coder(*identity, parts, is_extended_frame=message.is_extended_frame))
        except Exception as error:  # of cantools
            raise DataError(
                f"{location} cannot be decoded ({printable(first_line(error))})"
            ) from None
    return Message(message, {name: signals[name].unit or "" for name in selected}, coders)


def _chain(signals: Mapping[str, Any], signal: str, location: str) -> list[str]:
    """A signal and the multiplexers that decide whether a frame carries it, the outermost first."""
    chain = [signal]
    while signals[chain[0]].multiplexer_ids is not None:
        above = signals[chain[0]].multiplexer_signal
        if above not in signals or above in chain:
            raise DataError(
                f"{location}: nothing says when frames carry the multiplexed signal '{chain[0]}'"
            )
        chain.insert(0, above)
    return chain
