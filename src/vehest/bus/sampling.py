"""Samples at even instants from frames that jitter, are lost or come late.

A sample holds, of each channel, what arrived last before its instant, if that is no older than the
channel's own period. Instants lie in the middle of the longest pause between the messages of a
cycle, so that frames may jitter by half of that before they count as late, and follow the sender's
clock, which is not the receiver's, by a phase-locked loop of first order.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError
from vehest.data.limits import check_limit
from vehest.sources.clocks import mean_step, plain_rate

# share of an arrival's deviation by which the next instant moves: a time constant of 50 samples
GAIN = 0.02
# share of a cycle by which a message's period may differ from whole cycles, for its phase to count
MAX_PERIOD_DEVIATION = 0.05
ROUND_RATE_TOLERANCE = 5e-3  # relative distance to a round rate that is assumed to be it
STAMP_TOLERANCE = 1e-9  # s, tolerance of the age at which a value is no longer fresh


@dataclass(frozen=True)
class Timing:
    """Rate and arrival times of the messages of a bus, by which the instants of samples are
    placed.
    """

    rate_hz: float  # rate of the samples [Hz]
    periods: Mapping[str, float]  # channel -> interval between its values [s]
    clock: str  # channel whose frames give the sender's clock
    offset: float  # time from the arrival of the clock's frames to the instant of the sample [s]
    start: float  # instant of the first sample [s]
    first: float = 0.0  # time of the first frame [s]


def timing_of(stamps: Mapping[str, FloatArray], rate_hz: float | None = None) -> Timing:
    """Timing of a bus from the times of its frames.

    Parameters
    ----------
    stamps : mapping
        Channel -> times of its frames [s], ascending, at least two each.
    rate_hz : float or None
        Of the samples [Hz]; by default that of the fastest channel, as a plain rate.

    Returns
    -------
    Timing
        Instants lie in the middle of the longest pause of a cycle.

    Raises
    ------
    ConfigurationError
        A rate that is no rate, or stamps that repeat.
    """
    periods = {name: mean_step(np.diff(times)) for name, times in stamps.items()}
    clock = min(periods, key=lambda name: periods[name])
    if not all(period > 0 for period in periods.values()):
        raise ConfigurationError(
            "frames of the bus repeat their time stamps; where two buses carry the same "
            "identifiers, say which"
        )
    if rate_hz is None:
        rate_hz = plain_rate(1.0 / periods[clock], ROUND_RATE_TOLERANCE)
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        raise ConfigurationError(f"the rate of a bus must be a positive number [Hz], not {rate_hz}")
    cycle = 1.0 / rate_hz
    phases = {
        name: phase
        for name, times in stamps.items()
        if (phase := _phase(times, periods[name], cycle)) is not None
    }
    marks = sorted(phases.values())
    marks += [first + cycle for first in marks[:1]]
    pauses = [(after - before, before) for before, after in pairwise(marks)]
    longest, begin = max(pauses, default=(0.0, 0.0))
    middle = (begin + 0.5 * longest) % cycle
    offset = (middle - phases[clock]) % cycle if clock in phases else 0.5 * cycle
    begins = [float(times[0]) for times in stamps.values()]
    return Timing(
        rate_hz, periods, clock, offset, max(begins) + (middle - max(begins)) % cycle, min(begins)
    )


def _phase(times: FloatArray, period: float, cycle: float) -> float | None:
    """Time within a cycle at which frames arrive [s], by their circular mean; None if they arrive
    at any time.
    """
    cycles = period / cycle
    if abs(cycles - max(round(cycles), 1)) > MAX_PERIOD_DEVIATION * max(cycles, 1.0):
        return None
    mean = complex(np.exp(2j * np.pi * (times / cycle)).mean())
    return float(np.angle(mean) / (2 * np.pi) * cycle % cycle) if abs(mean) > 0.5 else None


def check_samples(first: float, last: float, rate_hz: float, location: str) -> None:
    """Refuse, by a `DataError`, stamps [s] so far apart that too many samples lie between them.

    Parameters
    ----------
    first, last : float
        Stamps [s].
    rate_hz : float
        Of the samples [Hz].
    location : str
        Begins the error.
    """
    n_samples = (last - first) * rate_hz
    check_limit(
        "samples",
        n_samples,
        f"{location} would give {n_samples:.0f} samples from {first:.12g} s to {last:.12g} s at "
        f"{rate_hz:.6g} Hz (remove a frame with a stray stamp)",
    )


class Sample(NamedTuple):
    """Values of the channels at one instant."""

    time: float  # instant on the bus's clock [s]
    values: dict[str, float]  # channel -> fresh value [SI]
    missing: list[str]  # channels without a fresh value


class Sampler:
    """Forms samples; frames are to come in the order of their stamps.

    ``next_time`` is the instant of the next sample [s].

    Parameters
    ----------
    timing : Timing
        Rate, periods and phase of the bus.
    """

    def __init__(self, timing: Timing) -> None:
        self.timing = timing
        self.cycle = 1.0 / timing.rate_hz
        self.next_time = timing.start
        self._limits = {
            name: max(period, self.cycle) + STAMP_TOLERANCE
            for name, period in timing.periods.items()
        }
        self._values = dict.fromkeys(timing.periods, math.nan)
        self._stamps = dict.fromkeys(timing.periods, -math.inf)
        self._deviation = 0.0

    def take(self, values: Mapping[str, float], stamp: float) -> None:
        """Take what a frame carries, channel -> value [SI].

        One that was stamped before the last sample counts for the next.
        """
        for name, value in values.items():
            self._values[name] = value
            self._stamps[name] = stamp
        if self.timing.clock in values:
            half = 0.5 * self.cycle
            early = (stamp - self.next_time + self.timing.offset + half) % self.cycle - half
            self._deviation = min(max(early, -0.5 * half), 0.5 * half)

    def samples_before(self, now: float) -> Iterator[Sample]:
        """Samples whose instant lies before ``now`` [s].

        The instant of the next sample moves on with each one that is taken.

        Raises
        ------
        DataError
            The time is so far ahead that they would be more than the limits allow.
        """
        check_samples(self.next_time, now, self.timing.rate_hz, "the bus")
        while self.next_time < now:
            yield self.sample()

    def skip_to(self, stamp: float) -> None:
        """Go on with the first instant after a stamp [s], whole cycles from the next one."""
        cycles = math.ceil((stamp - self.next_time) / self.cycle)
        self.next_time += cycles * self.cycle

    def sample(self) -> Sample:
        """The sample at ``next_time``, which moves on by a cycle.

        A value is fresh for as long as its channel's period, or a cycle if that is longer; older
        ones and NaN are missing.
        """
        time = self.next_time
        fresh = {
            name: value
            for name, value in self._values.items()
            if time - self._stamps[name] <= self._limits[name] and not math.isnan(value)
        }
        self.next_time = time + self.cycle + GAIN * self._deviation
        self._deviation = 0.0
        return Sample(time, fresh, [name for name in self._values if name not in fresh])
