"""A control unit: frames in, estimates out, and the figures of how that goes.

frames -> Sampler -> samples -> GuardedStepper -> estimates -> send
"""

from __future__ import annotations

import math
import resource
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from vehest.bus.mapping import BusSignals
from vehest.bus.sampling import Sample, Sampler, Timing
from vehest.bus.view import Figures, View
from vehest.data.errors import DataError
from vehest.sources.can import channel_values, channels_by_message
from vehest.trust.contract import GuardedStepper

MEMORY_EVERY = 100  # samples


class Receiver:
    """Takes frames off a bus, forms samples and estimates.

    Args:
        signals: of the bus.
        timing: of its messages.
        stepper: of the model, for samples at the rate of the timing.
        send: takes an estimate, as `GuardedStepper.step` returns it, the time that it holds for and the instant of its sample [s].
        view: shows it.
        now: gives the time on the bus's clock [s], so that delays behind a sample's instant count; without it the time that a sample takes.
    """

    def __init__(
        self,
        signals: BusSignals,
        timing: Timing,
        stepper: GuardedStepper,
        send: Callable[[float, float, Mapping[str, float]], None],
        view: View,
        now: Callable[[], float] | None = None,
    ) -> None:
        self.signals, self.sampler, self.stepper = signals, Sampler(timing), stepper
        self.send, self.view, self.now = send, view, now
        self.figures = Figures()
        self._channels_of = channels_by_message(signals.wanted)
        self._ahead = stepper.horizon_steps / stepper.estimator.settings.rate_hz - stepper.delay - timing.offset
        self._memory = 0  # at first [bytes]

    def frame(self, frame: Any, stamp: float) -> None:
        """Take a frame that was stamped [s]; samples whose instant lies before are dealt with first."""
        message = self.signals.database.messages.get((frame.arbitration_id, frame.is_extended_id))
        if message is None or frame.is_error_frame or frame.is_remote_frame:
            return
        self.advance(stamp)
        self.figures.frames_received += 1
        try:
            values = channel_values(message.decode(frame.data), self._channels_of[message.name], self.signals.wanted)
        except DataError:
            self.figures.frames_too_short += 1
            return
        self.sampler.take({name: value * self.signals.factors[name] for name, value in values.items()}, stamp)

    def advance(self, now: float) -> None:
        """Deal with the samples whose instant lies before now [s]."""
        while self.sampler.next_time < now:
            self._step(self.sampler.sample())

    def _step(self, sample: Sample) -> None:
        figures, cycle, started, last = self.figures, self.sampler.cycle, time.perf_counter(), self.stepper.last
        values = self.stepper.step(sample.values or None)
        if values is not last:
            figures.estimates += 1
            self.send(sample.time + self._ahead, sample.time, values)
        took = time.perf_counter() - started if self.now is None else self.now() - sample.time
        figures.seconds = figures.samples * cycle
        figures.samples += 1
        figures.latest_ms = max(figures.latest_ms, 1e3 * took)
        figures.deadlines_missed += took > cycle
        figures.samples_lost += bool(sample.missing)
        for name in sample.missing:
            figures.missing[name] = figures.missing.get(name, 0) + 1
        if figures.samples % MEMORY_EVERY == 0:
            resident = resident_bytes()
            self._memory = self._memory or resident
            figures.memory_growth_mb = max(figures.memory_growth_mb, (resident - self._memory) / 1e6)
        self.view.show(figures, values, sample.time - self.sampler.timing.first)


def resident_bytes() -> int:
    """Resident memory of this process; where the system does not tell, the most that it ever was."""
    try:
        return int(Path("/proc/self/statm").read_bytes().split()[1]) * resource.getpagesize()
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


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
