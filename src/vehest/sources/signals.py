"""Signals with times of their own, in groups of several rasters or in frames of a bus, brought to one clock.

Which signal is which channel, and in which unit and sign, is declared in conf/dataset; a file that contradicts it is refused.

file -> a `Signal` each channel -> ticks on which all that are not gappy have values -> channels
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, cast

import numpy as np

from vehest.constants import FloatArray
from vehest.data.channels import channel
from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.recording import Recording
from vehest.sources.base import Source, matching_files, require_files
from vehest.sources.clocks import SLACK, at_ticks, common_ticks, on_nearest, uniform_clock
from vehest.sources.columns import ChannelMap, ChannelNames, Column, Positive, Rate, columns_from_config
from vehest.sources.unit_spellings import require_unit

GAP = 3.0  # median intervals that are interpolated where max_gap is not declared
FASTER = 1.05  # than the raster: the rest would fold into it


@dataclass(frozen=True)
class SignalChannel(Column):
    """Declaration of a signal that becomes a channel.

    Args:
        interpolation: ``linear``, or ``hold`` for values that hold until the next one.
        max_gap: longest time between two samples that is interpolated [s]; None for three median intervals.
    """

    interpolation: Literal["linear", "hold"] = "linear"
    max_gap: Positive | None = None


@dataclass(frozen=True)
class Grid:
    """The clock that everything is brought to.

    Args:
        times: ticks [s], shape (T,).
        rate_hz: their rate [Hz].
        stamps: where the clock is a signal's own, that signal's stamps [s], shape (T,).
    """

    times: FloatArray
    rate_hz: float
    stamps: FloatArray | None = None


@dataclass(frozen=True)
class Signal:
    """One signal.

    Args:
        origin: its channel group or message, for messages: ``group 3 (Gateway)``.
        stamps: times of the samples [s], strictly increasing, shape (T,).
        values: physical values in the file's unit, NaN where the file marks them as invalid, shape (T,).
        unit: as the file writes it.
    """

    origin: str
    stamps: FloatArray
    values: FloatArray
    unit: str

    @property
    def rate_hz(self) -> float:
        """Rate behind the median interval [Hz]."""
        return float(1.0 / np.median(np.diff(self.stamps)))


@dataclass(frozen=True)
class SignalOptions:
    """Options of every source of signals; docs/sources/mdf.md describes them."""

    channels: ChannelMap
    path: str | None = None
    files: str = "*"
    rate_hz: Rate | None = None
    raster: str | None = None
    gappy: ChannelNames | None = None
    file_units: Literal["check", "ignore"] = "check"


class SignalSource(Source):
    """Files of signals, a recording each.

    Attributes:
        own_keys: of a channel's declaration, which the source itself reads.
    """

    options_type = SignalOptions
    options: SignalOptions
    own_keys: ClassVar[frozenset[str]] = frozenset()

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        super().__init__(dataset)
        options = self.options
        entries = {
            name: {key: value for key, value in entry.items() if key not in self.own_keys} if isinstance(entry, Mapping) else entry
            for name, entry in options.channels.items()
        }
        self.channels = cast(dict[str, SignalChannel], columns_from_config(entries, self.name, SignalChannel))
        self.gappy = frozenset(options.gappy or ())
        if not self.channels:
            raise ConfigurationError(f"{self.where}: channels must map a channel to its column and unit")
        if unknown := sorted(self.gappy - set(self.channels)):
            raise ConfigurationError(f"{self.where}: gappy names '{unknown[0]}', which is not one of its channels")
        if (options.rate_hz is None) == (options.raster is None):
            raise ConfigurationError(f"{self.where}: give either rate_hz, or as raster the channel whose clock is taken")
        if options.raster is not None and options.raster not in set(self.channels) - self.gappy:
            raise ConfigurationError(f"{self.where}: raster must name one of its channels that is not gappy, not '{options.raster}'")
        if not options.files or Path(options.files).is_absolute():
            raise ConfigurationError(f"{self.where}: files must be a pattern inside path, such as '*.mf4', not '{options.files}'")

    def ids(self) -> list[str]:
        """Stems of the files, in alphabetical order."""
        return [file.stem for file in self.files()]

    def inputs(self) -> dict[str, str | Path]:
        """The files of signals."""
        return {file.name: file for file in self.files()}

    def files(self) -> list[Path]:
        """The files of signals, in alphabetical order; raises as `matching_files` does."""
        return matching_files(self.dataset, self.options.files)

    def read_raw(self, recording_id: str) -> Recording:
        """Read one file by its stem.

        Raises:
            MissingError: there is none of that name.
            DataError: it is damaged, more than the limits, lacks a signal, or its signals cannot be brought to one clock.
        """
        for file in self.files():
            if file.stem == recording_id:
                return self.read_raw_file(file)
        raise MissingError(f"{self.where} has no recording '{recording_id}' (it has {', '.join(self.ids())})")

    def read_raw_file(self, file: Path) -> Recording:
        """Read a file of signals wherever it is.

        Raises:
            MissingError: it is not there or empty.
            DataError: as `read`.
        """
        require_files([file], self.name)
        signals, provenance = self._read_signals(file)
        if self.options.file_units == "check":
            for name, signal in signals.items():
                where = self._signal_name(name, signal, file)
                require_unit(signal.unit, self.channels[name], channel(name).unit, where, "set file_units: ignore")
        grid = self._grid(signals, file)
        channels = {
            name: self.channels[name].to_si(self._on_grid(name, signal, grid, file), channel(name).unit) for name, signal in signals.items()
        }
        try:
            return Recording(
                id=file.stem,
                vehicle=str(self.dataset.get("vehicle", "unknown")),
                rate_hz=grid.rate_hz,
                start_time=float(grid.times[0]),
                channels=channels,
                kind=self.kind,
                gappy=self.gappy,
                provenance={"dataset": self.name, "source": self.dataset.get("source"), "file": file.name, **provenance},
            )
        except DataError as error:
            raise DataError(f"'{file}': {error}") from None

    @abstractmethod
    def _read_signals(self, file: Path) -> tuple[dict[str, Signal], dict[str, Any]]:
        """The signal of each channel, with stamps that pass `require_clock`, and an entry for the provenance.

        Raises:
            DataError: it is damaged, more than the limits, or lacks a signal.
        """

    def _grid(self, signals: Mapping[str, Signal], file: Path) -> Grid:
        """Ticks on which every signal that is not gappy has values."""
        spanning = {name: signal for name, signal in signals.items() if name not in self.gappy} or signals
        spans = {name: _valid_span(signal, self._signal_name(name, signal, file)) for name, signal in spanning.items()}
        late, early = max(spans, key=lambda name: spans[name][0]), min(spans, key=lambda name: spans[name][1])
        begin, end = spans[late][0], spans[early][1]
        if self.options.rate_hz is not None:
            ticks = common_ticks(begin, end, self.options.rate_hz, f"'{file}'")
        else:
            raster = signals[str(self.options.raster)]
            ticks = raster.stamps[(raster.stamps >= begin) & (raster.stamps <= end)]
        if len(ticks) < 2:
            raise DataError(
                f"'{file}': channel '{late}' ({signals[late].origin}) begins at {begin:.6g} s, channel '{early}' ("
                f"{signals[early].origin}) ends at {end:.6g} s: nothing is common to all; leave one out or declare it gappy"
            )
        if self.options.rate_hz is not None:
            return Grid(ticks, self.options.rate_hz)
        where = f"'{file}': {raster.origin}, whose clock is taken, does not come evenly"
        clock = uniform_clock(ticks, where, fix="give rate_hz instead of raster")
        return Grid(clock.ticks(), clock.rate_hz, ticks)

    def _on_grid(self, name: str, signal: Signal, grid: Grid, file: Path) -> FloatArray:
        """A signal's values at the ticks, in the file's unit."""
        declared, where, rate_hz = self.channels[name], self._signal_name(name, signal, file), signal.rate_hz
        if rate_hz > FASTER * grid.rate_hz and "aliasing" not in (self.dataset.get("accept") or []):
            raise DataError(
                f"{where} comes at {rate_hz:.6g} Hz, faster than the raster of {grid.rate_hz:.6g} Hz, into which vibrations "
                f"would fold; take that rate here and let 'vehest downsample' filter, or accept: [aliasing]"
            )
        if name in self.gappy:
            return on_nearest(signal.values, np.rint((signal.stamps - grid.times[0]) * grid.rate_hz), len(grid.times))
        near = SLACK / grid.rate_hz
        first = max(int(np.searchsorted(signal.stamps, grid.times[0] + near, side="right")) - 1, 0)
        last = int(np.searchsorted(signal.stamps, grid.times[-1] - near, side="left"))
        stamps, values = signal.stamps[first : last + 1], signal.values[first : last + 1]
        _refuse_invalid(stamps, values, where)
        _refuse_gaps(stamps, declared.max_gap or GAP / rate_hz, where)
        if grid.stamps is not None and np.array_equal(stamps, grid.stamps):
            return values
        return at_ticks(values, stamps, grid.times, hold=declared.interpolation == "hold", slack=near)

    def _signal_name(self, name: str, signal: Signal, file: Path) -> str:
        return f"'{file}': signal '{self.channels[name].column}' of {signal.origin}, for channel '{name}',"


def _valid_span(signal: Signal, where: str) -> tuple[float, float]:
    """Times of the first and last valid sample [s]."""
    valid = np.flatnonzero(~np.isnan(signal.values))
    if len(valid) == 0:
        raise DataError(f"{where} holds no valid sample; leave the channel out")
    return float(signal.stamps[valid[0]]), float(signal.stamps[valid[-1]])


def _refuse_invalid(stamps: FloatArray, values: FloatArray, where: str) -> None:
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        first, last = stamps[bad[0]], stamps[bad[-1]]
        raise DataError(
            f"{where} holds {len(bad)} samples between {first:.6g} s and {last:.6g} s that are marked invalid or are no finite numbers; "
            f"cut the range out of the measurement, or declare the channel gappy"
        )


def _refuse_gaps(stamps: FloatArray, limit: float, where: str) -> None:
    steps = np.diff(stamps)
    gaps = np.flatnonzero(steps > limit * (1.0 + SLACK))
    if len(gaps):
        longest = gaps[np.argmax(steps[gaps])]
        raise DataError(
            f"{where} is not measured for {steps[longest]:.6g} s after {stamps[longest]:.6g} s, {len(gaps)} such gaps in all "
            f"(longer than {limit:.6g} s); cut the range out, or declare max_gap if values may be interpolated over that time"
        )
