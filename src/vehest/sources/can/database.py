"""What a DBC file says of the signals that are wanted, decoded by cantools.

A DBC can come from anywhere, and cantools makes lists as long as a message says it is. So its text is read here within limits first, and
only the messages and signals that are wanted, with the multiplexers that they depend on, are handed on, written anew.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vehest.data.errors import DataError, MissingError, printable
from vehest.data.files import regular_file
from vehest.data.limits import check_limit
from vehest.data.text_files import first_line

EXTENDED = 0x80000000
ID_BITS = 0x1FFFFFFF
UNASSIGNED = "VECTOR__INDEPENDENT_SIG_MSG"
MOST_BYTES = 64  # of a frame of CAN FD
MOST_BITS = 64  # of a number
MOST_SIGNALS = 10_000  # of one message
COMPARED = 10_000  # names that a misspelt one is compared with

_COMMENT = re.compile(r'^[ \t]*CM_\s[^"\n]*"(?:[^"\\]|\\.)*"\s*;', re.MULTILINE | re.DOTALL)
_MESSAGE = re.compile(r"[ \t]*BO_[ \t]+(\d{1,10})[ \t]+(\w{1,200})[ \t]*:[ \t]*(\d{1,10})\b")
_SIGNAL = re.compile(
    r"[ \t]*SG_[ \t]+(?P<name>\w{1,200})[ \t]*(?P<multiplex>M|m\d{1,9}M?)?[ \t]*:"
    r"[ \t]*(?P<start>\d{1,5})\|(?P<length>\d{1,5})@(?P<order>[01])(?P<sign>[+-])"
    r"[ \t]*\([ \t]*(?P<scale>[-+.\deE]{1,40})[ \t]*,[ \t]*(?P<offset>[-+.\deE]{1,40})[ \t]*\)"
    r'[ \t]*\[[^\]\n]{0,100}\][ \t]*"(?P<unit>[^"\n]{0,100})"'
)
_NAME = re.compile(r"[ \t]*SG_[ \t]+(\w{1,200})")
_FLOAT = re.compile(r"[ \t]*SIG_VALTYPE_[ \t]+(\d{1,10})[ \t]+(\w{1,200})[ \t]*:?[ \t]*([0-3])[ \t]*;")
_MULTIPLEXED = re.compile(r"[ \t]*SG_MUL_VAL_[ \t]+(\d{1,10})[ \t]+(\w{1,200})[ \t]+(\w{1,200})[ \t]+([\d \t,-]{1,2000});")


@dataclass
class Block:
    """A message as the text declares it.

    Args:
        number: its identifier, bit 31 set where it is an extended one.
        name: of the message.
        length: of its frames [bytes].
        signals: name -> its line.
    """

    number: int
    name: str
    length: int
    signals: dict[str, str] = field(default_factory=dict)


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


def read_database(file: Path, wanted: Sequence[str]) -> Database:
    """Read what a DBC says of signals.

    Args:
        file: the DBC.
        wanted: names, ``Message.Signal`` or ``Signal`` where only one message has it.

    Raises:
        MissingError: there is no such file, or cantools is not installed.
        DataError: it is too long, damaged, or a signal is not there, ambiguous, or longer than a frame.
    """
    text = read_dbc(file)
    blocks = blocks_of(text, file)
    found = {name: _locate(blocks, name, file) for name in wanted}
    multiplexers = _multiplexers(text)
    messages: dict[tuple[int, bool], Message] = {}
    of_block: dict[int, Message] = {}
    for block in {id(block): block for block, _ in found.values()}.values():
        names = list(dict.fromkeys(signal for other, signal in found.values() if other is block))
        message = _message(block, names, text, multiplexers.get(block.number, {}), file)
        if (message.frame_id, message.extended) in messages:
            raise DataError(f"'{file}': two messages have the identifier {message.frame_id:#x}; remove one")
        messages[message.frame_id, message.extended] = of_block[id(block)] = message
    places = {name: (of_block[id(block)], signal) for name, (block, signal) in found.items()}
    taken = frozenset((block.number & ID_BITS, bool(block.number & EXTENDED)) for block in blocks)
    return Database(file, messages, places, taken)


def read_dbc(file: Path) -> str:
    """The text of a DBC without its comments.

    Raises:
        MissingError: there is no such file.
        DataError: it is no file, or too long.
    """
    size = regular_file(file).stat().st_size
    check_limit("text_bytes", size, f"'{file}' is {size} bytes long")
    try:
        text = file.read_bytes().decode("cp1252", errors="replace")
    except OSError as error:
        raise DataError(f"cannot read '{file}': {error.strerror}") from None
    return _COMMENT.sub("", text.replace("\r\n", "\n").replace("\r", "\n"))


def blocks_of(text: str, file: Path) -> list[Block]:
    """All messages of a DBC that has no comments, with the lines of their signals.

    Raises:
        DataError: there are none, or a line cannot be read.
    """
    blocks: list[Block] = []
    for number, line in enumerate(text.split("\n"), start=1):
        word = line.lstrip(" \t")[:4]
        if word == "BO_ ":
            head = _MESSAGE.match(line)
            if head is None:
                raise DataError(f"'{file}': line {number} begins a message and cannot be read ({_shown(line)})")
            blocks.append(Block(int(head[1]), head[2], int(head[3])))
        elif word == "SG_ " and blocks:
            name = _NAME.match(line)
            if name is None:
                raise DataError(f"'{file}': line {number} declares a signal and cannot be read ({_shown(line)})")
            blocks[-1].signals[name[1]] = line
            if len(blocks[-1].signals) > MOST_SIGNALS:
                raise DataError(f"'{file}': message '{blocks[-1].name}' has more than {MOST_SIGNALS} signals")
    blocks = [block for block in blocks if block.name != UNASSIGNED]
    if not blocks:
        raise DataError(f"'{file}' declares no message; is it a DBC file?")
    return blocks


def _multiplexers(text: str) -> dict[int, dict[str, tuple[str, str]]]:
    """Message -> signal -> its multiplexer and the ranges of that one's values, where the file says so."""
    found: dict[int, dict[str, tuple[str, str]]] = {}
    for line in text.split("\n"):
        if line.startswith("SG_MUL_VAL_") and (entry := _MULTIPLEXED.match(line)):
            found.setdefault(int(entry[1]), {})[entry[2]] = (entry[3], entry[4].strip())
    return found


def _locate(blocks: Sequence[Block], wanted: str, file: Path) -> tuple[Block, str]:
    """The message and the signal that a name stands for."""
    message, _, signal = wanted.rpartition(".")
    found = [block for block in blocks if signal in block.signals and message in ("", block.name)]
    if len(found) > 1:
        names = ", ".join(f"{block.name}.{signal}" for block in found[:8])
        raise DataError(f"'{file}': signal '{wanted}' stands in several messages; write one of {names}")
    if not found:
        known = [f"{block.name}.{name}" for block in blocks for name in block.signals][:COMPARED]
        lower = {name.lower(): name for name in known if len(name) < 200}
        bare = {name.rpartition(".")[2]: lower[name] for name in lower}
        close = difflib.get_close_matches(wanted.lower(), list(lower if message else bare), n=3, cutoff=0.6)
        near = ", ".join((lower if message else bare)[name] for name in close)
        raise DataError(f"'{file}' has no signal '{wanted}' ({'near it: ' + near if near else f'it has {len(known)} signals'})")
    return found[0], signal


def _message(block: Block, wanted: Sequence[str], text: str, multiplexers: Mapping[str, tuple[str, str]], file: Path) -> Message:
    """A message with its wanted signals and their multiplexers, as cantools understands it."""
    where = f"'{file}': message '{block.name}'"
    if not 0 < block.length <= MOST_BYTES:
        raise DataError(f"{where} is {block.length} bytes long; frames of CAN hold 1 to {MOST_BYTES}")
    if block.number & ~(EXTENDED | ID_BITS) or (not block.number & EXTENDED and block.number > 0x7FF):
        raise DataError(f"{where} has the identifier {block.number}, which no frame can have")
    parsed: dict[str, dict[str, str]] = {}
    for name in wanted:
        for needed in _chain(block, name, multiplexers, where):
            parsed[needed] = _parsed(block, needed, where)
    floats = {entry[2]: entry[3] for entry in _FLOAT.finditer(text) if int(entry[1]) == block.number and entry[3] != "0"}
    plain = [name for name in wanted if not (parsed[name]["multiplex"] or "").startswith("m")]
    groups = ([plain] if plain else []) + [_chain(block, name, multiplexers, where) for name in wanted if name not in plain]
    coders = []
    for names in groups:
        lines = ['VERSION ""', "NS_ :", "BS_:", "BU_: Car", f"BO_ {block.number} {block.name}: {block.length} Car"]
        lines += [_line(name, parsed[name], multiplexed=names is not plain) for name in names]
        lines += [f"SIG_VALTYPE_ {block.number} {name} : {floats[name]};" for name in names if name in floats]
        ranges = [(name, *multiplexers[name]) for name in names if name in multiplexers and names is not plain]
        lines += [f"SG_MUL_VAL_ {block.number} {name} {multiplexer} {values};" for name, multiplexer, values in ranges]
        coders.append(_coder("\n".join(lines) + "\n", where))
    units = {name: parsed[name]["unit"] for name in wanted}
    return Message(block.number & ID_BITS, bool(block.number & EXTENDED), block.name, block.length, units, coders)


def _line(name: str, entry: Mapping[str, str], *, multiplexed: bool) -> str:
    mark = (entry["multiplex"] or "") if multiplexed else ""
    place = f"{entry['start']}|{entry['length']}@{entry['order']}{entry['sign']}"
    return f' SG_ {name} {mark} : {place} ({entry["scale"]},{entry["offset"]}) [0|0] "" Car'


def _chain(block: Block, wanted: str, multiplexers: Mapping[str, tuple[str, str]], where: str) -> list[str]:
    """A signal and the multiplexers that say whether a frame carries it, the outermost first."""
    marks = {name: (entry["multiplex"] or "") for name, line in block.signals.items() if (entry := _SIGNAL.match(line))}
    switches = [name for name, mark in marks.items() if mark == "M"]
    chain, name = [wanted], wanted
    while marks.get(name, "").startswith("m"):
        above = multiplexers[name][0] if name in multiplexers else switches[0] if len(switches) == 1 else ""
        if above not in marks or above in chain:
            raise DataError(f"{where}: nothing says when frames carry the multiplexed signal '{name}'")
        chain, name = [above, *chain], above
    return chain


def _parsed(block: Block, name: str, where: str) -> dict[str, str]:
    """What the line of a signal says, within what a frame can hold."""
    where, line = f"{where}: signal '{name}'", block.signals[name]
    entry = _SIGNAL.match(line)
    if entry is None:
        raise DataError(f"{where} cannot be read ({_shown(line)})")
    found = entry.groupdict()
    if int(found["start"]) >= 8 * block.length or not 0 < int(found["length"]) <= min(8 * block.length, MOST_BITS):
        raise DataError(f"{where} of {found['length']} bits from bit {found['start']} on is no number in {block.length} bytes")
    for key in ("scale", "offset"):
        try:
            value = float(found[key])
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or (key == "scale" and value == 0.0) or len(found[key]) > 30 or abs(value) > 1e30:
            raise DataError(f"{where} has the {key} '{found[key]}'; a finite number other than 0 is needed")
    return found


def _coder(text: str, where: str) -> Any:
    try:
        from cantools.database import load_string
    except ImportError:
        raise MissingError("reading CAN needs the packages python-can and cantools; pip install 'vehest[bus]'") from None
    try:
        return load_string(text, database_format="dbc").messages[0]
    except Exception as error:  # whatever a parser meets in what comes from a file
        raise DataError(f"{where} cannot be decoded ({first_line(error)[:160]})") from None


def _shown(line: str) -> str:
    return printable(line.strip()[:60])
