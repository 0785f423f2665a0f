"""ASAM MDF 2, 3 and 4: signals of groups with rasters of their own, brought to one clock.

Which signal is which channel, and in which unit and sign, is declared in conf/dataset; a file that
says otherwise is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from vehest.data.errors import DataError
from vehest.data.files import regular_file
from vehest.sources.clocks import clock_fault
from vehest.sources.columns import SampledColumn
from vehest.sources.limited import read_limited, require_package
from vehest.sources.signals import Signal, SignalChannel, SignalOptions, SignalSource

Requests = Mapping[str, tuple[str, int | str | None]]
"""Key -> name of a signal, and number or name of its group, where the name occurs in several."""


@dataclass(frozen=True)
class MdfOptions(SignalOptions):
    """Options of the source, by type; None leaves an option open."""

    files: str = "*.mf4"  # pattern of the measurements in ``path``


@dataclass(frozen=True)
class MdfChannel(SignalChannel, SampledColumn):
    """A channel's signal, with the number or name of its group where its name occurs in several."""

    # number or name of the signal's group
    group: Annotated[int | str | None, "the number or name of a group"] = None


class MdfSource(SignalSource):
    """Measurements, a recording each or, with ``max_gap``, one for each part between pauses."""

    options_type = MdfOptions
    channel_type = MdfChannel

    def _read_signals(self, file: Path) -> tuple[dict[str, Signal], dict[str, Any]]:
        """The signal of each channel, and version, start and the rates of the groups of the
        measurement.
        """
        requests = {
            f"{name}.{column}": (column, declared.group)
            for name, declared in self.channels.items()
            for column in declared.column_names
        }
        read, _, about = read_measurement(file, requests)
        signals = {}
        for name, declared in self.channels.items():
            parts = {column: read[f"{name}.{column}"] for column in declared.column_names}
            signal = parts[declared.column]
            if not all(np.array_equal(part.stamps, signal.stamps) for part in parts.values()):
                raise DataError(
                    f"'{file}': signal '{declared.sign_column}', the sign of channel '{name}', is "
                    f"not in {signal.origin}, as '{declared.column}' is; write the signed value "
                    "to one signal"
                )
            values = {column: part.values for column, part in parts.items()}
            signals[name] = replace(signal, values=declared.measured(file, values))
        rates = {
            signal.origin.removeprefix("group "): round(signal.rate_hz, 3)
            for signal in signals.values()
        }
        return signals, {"version": about["version"], "measured": about["start"], "groups": rates}


def read_measurement(
    file: Path, requests: Requests | None
) -> tuple[dict[str, Signal], list[str], dict[str, Any]]:
    """Signals of a measurement.

    Parameters
    ----------
    file : Path
        ASAM MDF 2, 3 or 4.
    requests : mapping or None
        Key -> where its signal stands; None for every signal of numbers whose group has times.

    Returns
    -------
    signals : dict
        Key -> signal, whose stamps are those of its group [s].
    skipped : list of str
        What was not read and why; empty with ``requests``.
    about : dict
        ``version``, ``start`` and, by key, ``signals`` of the file.

    Raises
    ------
    MissingError
        There is no such file, or asammdf is not installed.
    DataError
        The file, or a signal of ``requests``, is unusable.
    """
    require_package("asammdf", "mdf", f"reading '{file}'")
    arrays, about = read_limited(
        "vehest.sources.readers.mdf:read", regular_file(file), requests=requests
    )
    signals = {}
    skipped = list(about["skipped"])
    faults = {
        group: clock_fault(
            arrays[f"stamps {group}"], "repair the measurement, or cut the range out"
        )
        for group in {place["group"] for place in about["signals"].values()}
    }
    for key, place in about["signals"].items():
        reason = faults[place["group"]]
        location = f"signal '{place['name']}' of group {place['title']}"
        if not reason:
            signals[key] = Signal(
                f"group {place['title']}",
                arrays[f"stamps {place['group']}"],
                arrays[key],
                place["unit"],
            )
        elif requests is not None:
            raise DataError(f"'{file}': {location}: {reason}")
        else:
            skipped.append(f"{location}: {reason}")
    return signals, skipped, about


SOURCE = MdfSource
