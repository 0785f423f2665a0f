"""A control unit's part: frames in, estimates out, and the figures of how that went."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from vehest.bus.mapping import BusSignals
from vehest.bus.memory import resident_bytes
from vehest.bus.sampling import Sample, Sampler
from vehest.data.errors import DataError
from vehest.trust.contract import GuardedStepper

MEMORY_EVERY = 100
"""Samples after which memory is looked at."""


@dataclass
class Figures:
    """How a replay went.

    Args:
        sent: frames of the log that were put on the bus.
        received: frames that carried wanted signals.
        short: of them, those that were shorter than the DBC says.
        samples: sampling instants.
        lost: of them, those at which a channel was missing, that is lost, late or invalid.
        missing: channel -> at how many.
        estimates: that were sent.
        latest: longest time from a sampling instant until its sample was dealt with and its estimate sent [s]; as fast as it goes the
            longest time that took.
        missed: samples for which that was longer than a cycle of the bus.
        memory_first, memory_peak: resident memory when the first samples had been dealt with, and the most since [bytes].
        seconds: on the bus's clock, from the first sample to the last.
    """

    sent: int = 0
    received: int = 0
    short: int = 0
    samples: int = 0
    lost: int = 0
    missing: dict[str, int] = field(default_factory=dict)
    estimates: int = 0
    latest: float = 0.0
    missed: int = 0
    memory_first: int = 0
    memory_peak: int = 0
    seconds: float = 0.0

    def plain(self) -> dict[str, Any]:
        """Figures for people and scripts."""
        return {
            "seconds": round(self.seconds, 3),
            "frames_sent": self.sent,
            "frames_received": self.received,
            "frames_too_short": self.short,
            "samples": self.samples,
            "samples_lost": self.lost,
            "missing": {name: count for name, count in self.missing.items() if count},
            "estimates": self.estimates,
            "latest_ms": round(1e3 * self.latest, 3),
            "deadlines_missed": self.missed,
            "memory_growth_mb": round((self.memory_peak - self.memory_first) / 1e6, 3),
        }


@dataclass(frozen=True)
class Said:
    """An estimate.

    Args:
        time: that it holds for, on the bus's clock [s].
        sampled: instant of the sample that it was made of [s].
        values: as `vehest.trust.contract.GuardedStepper.step` returns them.
    """

    time: float
    sampled: float
    values: Mapping[str, float]


class Receiver:
    """Takes frames off a bus, forms samples, estimates.

    Args:
        signals: of the bus.
        sampler: of its samples.
        stepper: of the model, for samples at the rate of the sampler.
        send: what becomes of an estimate.
        finished: now, on the bus's clock [s], to hold against the instant of a sample; None for as fast as it goes, where the time counts
            that a sample takes.
    """

    def __init__(
        self,
        signals: BusSignals,
        sampler: Sampler,
        stepper: GuardedStepper,
        send: Callable[[Said], None],
        finished: Callable[[], float] | None = None,
    ) -> None:
        self.signals, self.sampler, self.stepper = signals, sampler, stepper
        self.send, self.finished = send, finished
        self.figures = Figures(missing=dict.fromkeys(signals.wanted, 0))
        self.last_sample: Sample | None = None
        self._messages, self._channels_of = signals.database.messages, signals.messages
        horizon = stepper.horizon_steps / stepper.estimator.settings.rate_hz
        self._ahead = horizon - stepper.delay - sampler.timing.offset
        self._last: Mapping[str, float] = stepper.last

    def frame(self, frame: Any, stamp: float) -> None:
        """Take a frame that was stamped [s]; samples whose instant lies before are dealt with first."""
        message = self._messages.get((frame.arbitration_id, frame.is_extended_id))
        if message is None or frame.is_error_frame or frame.is_remote_frame:
            return
        self.advance(stamp)
        self.figures.received += 1
        try:
            values = message.decode(frame.data)
        except DataError:
            self.figures.short += 1
            return
        self.sampler.take(self.signals.samples(values, self._channels_of[message.name]), stamp)

    def advance(self, now: float) -> None:
        """Deal with the samples whose instant lies before now [s]."""
        while self.sampler.next_time < now:
            self._step(self.sampler.sample())

    def _step(self, sample: Sample) -> None:
        figures, started = self.figures, time.perf_counter()
        said = self.stepper.step(sample.values or None)
        self.last_sample = sample
        if said is not self._last:
            self._last = said
            figures.estimates += 1
            self.send(Said(sample.time + self._ahead, sample.time, said))
        took = time.perf_counter() - started if self.finished is None else self.finished() - sample.time
        figures.samples += 1
        figures.seconds += self.sampler.cycle if figures.samples > 1 else 0.0
        figures.latest = max(figures.latest, took)
        figures.missed += took > self.sampler.cycle
        if sample.missing:
            figures.lost += 1
            for name in sample.missing:
                figures.missing[name] += 1
        if figures.samples % MEMORY_EVERY == 0:
            self._look_at_memory()

    def _look_at_memory(self) -> None:
        now = resident_bytes()
        if not self.figures.memory_first:
            self.figures.memory_first = now
        self.figures.memory_peak = max(self.figures.memory_peak, now)


def warmed_up(stepper: GuardedStepper, rate_hz: float, channels: tuple[str, ...]) -> list[str]:
    """Step until everything is compiled and loaded; returns the names of what the steps returned, in their order."""
    model = stepper.estimator
    names: dict[str, None] = {}
    steps = math.ceil((model.warm_up_steps / model.settings.rate_hz + 1.0) * rate_hz)
    for k in range(steps):
        ripple = 0.01 * math.sin(0.7 * k)
        sample = {name: (20.0 if name in ("vx", "motor_speed") or name.startswith("wheel_speed") else 0.0) + ripple for name in channels}
        names |= dict.fromkeys(stepper.step(sample))
    return list(names)
