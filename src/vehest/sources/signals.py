"""Signals with times of their own, in groups of several rasters or in frames of a bus, brought to
one clock.

Which signal is which channel, and in which unit and sign, is declared in conf/dataset; a file that
contradicts it is refused.

file -> a `Signal` each channel -> ticks on which all that are not gappy have values -> channels
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from vehest.constants import FloatArray
from vehest.data.channels import channel
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import MISSING, Recording
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
from vehest.sources.columns import ChannelMap, ChannelNames, Column, Positive, Rate, RunNumber
from vehest.sources.file_source import FileSource
from vehest.sources.table_rows import Runs
from vehest.sources.unit_spellings import require_unit

GAP = 3.0  # longest gap that is interpolated where max_gap is not declared, in median intervals
MIN_COVERED = 0.5  # smallest share of a file's time that its segments must cover
# largest ratio of the rate of a signal to that of the raster; above it vibrations would alias
FASTER = 1.05


@dataclass(frozen=True)
class SignalChannel(Column):
    """Declaration of a signal that becomes a channel."""

    # hold: for values that hold until the next one
    interpolation: Literal["linear", "hold"] = "linear"
    # longest time between two samples that is interpolated [s]; None for three median intervals
    max_gap: Positive | None = None


@dataclass(frozen=True)
class Signal:
    """Samples of one signal with their times."""

    origin: str  # channel group or message of the signal, for messages: group 3 (Gateway)
    stamps: FloatArray  # times of the samples [s], strictly increasing, shape (T,)
    # physical values in the file's unit, NaN where the file marks them as invalid, shape (T,)
    values: FloatArray
    unit: str  # unit as the file writes it

    @property
    def rate_hz(self) -> float:
        """Rate behind the median interval [Hz]."""
        return float(1.0 / np.median(np.diff(self.stamps)))

    def gaps(self, max_gap: float) -> list[tuple[float, float]]:
        """Gaps between two samples that are longer than ``max_gap`` [s].

        Samples that are marked as invalid count as none.

        Returns
        -------
        list of tuple
            First and last time of each, those of the samples beside it [s].
        """
        times = self.stamps[~np.isnan(self.values)]
        first = np.flatnonzero(np.diff(times) > max_gap * (1.0 + SLACK))
        return list(zip(times[first].tolist(), times[first + 1].tolist(), strict=True))

    def missing(self, begin: float, end: float, max_gap: float) -> list[str]:
        """Lines of text on samples that a segment lacks, or that end it.

        Parameters
        ----------
        begin, end : float
            First and last time of the segment [s].
        max_gap : float
            Longest time between two samples that is interpolated [s].

        Returns
        -------
        list of str
            A line on samples inside that are marked as not measured, and one for a gap that begins
            where the segment ends.
        """
        lines = []
        unmeasured = self.stamps[np.isnan(self.values)]
        within = unmeasured[(unmeasured > begin) & (unmeasured < end)]
        if len(within):
            lines.append(
                f"{len(within)} samples that are marked as not measured, the first at "
                f"{within[0]:.6g} s, are interpolated"
            )
        slack = 1.0 / self.rate_hz
        for left, right in self.gaps(max_gap):
            if abs(left - end) <= slack:
                marked = int(((unmeasured > left) & (unmeasured < right)).sum())
                cause = f", {marked} samples of which are marked as not measured" if marked else ""
                lines.append(
                    f"a gap of {right - left:.6g} s after {left:.6g} s{cause}, ends the recording; "
                    "raise the channel's max_gap where values may be interpolated over that time"
                )
        return lines


@dataclass(frozen=True)
class SignalOptions:
    """Options of every source of signals; docs/sources/mdf.md describes them."""

    channels: ChannelMap  # channel -> its signal and unit
    path: str | None = None  # folder of the files
    files: str = "*"  # pattern of the files
    rate_hz: Rate | None = None  # rate of the recordings [Hz]
    raster: str | None = None  # channel whose samples give the clock
    # upper limit of the longest gap of every channel that is interpolated [s]
    max_gap: Positive | None = None
    run: RunNumber | None = None  # number of the one segment that is read
    gappy: ChannelNames | None = None  # channels that may have gaps
    # whether the units of the file are compared with the declared ones
    file_units: Literal["check", "ignore"] = "check"


class SignalSource(FileSource):
    """Files of signals, a recording each, or one for each part between pauses of any signal that is
    not gappy.
    """

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
                f"{self.location}: give either rate_hz, or as raster the channel whose clock is "
                "taken"
            )
        self._signals = lru_cache(1)(self._read_signals)
        if options.raster is not None and options.raster not in set(self.channels) - self.gappy:
            raise ConfigurationError(
                f"{self.location}: raster must name one of its channels that is not gappy, not "
                f"'{options.raster}'"
            )

    def runs_in(self, file: Path) -> Runs:
        """Times [s] of each segment in which no signal lacks samples for longer than its limit.

        One segment has the file's name. Limits by which most of the time would be left out, as of
        signals without a period, do not count: the reading then says which gap is too long.
        """
        require_files([file], self.name)
        pause = self.options.max_gap
        try:
            signals = self._spanning(self._signals(file)[0])
            begin, end = self._common_span(signals, file)
        except DataError:
            return super().runs_in(file)  # reading it gives the reason
        if pause is None and self.gappy.issuperset(signals):
            return super().runs_in(file)
        max_gaps = {name: self._max_gap(name, signal) for name, signal in signals.items()}
        segments = _segments(
            [gap for name, signal in signals.items() for gap in signal.gaps(max_gaps[name])],
            begin,
            end,
            pause or max(max_gaps.values()),
        )
        if sum(part.stop - part.start for part in segments) < MIN_COVERED * (end - begin):
            if pause is None:
                return super().runs_in(file)
            gaps = [gap for signal in signals.values() for gap in signal.gaps(pause)]
            segments = _segments(gaps, begin, end, pause)
        if pause is None and len(segments) == 1:
            return {None: segments[0]}
        return {**dict(enumerate(segments))}

    def _max_gap(self, name: str, signal: Signal) -> float:
        """Longest time without a sample that is interpolated [s]."""
        max_gap = self.channels[name].max_gap or GAP / signal.rate_hz
        return min(max_gap, self.options.max_gap or max_gap)

    def _spanning(self, signals: Mapping[str, Signal]) -> Mapping[str, Signal]:
        """Signals that must have samples throughout a recording: all that are not gappy, if any."""
        return {
            name: signal for name, signal in signals.items() if name not in self.gappy
        } or signals

    def _common_span(self, signals: Mapping[str, Signal], file: Path) -> tuple[float, float]:
        """First and last time at which all signals have samples [s]."""
        spans = {}
        for name, signal in signals.items():
            valid = signal.stamps[~np.isnan(signal.values)]
            if not len(valid):
                raise DataError(
                    f"{self._signal_name(name, signal, file)} holds no valid sample; leave the "
                    "channel out"
                )
            spans[f"channel '{name}' ({signal.origin})"] = float(valid[0]), float(valid[-1])
        return common_span(spans, f"'{file}'")

    def _read(self, file: Path, run: int | None) -> Recording:
        """Read a file of signals.

        Raises
        ------
        MissingError
            There is no such file, or the package that reads it is not installed.
        DataError
            It is damaged, contradicts a declared unit, or its signals leave gaps, are faster than
            the raster, or have no time in common.
        """
        signals, provenance = self._signals(file)
        number = {} if run is None else {"run": run}
        if self.options.file_units == "check":
            for name, signal in signals.items():
                location = self._signal_name(name, signal, file)
                unit = channel(name).unit
                fix = "set file_units: ignore"
                require_unit(signal.unit, self.channels[name], unit, location, fix)
        stamps, ticks, rate_hz = self._clock(signals, file, run)
        about = {key: entry for key, entry in provenance.items() if key != MISSING}
        left_out = provenance.get(MISSING, {}) if run == [*self._runs_of(file)][-1] else {}
        missing = left_out | {
            name: lines
            for name, signal in self._spanning(signals).items()
            if (lines := signal.missing(ticks[0], ticks[-1], self._max_gap(name, signal)))
        }
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
            {"file": file.name, **number, **about, **({MISSING: missing} if missing else {})},
        )

    @abstractmethod
    def _read_signals(self, file: Path) -> tuple[dict[str, Signal], dict[str, Any]]:
        """The signal of each channel, and an entry for the provenance.

        Returns
        -------
        signals : dict
            Channel -> signal, whose stamps pass `require_clock`.
        provenance : dict
            What the format says of the file, for every recording of it.
        """

    def _clock(
        self, signals: Mapping[str, Signal], file: Path, run: int | None
    ) -> tuple[FloatArray, FloatArray, float]:
        """Stamps and ticks of a recording, and its rate.

        Returns
        -------
        stamps : FloatArray
            Times at which every signal that is not gappy has values [s]: those of the raster, or
            the ticks.
        ticks : FloatArray
            The even clock behind them, of the same length, shape (T,) [s].
        rate_hz : float
            Its rate [Hz].
        """
        begin, end = self._common_span(self._spanning(signals), file)
        segment = self._runs_of(file)[run]
        if segment.start is not None:
            begin = segment.start
            end = segment.stop
        if self.options.rate_hz is not None:
            ticks = ticks_within(begin, end, self.options.rate_hz, f"'{file}'")
            return ticks, ticks, self.options.rate_hz
        raster = signals[str(self.options.raster)]
        stamps = raster.stamps[(raster.stamps >= begin) & (raster.stamps <= end)]
        location = f"'{file}': {raster.origin}, whose clock is taken, does not come evenly"
        clock = uniform_clock(stamps, location, fix="give rate_hz instead of raster")
        return stamps, clock.ticks(), clock.rate_hz

    def _at_ticks(
        self,
        name: str,
        signal: Signal,
        stamps: FloatArray,
        ticks: FloatArray,
        rate_hz: float,
        location: str,
    ) -> FloatArray:
        """A signal's values at the ticks, in the file's unit.

        As they are where its samples are those of the raster.
        """
        if signal.rate_hz > FASTER * rate_hz and "aliasing" not in (
            self.dataset.get("accept") or []
        ):
            raise DataError(
                f"{location} comes at {signal.rate_hz:.6g} Hz, faster than the raster of "
                f"{rate_hz:.6g} Hz, into which vibrations would fold; take that rate here and let "
                "'vehest downsample' filter, or accept: [aliasing]"
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
            location += f" {n_missing} samples of which are marked as not measured,"
        declared = self.channels[name]
        require_samples(values, times, self._max_gap(name, signal) * (1.0 + SLACK), location)
        if np.array_equal(times, stamps):
            return values
        return at_ticks(values, times, ticks, hold=declared.interpolation == "hold", slack=near)

    def _signal_name(self, name: str, signal: Signal, file: Path) -> str:
        """File, name, origin and channel of a signal, as the subject of a message."""
        return (
            f"'{file}': signal '{self.channels[name].column}' of {signal.origin}, for channel "
            f"'{name}',"
        )


def _segments(
    gaps: Iterable[tuple[float, float]], begin: float, end: float, min_duration: float
) -> list[slice]:
    """Times [s] from ``begin`` to ``end`` without gaps, of segments that last ``min_duration``
    [s].
    """
    segments = []
    for left, right in sorted([*gaps, (end, math.inf)]):
        if left <= end and left - begin >= min_duration:
            segments.append(slice(begin, left))
        begin = max(begin, right)
    return segments
