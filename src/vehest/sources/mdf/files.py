"""Signals of ASAM MDF files through asammdf: physical values with their times, and one clear line for what cannot be used."""

from __future__ import annotations

import difflib
import gc
import logging
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from vehest.data.checks import checks_of_clock
from vehest.data.errors import DataError, MissingError
from vehest.data.recording import FloatArray

MAGIC = (b"MDF     ", b"UnFinMF ")
TIME = 1  # sync type of a master channel
MAY_BE_INVALID = 2  # flag of a channel
VIRTUAL = (3, 6)  # types of channels that stand in no record


@dataclass(frozen=True)
class Wanted:
    """Where a signal stands.

    Args:
        name: of the signal in the file.
        group: number or name of its channel group, where the name occurs in several.
    """

    name: str
    group: int | str | None = None


@dataclass(frozen=True)
class Signal:
    """One signal.

    Args:
        group: its channel group, for messages.
        stamps: seconds since the start of the measurement, strictly increasing, shape (T,).
        values: physical values in the file's unit, NaN where the file marks them as invalid, shape (T,).
        unit: as the file writes it.
    """

    group: str
    stamps: FloatArray
    values: FloatArray
    unit: str

    @property
    def rate_hz(self) -> float:
        """Rate behind the median interval [Hz]."""
        return float(1.0 / np.median(np.diff(self.stamps)))


@dataclass(frozen=True)
class Measurement:
    """What is read of a file.

    Args:
        signals: by the names under which they are wanted.
        version: of the format.
        start: when the measurement started, ISO 8601.
    """

    signals: Mapping[str, Signal]
    version: str
    start: str


def read_measurement(file: Path, wanted: Mapping[str, Wanted]) -> Measurement:
    """Read signals of an MDF file of version 3 or 4.

    Raises:
        MissingError: asammdf is not installed.
        DataError: the file cannot be read, or a signal is not there, ambiguous, no number, or without usable times.
    """
    try:
        with _quiet():
            from asammdf import MDF
    except ImportError:
        raise MissingError("reading MDF files needs the package asammdf; pip install 'vehest[mdf]'") from None
    _require_mdf(file)
    with TemporaryDirectory(prefix="vehest-mdf-") as folder, _quiet():
        opened, reason = _attempt(lambda: MDF(file, temporary_folder=folder))
        if opened is None:
            gc.collect()  # what asammdf left half open holds a file in the folder
            raise _unreadable(file, reason)
        try:
            signals = {name: _signal(opened, one, file) for name, one in wanted.items()}
            return Measurement(signals, str(opened.version), _start(opened))
        finally:
            with suppress(Exception):  # what could be wrong with the file has been said
                opened.close()


def _signal(opened: Any, wanted: Wanted, file: Path) -> Signal:
    number, index = _locate(opened, wanted, file)
    group, channel_group = _group_name(opened, number), opened.groups[number].channel_group
    where = f"'{file}': signal '{wanted.name}' of group {group}"
    master = opened.masters_db.get(number)
    if master is None or getattr(opened.groups[number].channels[master], "sync_type", TIME) != TIME:
        raise DataError(f"{where} has no time stamps: its group has no master channel of time")
    if any(_is_outside(opened.groups[number].channels[place], channel_group) for place in (index, master)):
        raise DataError(f"{where} stands outside of its group's records; the file is damaged")
    read, reason = _attempt(lambda: opened.get(group=number, index=index, ignore_invalidation_bits=True))
    if read is None:
        raise _unreadable(file, f"signal '{wanted.name}': {reason}")
    if not len(read.samples) == len(read.timestamps) == channel_group.cycles_nr:
        raise DataError(
            f"{where} holds {len(read.samples)} samples, its header says {channel_group.cycles_nr}; the file is truncated or damaged"
        )
    if read.samples.ndim != 1 or read.samples.dtype.kind not in "biuf":
        what = "text" if read.samples.ndim == 1 and read.samples.dtype.kind in "SUO" else "an array or structure"
        raise DataError(f"{where} holds {what}; numbers are needed: name another signal, or one without a conversion to text")
    stamps = np.asarray(read.timestamps, dtype=np.float64)
    for finding in checks_of_clock(stamps):
        if finding.check == "clock":
            raise DataError(f"{where}: {finding.message}; repair the measurement, or cut the range out")
    values = np.array(read.samples, dtype=np.float64)
    if read.invalidation_bits is not None:
        values[np.asarray(read.invalidation_bits, dtype=bool)] = np.nan
    return Signal(group, stamps, values, str(read.unit or ""))


def _is_outside(described: Any, channel_group: Any) -> bool:
    """Whether a channel reaches beyond its record, where asammdf would read on in foreign memory."""
    if not hasattr(described, "byte_offset"):  # version 3 or 2
        extra = getattr(described, "additional_byte_offset", 0)
        return bool(8 * extra + described.start_offset + described.bit_count > 8 * channel_group.samples_byte_nr)
    if described.flags & MAY_BE_INVALID and described.pos_invalidation_bit >= 8 * channel_group.invalidation_bytes_nr:
        return True
    end = 8 * described.byte_offset + described.bit_offset + described.bit_count
    return bool(described.channel_type not in VIRTUAL and end > 8 * channel_group.samples_byte_nr)


def _locate(opened: Any, wanted: Wanted, file: Path) -> tuple[int, int]:
    """Numbers of a signal's group and of the signal in it."""
    found = [(group, index) for group, index in opened.channels_db.get(wanted.name, ()) if index != opened.masters_db.get(group)]
    if not found:
        raise DataError(f"'{file}' has no signal '{wanted.name}' ({_near(opened, wanted.name)}); correct the map in conf/dataset")
    kept = [one for one in found if wanted.group is None or wanted.group in (one[0], _acquisition(opened, one[0]))]
    groups = ", ".join(dict.fromkeys(_group_name(opened, group) for group, _ in kept or found))
    if not kept:
        raise DataError(f"'{file}': signal '{wanted.name}' is not in group '{wanted.group}', but in {groups}; correct group")
    if len({group for group, _ in kept}) > 1:
        raise DataError(f"'{file}': signal '{wanted.name}' stands in several groups: {groups}; say which by number or name with group: …")
    if len(kept) > 1:
        raise DataError(f"'{file}': signal '{wanted.name}' stands {len(kept)} times in group {groups}; rename all but one")
    return kept[0]


def _near(opened: Any, name: str) -> str:
    names = {str(known): str(known).lower() for known in opened.channels_db}
    close = difflib.get_close_matches(name.lower(), list(names.values()), n=3, cutoff=0.6)
    if close:
        return "near it: " + ", ".join(known for known, lower in names.items() if lower in close)
    if any(known.startswith(("CAN_DataFrame", "LIN_Frame", "ETH_Frame", "FLX_Frame")) for known in names):
        return "it holds undecoded frames of a bus: decode them with their description, for example by asammdf's extract_bus_logging"
    return f"it has {len(names)} signals"


def _group_name(opened: Any, number: int) -> str:
    name = _acquisition(opened, number)
    return f"{number} '{name}'" if name else str(number)


def _acquisition(opened: Any, number: int) -> str:
    """A group's name, in version 4 that of its acquisition, in version 3 its comment."""
    channel_group = opened.groups[number].channel_group
    return str(getattr(channel_group, "acq_name", None) or (channel_group.comment if opened.version < "4" else "") or "")


def _start(opened: Any) -> str:
    found, _ = _attempt(lambda: opened.start_time.isoformat())
    return str(found or "")


def _require_mdf(file: Path) -> None:
    try:
        with open(file, "rb") as stream:
            head = stream.read(64)
    except OSError as error:
        raise DataError(f"cannot read '{file}': {error.strerror or error}; check the disk and its permissions") from None
    if not head.startswith(MAGIC):
        raise DataError(f"'{file}' is not an MDF file: it does not begin with 'MDF'; is it of another format, or compressed?")
    if len(head) < 64:
        raise _unreadable(file, "its head is incomplete")


def _unreadable(file: Path, reason: str) -> DataError:
    return DataError(f"'{file}' cannot be read as MDF ({reason}); is it truncated or damaged?")


def _attempt(act: Callable[[], Any]) -> tuple[Any, str]:
    """A result, or in one line why there is none; asammdf fails on damaged files in any way there is."""
    try:
        return act(), ""
    except Exception as error:
        return None, " ".join(str(error).split())[:160] or type(error).__name__


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep asammdf from logging, and from printing what goes wrong as it clears up after a damaged file."""
    logger, hook = logging.getLogger("asammdf"), sys.unraisablehook
    disabled, logger.disabled = logger.disabled, True
    sys.unraisablehook = lambda _: None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.disabled, sys.unraisablehook = disabled, hook
