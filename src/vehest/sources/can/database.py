"""Signals of a DBC file, by cantools.

DBC -> lengths of messages and signals, looked at since cantools makes lists as long -> cantools -> wanted signals with their multiplexers
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vehest.data.errors import DataError, printable
from vehest.data.files import regular_file
from vehest.data.limits import check_limit
from vehest.data.text_files import first_line
from vehest.sources.limited import require_package

MOST_BYTES = 64  # of a frame of CAN FD
MOST_BITS = 64  # of a number
LONGEST = 1785  # bytes of a message that J1939 sends in several frames
COMPARED = 10_000  # names that a misspelt one is compared with
UNASSIGNED = "VECTOR__INDEPENDENT_SIG_MSG"
_LENGTHS = re.compile(r"\b(?:BO_\s+\d+\s+\w+|SG_\s+\w+(?:\s+[mM]\w*)?)\s*:\s*(\d+)(?:\s*\|\s*(\d+))?")


@dataclass(frozen=True)
class Message:
    """A message of which signals are wanted.

    Args:
        frame_id: identifier of its frames.
        extended: whether that has 29 bits.
        name: as the DBC says.
        length: of its frames [bytes].
        units: wanted signal -> its unit as the DBC writes it.
        coders: of cantools: one for all signals that every frame carries, one for each that is multiplexed.
    """

    frame_id: int
    extended: bool
    name: str
    length: int
    units: Mapping[str, str]
    coders: Sequence[Any]

    def decode(self, data: bytes | bytearray) -> dict[str, float]:
        """Wanted signals that a frame carries, in the unit of the DBC; those that its multiplexer leaves out are not among them.

        Raises:
            DataError: it is shorter than the message.
        """
        if len(data) < self.length:
            raise DataError(f"a frame of message '{self.name}' holds {len(data)} of the {self.length} bytes that the DBC says")
        found: dict[str, float] = {}
        frame = bytes(data[: self.length])
        for coder in self.coders:
            try:
                values = coder.decode(frame, decode_choices=False)
            except Exception:  # of cantools, for a multiplexer's value that the signal does not go with
                continue
            found |= {name: float(value) for name, value in values.items() if name in self.units}
        return found

    def physical(self, signal: str, raw: int) -> float:
        """A raw value of a signal in the unit of the DBC."""
        (found,) = [known for coder in self.coders for known in coder.signals if known.name == signal]
        return float(found.raw_to_scaled(raw, decode_choices=False))


@dataclass(frozen=True)
class Database:
    """Messages that hold wanted signals.

    Args:
        file: the DBC.
        messages: (identifier, whether it is extended) -> message.
        places: wanted name -> its message and signal.
        taken: identifiers of all messages in the file.
    """

    file: Path
    messages: Mapping[tuple[int, bool], Message]
    places: Mapping[str, tuple[Message, str]]
    taken: frozenset[tuple[int, bool]]


def read_dbc(file: Path) -> list[Any]:
    """All messages of a DBC, as cantools holds them.

    Raises:
        MissingError: there is no such file, or cantools is not installed.
        DataError: it is too long or damaged, or declares a message or signal of impossible length.
    """
    size = regular_file(file).stat().st_size
    check_limit("text_bytes", size, f"'{file}' is {size} bytes long")
    require_package("cantools", "bus", "reading CAN")
    from cantools.database import load_string

    text = file.read_bytes().decode("cp1252", errors="replace")
    for found in _LENGTHS.finditer(text):
        if any(len(number or "") > 5 or int(number or 0) > 8 * LONGEST for number in found.groups()):
            raise DataError(f"'{file}' declares a message or signal of impossible length: {printable(' '.join(found[0].split())[:80])}")
    try:
        messages = [message for message in load_string(text, "dbc", strict=False).messages if message.name != UNASSIGNED]
    except Exception as error:  # of cantools and its parser, of any kind
        raise DataError(f"'{file}' cannot be read as a DBC ({printable(first_line(error)[:160])})") from None
    if not messages:
        raise DataError(f"'{file}' declares no message; is it a DBC file?")
    return messages


def read_database(file: Path, wanted: Sequence[str]) -> Database:
    """What a DBC says of wanted signals.

    Args:
        file: the DBC.
        wanted: names, ``Message.Signal`` or ``Signal`` where only one message has it.

    Raises:
        MissingError: there is no such file, or cantools is not installed.
        DataError: it is too long, damaged, or a signal is not there, ambiguous, or longer than a frame.
    """
    described = read_dbc(file)
    found = {name: _locate(described, name, file) for name in wanted}
    messages: dict[tuple[int, bool], Message] = {}
    for message in {id(message): message for message, _ in found.values()}.values():
        names = list(dict.fromkeys(signal for other, signal in found.values() if other is message))
        key = (message.frame_id, message.is_extended_frame)
        if key in messages:
            raise DataError(f"'{file}': two messages have the identifier {message.frame_id:#x}; remove one")
        messages[key] = _message(message, names, file)
    places = {name: (messages[message.frame_id, message.is_extended_frame], signal) for name, (message, signal) in found.items()}
    return Database(file, messages, places, frozenset((message.frame_id, message.is_extended_frame) for message in described))


def _locate(messages: Sequence[Any], wanted: str, file: Path) -> tuple[Any, str]:
    """The message and the signal that a name stands for."""
    name, _, signal = wanted.rpartition(".")
    found = [message for message in messages if name in ("", message.name) and any(known.name == signal for known in message.signals)]
    if len(found) > 1:
        names = ", ".join(f"{message.name}.{signal}" for message in found[:8])
        raise DataError(f"'{file}': signal '{wanted}' stands in several messages; write one of {names}")
    if not found:
        known = [f"{message.name}.{one.name}" for message in messages for one in message.signals][:COMPARED]
        lower = {(full if name else full.rpartition(".")[2]).lower(): full for full in known}
        near = ", ".join(lower[close] for close in difflib.get_close_matches(wanted.lower(), lower, n=3))
        raise DataError(f"'{file}' has no signal '{wanted}' ({'near it: ' + near if near else f'it has {len(known)} signals'})")
    return found[0], signal


def _message(message: Any, wanted: Sequence[str], file: Path) -> Message:
    """A message with its wanted signals and their multiplexers alone."""
    from cantools.database.can import Message as Coder

    where = f"'{file}': message '{message.name}'"
    if not 0 < message.length <= MOST_BYTES:
        raise DataError(f"{where} is {message.length} bytes long; frames of CAN hold 1 to {MOST_BYTES}")
    signals = {signal.name: signal for signal in message.signals}
    chains = {name: _chain(signals, name, where) for name in wanted}
    plain = [name for name in wanted if len(chains[name]) == 1]
    coders = []
    for names in ([plain] if plain else []) + [chains[name] for name in wanted if name not in plain]:
        for one in (signals[name] for name in names):
            if one.length > MOST_BITS:
                raise DataError(f"{where}: signal '{one.name}' of {one.length} bits is no number")
            if not 0.0 < abs(one.scale) < 1e30 or not abs(one.offset) < 1e30:
                raise DataError(
                    f"{where}: signal '{one.name}' has the scale {one.scale} and offset {one.offset}; finite numbers are needed"
                )
        parts = [signals[name] for name in names]
        try:
            coders.append(Coder(message.frame_id, message.name, message.length, parts, is_extended_frame=message.is_extended_frame))
        except Exception as error:  # of cantools
            raise DataError(f"{where} cannot be decoded ({printable(first_line(error)[:160])})") from None
    units = {name: signals[name].unit or "" for name in wanted}
    return Message(message.frame_id, message.is_extended_frame, message.name, message.length, units, coders)


def _chain(signals: Mapping[str, Any], wanted: str, where: str) -> list[str]:
    """A signal and the multiplexers that decide whether a frame carries it, the outermost first."""
    chain = [wanted]
    while signals[chain[0]].multiplexer_ids is not None:
        above = signals[chain[0]].multiplexer_signal
        if above not in signals or above in chain:
            raise DataError(f"{where}: nothing says when frames carry the multiplexed signal '{chain[0]}'")
        chain.insert(0, above)
    return chain
