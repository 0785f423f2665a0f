"""ASAM MDF 3 and 4: signals of groups with rasters of their own, brought to one clock.

Which signal is which channel, and in which unit and sign, is declared in conf/dataset; a file that says otherwise is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vehest.data.errors import ConfigurationError
from vehest.sources.mdf.files import Wanted, read_measurement
from vehest.sources.signals import Signal, SignalOptions, SignalSource


@dataclass(frozen=True)
class MdfOptions(SignalOptions):
    """Options of the source, by type; what is None is not said."""

    files: str = "*.mf4"


class MdfSource(SignalSource):
    """Measurements, a recording each; a channel may say in which ``group`` its signal stands."""

    options_type = MdfOptions
    own_keys = frozenset({"group"})

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        super().__init__(dataset)
        self.groups = {name: self._group(name, dataset["channels"][name].get("group")) for name in self.channels}

    def _group(self, channel: str, group: Any) -> int | str | None:
        if group is not None and (isinstance(group, bool) or not isinstance(group, int | str)):
            raise ConfigurationError(f"{self.where}: channel '{channel}': group must be the number or name of a group, not {group}")
        return group

    def _read_signals(self, file: Path) -> tuple[dict[str, Signal], dict[str, Any]]:
        wanted = {name: Wanted(declared.column, self.groups[name]) for name, declared in self.channels.items()}
        measurement = read_measurement(file, wanted)
        rates = {signal.origin.removeprefix("group "): round(signal.rate_hz, 3) for signal in measurement.signals.values()}
        return dict(measurement.signals), {"version": measurement.version, "measured": measurement.start, "groups": rates}


SOURCE = MdfSource
