"""Signals with times of their own, in groups of several rasters or in frames of a bus, brought to one clock.

Which signal is which channel, and in which unit and sign, is declared in conf/dataset; a file that contradicts it is refused.

file -> a `Signal` each channel -> ticks on which all that are not gappy have values -> channels
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from vehest.constants import FloatArray
from vehest.data.channels import channel
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import Recording
from vehest.sources.base import require_files
from vehest.sources.clocks import (
    SLACK,
    Clock,
    at_ticks,
    common_span,
    on_nearest,
    require_samples,
    ticks_within,
    uniform_clock,
)
from vehest.sources.columns import ChannelMap, ChannelNames, Column, Positive, Rate
from vehest.sources.file_source import FileSource
from vehest.sources.table_rows import timed_runs
from vehest.sources.unit_spellings import require_unit

GAP = 3.0  # median intervals that are interpolated where max_gap is not declared
FASTER = 1.05  # than the raster: the rest would fold into it


@dataclass(frozen=True)
class SignalChannel(Column):
    """Declaration of a signal that becomes a channel."""

    interpolation: Literal["linear", "hold"] = (
        "linear"  # hold: for values that hold until the next one
    )
    max_gap: Positive | None = (
        None  # longest time between two samples that is interpolated [s]; None for three median intervals
    )


@dataclass(frozen=True)
class Signal:
    """One signal."""

    origin: str  # its channel group or message, for messages: group 3 (Gateway)
    stamps: FloatArray  # times of the samples [s], strictly increasing, shape (T,)
    values: FloatArray  # physical values in the file's unit, NaN where the file marks them as invalid, shape (T,)
    unit: str  # as the file writes it

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
    max_gap: Positive | None = None
    run: Annotated[int, Field(ge=0)] | None = None
    gappy: ChannelNames | None = None
    file_units: Literal["check", "ignore"] = "check"


class SignalSource(FileSource):
    """Files of signals, a recording each, or one for each part between pauses of any signal that is not gappy."""

    options_type = SignalOptions
    options: SignalOptions
    channel_type: ClassVar[type[SignalChannel]] = SignalChannel  # declaration of a channel

    def __init__(self, dataset: Mapping[str, Any]) -> None:
        super().__init__(dataset)
        self._require_pattern()
        options = self.options
        self.channels = self._declared(options.channels, self.channel_type)
        if (options.rate_hz is None) == (options.raster is None):
            raise ConfigurationError(
                f"{self.where}: give either rate_hz, or as raster the channel whose clock is taken"
            )
        self._signals = lru_cache(1)(self._read_signals)
        if options.raster is not None and options.raster not in set(self.channels) - self.gappy:
            raise ConfigurationError(
                f"{self.where}: raster must name one of its channels that is not gappy, not '{options.raster}'"
            )

    def _runs(self, file: Path) -> Mapping[int | None, slice]:
        """Rows of the times at which no signal pauses."""
        require_files([file], self.name)
        longest = self.options.max_gap
        return (
            super()._runs(file)
            if longest is None
            else timed_runs(self._covered(file, longest), longest, restarts=False)
        )

    def _covered(self, file: Path, longest: float) -> FloatArray:
        """Times of all samples [s], (T,), but for those at which one that is not gappy has no sample for longer than ``longest`` [s]."""
        signals = self._signals(file)[0]
        spanning = {name: one for name, one in signals.items() if name not in self.gappy} or signals
        known = [one.stamps[~np.isnan(one.values)] for one in spanning.values()]
        times = np.unique(np.concatenate(known))
        for stamps in known:
            edges = np.concatenate([[-np.inf], stamps, [np.inf]])
            after = np.searchsorted(edges, times)
            before = np.searchsorted(edges, times, side="right") - 1
            times = times[edges[after] - edges[before] <= longest]
        return times

    def _read(self, file: Path, run: int | None) -> Recording:
        """Read a file of signals; raises `MissingError` without it, `DataError` where it or its clocks are unusable."""
        (signals, provenance) = self._signals(file)
        number = {} if run is None else {"run": run}
        if self.options.file_units == "check":
            for name, signal in signals.items():
                where = self._signal_name(name, signal, file)
                require_unit(
                    signal.unit,
                    self.channels[name],
                    channel(name).unit,
                    where,
                    "set file_units: ignore",
                )
        stamps, ticks, rate_hz = self._clock(signals, file, run)
        channels = {}
        for name, signal in signals.items():
            values = self._at_ticks(
                name, signal, stamps, ticks, rate_hz, self._signal_name(name, signal, file)
            )
            channels[name] = self.channels[name].to_si(values, channel(name).unit)
        clock = Clock(float(ticks[0]), rate_hz, len(ticks))
        return self._recording(
            self._name_of(file, run),
            f"'{file}'",
            clock,
            channels,
            {"file": file.name, **number, **provenance},
        )

    @abstractmethod
    def _read_signals(self, file: Path) -> tuple[dict[str, Signal], dict[str, Any]]:
        """The signal of each channel, with stamps that pass `require_clock`, and an entry for the provenance."""

    def _clock(
        self, signals: Mapping[str, Signal], file: Path, run: int | None
    ) -> tuple[FloatArray, FloatArray, float]:
        """Stamps [s] at which every signal that is not gappy has values, the even clock behind them [s], and its rate [Hz]."""
        spanning = {
            name: signal for name, signal in signals.items() if name not in self.gappy
        } or signals
        spans = {}
        for name, signal in spanning.items():
            valid = signal.stamps[~np.isnan(signal.values)]
            if not len(valid):
                raise DataError(
                    f"{self._signal_name(name, signal, file)} holds no valid sample; leave the channel out"
                )
            spans[f"channel '{name}' ({signal.origin})"] = float(valid[0]), float(valid[-1])
        begin, end = common_span(spans, f"'{file}'")
        if run is not None and self.options.max_gap is not None:
            begin, *_, end = self._covered(file, self.options.max_gap)[
                self._runs_of(file)[run]
            ].tolist()
        if self.options.rate_hz is not None:
            ticks = ticks_within(begin, end, self.options.rate_hz, f"'{file}'")
            return ticks, ticks, self.options.rate_hz
        raster = signals[str(self.options.raster)]
        stamps = raster.stamps[(raster.stamps >= begin) & (raster.stamps <= end)]
        where = f"'{file}': {raster.origin}, whose clock is taken, does not come evenly"
        clock = uniform_clock(stamps, where, fix="give rate_hz instead of raster")
        return stamps, clock.ticks(), clock.rate_hz

    def _at_ticks(
        self,
        name: str,
        signal: Signal,
        stamps: FloatArray,
        ticks: FloatArray,
        rate_hz: float,
        where: str,
    ) -> FloatArray:
        """A signal's values at the ticks, in the file's unit; as they are where its samples are those of the raster."""
        if signal.rate_hz > FASTER * rate_hz and "aliasing" not in (
            self.dataset.get("accept") or []
        ):
            raise DataError(
                f"{where} comes at {signal.rate_hz:.6g} Hz, faster than the raster of {rate_hz:.6g} Hz, into which vibrations "
                f"would fold; take that rate here and let 'vehest downsample' filter, or accept: [aliasing]"
            )
        if name in self.gappy:
            return on_nearest(
                signal.values, np.rint((signal.stamps - ticks[0]) * rate_hz), len(ticks)
            )
        near = SLACK / rate_hz
        measured = ~np.isnan(signal.values)
        times = signal.stamps[measured]
        first = max(int(np.searchsorted(times, ticks[0] + near, side="right")) - 1, 0)
        last = int(np.searchsorted(times, ticks[-1] - near, side="left"))
        times = times[first : last + 1]
        values = signal.values[measured][first : last + 1]
        if n_missing := int(np.count_nonzero(~measured)):
            where += f" {n_missing} samples of which are marked as not measured,"
        declared = self.channels[name]
        require_samples(
            values, times, (declared.max_gap or GAP / signal.rate_hz) * (1.0 + SLACK), where
        )
        if np.array_equal(times, stamps):
            return values
        return at_ticks(values, times, ticks, hold=declared.interpolation == "hold", slack=near)

    def _signal_name(self, name: str, signal: Signal, file: Path) -> str:
        return f"'{file}': signal '{self.channels[name].column}' of {signal.origin}, for channel '{name}',"
