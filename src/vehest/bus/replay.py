"""Sends a log's frames onto a bus, in real time or as fast as possible; a model takes them off it
and sends its estimates.

log -> sender -> bus -> Receiver -> estimates -> bus -> sender -> Output
"""

from __future__ import annotations

import gc
import math
import sys
import threading
import time
from array import array
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from itertools import chain, dropwhile
from pathlib import Path
from typing import Any

import numpy as np

from vehest.bus.mapping import BusSignals
from vehest.bus.messages import EstimateFrames
from vehest.bus.outputs import Output
from vehest.bus.sampling import Sample, Sampler, Timing, check_samples, timing_of
from vehest.bus.view import Figures, View
from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.text_files import first_line
from vehest.sources.can import channel_values, channels_by_message, decoded, is_on, never_occurs
from vehest.sources.can.logs import Frames
from vehest.trust.clock import RESET_SECONDS, STOPPED, SampleClock
from vehest.trust.contract import GuardedStepper

SURVEY_SECONDS = 20.0  # s of a log that are read for its timing; more until each signal came twice
LEAD_SECONDS = 0.5  # s from the start of a replay in real time to its first frame
PATIENCE = 0.25  # s, interval at which a thread looks whether it is to stop
# s, longest time for which another Python thread goes on when the receiver has something to do
SWITCH_SECONDS = 2e-4


def survey(log: Frames, signals: BusSignals, rate_hz: float | None = None) -> Timing:
    """Timing of a bus from the first seconds of a log, and from further on for signals that come
    later.

    Parameters
    ----------
    log : Frames
        The log.
    signals : BusSignals
        Signals that count.
    rate_hz : float or None
        Of the samples [Hz]; None: that of the fastest channel.

    Raises
    ------
    DataError
        The log cannot be used, a signal never occurs, stamps repeat or go back, or they span more
        samples than the limits allow.
    ConfigurationError
        The rate is none.
    """
    stamps = {name: array("d") for name in signals.by_channel}
    first = math.inf
    for frame, values in decoded(log, signals.database, signals.by_channel, signals.bus):
        first = min(first, frame.timestamp)
        for name in values:
            stamps[name].append(frame.timestamp)
        if frame.timestamp - first > SURVEY_SECONDS and all(
            len(times) > 1 for times in stamps.values()
        ):
            break
    for name, signal in signals.by_channel.items():
        if len(stamps[name]) < 2:
            raise DataError(never_occurs(log.file, name, signal, len(stamps[name]), signals.bus))
        if (np.diff(stamps[name]) <= 0).any():
            raise DataError(
                f"'{log.file}': stamps of message '{signal.message.name}' repeat or go back; "
                "where two buses carry it, name one"
            )
    timing = timing_of({name: np.array(times) for name, times in stamps.items()}, rate_hz)
    check_samples(timing.first, log.last_stamp, timing.rate_hz, f"'{log.file}'")
    return timing


@dataclass(frozen=True)
class Bus:
    """An interface of python-can and its channel, and the speed: times real time, or None for as
    fast as possible.
    """

    interface: str = "virtual"  # interface of python-can
    channel: str = "vehest"  # channel of the interface
    speed: float | None = 1.0  # speed of the replay over real time; None: as fast as possible

    @contextmanager
    def ends(self, messages: Iterable[tuple[int, bool]]) -> Iterator[tuple[Any, Any]]:
        """Context with both ends of the bus: the sender's, and the control unit's, which receives
        the given messages only.

        Raises
        ------
        MissingError
            It cannot be opened.
        """
        import can

        options: dict[str, Any] = {"interface": self.interface, "channel": self.channel}
        if self.interface == "virtual":
            options |= {"preserve_timestamps": self.speed is None, "ignore_config": True}
        mask = {False: 0x7FF, True: 0x1FFFFFFF}
        filters: Any = [
            {"can_id": identifier, "can_mask": mask[long], "extended": long}
            for identifier, long in messages
        ]
        opened: list[Any] = []
        try:
            try:
                opened.append(can.Bus(**options))
                opened.append(can.Bus(**options, can_filters=filters))
            except Exception as error:  # each interface has errors of its own
                raise MissingError(
                    f"cannot open channel '{self.channel}' of interface '{self.interface}' "
                    f"({first_line(error)[:160]}); --interface virtual needs nothing"
                ) from None
            yield opened[0], opened[1]
        finally:
            for connection in opened:
                with suppress(Exception):
                    connection.shutdown()


class Replay:
    """Replays a log's frames on a bus, as the car, and runs a control unit that estimates from the
    frames that it receives.

    The model reads ``signals``; ``frames`` writes its estimates as frames; ``stopped`` tells
    whether to end early, with what was written kept. Raises `ConfigurationError`: the DBC has the
    identifiers of the estimates.
    """

    def __init__(
        self,
        log: Frames,
        signals: BusSignals,
        timing: Timing,
        bus: Bus,
        frames: EstimateFrames,
        stopped: Callable[[], bool],
    ) -> None:
        for identifier in frames.identifiers:
            if (identifier, False) in signals.database.identifiers:
                raise ConfigurationError(
                    f"'{signals.database.file}' has a message {identifier:#x}, as estimates "
                    "would; give another --id"
                )
        self.log = log
        self.signals = signals
        self.bus = bus
        self.frames = frames
        self.stopped = stopped
        self.timing = timing
        self.first = timing.first
        self.sampler = Sampler(timing)
        self.figures = Figures()
        self.channels_of = channels_by_message(signals.by_channel)
        self.speed = bus.speed or 1.0
        self.begin = 0.0  # time of the clock on the wall at the first frame [s]
        self.last = self.first  # time of the last frame that was sent [s]
        self.clock = SampleClock(1.0 / timing.periods[timing.clock])
        self.over = threading.Event()  # all frames were sent, or it was stopped
        self.failure: BaseException | None = None

    def run(
        self,
        make_stepper: Callable[[SampleClock | None], GuardedStepper],
        out: Path | None,
        view: View,
    ) -> Figures:
        """Estimate at the rate of the samples, into ``out`` (a table or a log of frames), and
        return the figures, also of a replay that was stopped.

        ``make_stepper`` takes the clock that judges the stamps of frames; None in real time, where
        the receiver's clock stamps them. Its first stepper is for warming up.

        Raises
        ------
        DataError
            The log is damaged.
        MissingError
            The bus cannot be opened, or ``out`` not be written.
        """
        names = warmed_up(make_stepper(None), self.timing.rate_hz, tuple(self.signals.by_channel))
        self.stepper = make_stepper(self.clock if self.bus.speed is None else None)
        self.view = view
        horizon = self.stepper.horizon_steps / self.stepper.estimator.settings.rate_hz
        self.ahead = horizon - self.stepper.delay - self.timing.offset
        with (
            self.bus.ends(self.signals.database.messages) as (self.sender, self.unit),
            closing(Output(out, names, self.frames.identifiers[0])) as self.output,
            _undisturbed(),
        ):
            of_bus = (frame for frame in self.log if is_on(frame, self.signals.bus))
            frames = dropwhile(lambda frame: frame.timestamp < self.first, of_bus)
            if self.bus.speed is None:
                self._as_fast_as_possible(frames)
            else:
                self._in_real_time(frames)
            self._drain_sender()
        return self.figures

    def _as_fast_as_possible(self, frames: Iterable[Any]) -> None:
        """Send frame after frame, and let the control unit receive each at once, by the log's
        stamps.
        """
        for frame in frames:
            if self.stopped():
                return
            self._send(frame)
            while (received := self.unit.recv(0)) is not None:
                self._receive(received, received.timestamp)
        self._advance(self.last + self.sampler.cycle)

    def _in_real_time(self, frames: Iterator[Any]) -> None:
        """Receive in this thread while another sends; an error of the sender is raised at the
        end.
        """
        head = next(frames, None)  # what looks at the log beforehand has its time now
        self.begin = time.time() + LEAD_SECONDS
        all_frames = chain([head] if head else [], frames)
        thread = threading.Thread(
            target=self._send_in_time, args=(all_frames,), name="sender", daemon=True
        )
        thread.start()
        try:
            while not self.stopped():
                ended = (
                    self.over.is_set()
                    and self._on_bus(time.time()) > self.last + self.sampler.cycle
                )
                wait = self.begin + (self.sampler.next_time - self.first) / self.speed - time.time()
                received = self.unit.recv(0.0 if ended else min(max(wait, 0.0), PATIENCE))
                if received is not None:
                    self._receive(received, self._on_bus(received.timestamp))
                elif ended:  # and nothing is left that a late receiver has not taken
                    self._advance(self.last + self.sampler.cycle)
                    break
                else:
                    self._advance(self._on_bus(time.time()))
        finally:
            self.over.set()
            thread.join(timeout=5.0)
        if self.failure is not None:
            raise self.failure

    def _on_bus(self, wall: float) -> float:
        """Time on the bus [s] at a time of the wall clock [s]."""
        return self.first + (wall - self.begin) * self.speed

    # The car

    def _send_in_time(self, frames: Iterable[Any]) -> None:
        """The car's thread: each frame at its time."""
        try:
            for frame in frames:
                due = self.begin + (frame.timestamp - self.first) / self.speed
                while (left := due - time.time()) > 0 and not self.over.is_set():
                    time.sleep(min(left, PATIENCE))
                if self.over.is_set():
                    return
                self._send(frame)
        except BaseException as error:
            self.failure = error
        finally:
            self.over.set()

    def _send(self, frame: Any) -> None:
        """Put a frame of the car on the bus, and take what the control unit has sent."""
        self.sender.send(frame)
        self.figures.frames_sent += 1
        self.last = frame.timestamp
        self._drain_sender()

    def _drain_sender(self) -> None:
        """Write the frames of estimates that the car hears."""
        while (received := self.sender.recv(0)) is not None:
            if received.arbitration_id in self.frames.identifiers and not received.is_extended_id:
                if self.bus.speed is not None:
                    received.timestamp = self._on_bus(received.timestamp)
                self.output.frame(received)

    # The control unit

    def _receive(self, frame: Any, stamp: float) -> None:
        """Take a frame that was stamped [s].

        Samples whose instant lies before are dealt with first.
        """
        message = self.signals.database.messages.get((frame.arbitration_id, frame.is_extended_id))
        if message is None or frame.is_error_frame or frame.is_remote_frame:
            return
        if self.bus.speed is None and self.timing.clock in self.channels_of[message.name]:
            self._judge_clock(stamp)
        self._advance(stamp)
        self.figures.frames_received += 1
        try:
            values = channel_values(
                message.decode(frame.data), self.channels_of[message.name], self.signals.by_channel
            )
        except DataError:
            self.figures.frames_too_short += 1
            return
        self.sampler.take(
            {name: value * self.signals.factors[name] for name, value in values.items()}, stamp
        )

    def _judge_clock(self, stamp: float) -> None:
        """Take the stamp [s] of a frame of the clock's channel; samples go on where it stands still
        or jumps.

        Such frames come once a period, so that they count time while stamps stand still.
        """
        verdict = self.clock.missing_before(stamp)
        if self.figures.samples == 0:
            return
        next_time = self.sampler.next_time
        if verdict == STOPPED:
            cycles = self.timing.periods[self.timing.clock] / self.sampler.cycle
            for _ in range(max(round(cycles), 1)):
                self._deal_with(self.sampler.sample())
            self.sampler.next_time = next_time
        elif stamp >= next_time + RESET_SECONDS:
            self._advance(next_time + RESET_SECONDS)
            self.sampler.skip_to(stamp)
        elif stamp <= next_time - RESET_SECONDS:
            self.sampler.skip_to(stamp)

    def _advance(self, now: float) -> None:
        """Deal with the samples whose instant lies before now [s]."""
        for sample in self.sampler.samples_before(now):
            self._deal_with(sample)

    def _deal_with(self, sample: Sample) -> None:
        """Estimate a sample, and count it with the time that this took."""
        started = time.perf_counter()
        self._estimate(sample)
        took = (
            time.perf_counter() - started
            if self.bus.speed is None
            else self._on_bus(time.time()) - sample.time
        )
        self._count(sample, took)
        self.view.show(self.figures, self.stepper.last, sample.time - self.first)

    def _estimate(self, sample: Sample) -> None:
        """Step the model; a new estimate is sent as frames and written. A sample without any value
        is passed as None.
        """
        last = self.stepper.last
        values = self.stepper.step(sample.values or None)
        if values is not last:
            self.figures.estimates += 1
            for frame in self.frames(values, sample.time):
                self.unit.send(frame)
            self.output.estimate(sample.time + self.ahead, sample.time, values)

    def _count(self, sample: Sample, took: float) -> None:
        """Count a sample, its missing channels and, where it took longer than a cycle, a missed
        deadline.
        """
        figures = self.figures
        cycle = self.sampler.cycle
        figures.seconds = figures.samples * cycle
        figures.samples += 1
        figures.latest_ms = max(figures.latest_ms, 1e3 * took)
        figures.deadlines_missed += took > cycle
        figures.samples_lost += bool(sample.missing)
        for name in sample.missing:
            figures.missing[name] = figures.missing.get(name, 0) + 1


def warmed_up(stepper: GuardedStepper, rate_hz: float, channels: tuple[str, ...]) -> list[str]:
    """Step until everything is compiled and loaded.

    Returns the names of what the steps returned, in their order.

    Parameters
    ----------
    stepper : GuardedStepper
        Thrown away afterwards.
    rate_hz : float
        Of the samples [Hz].
    channels : tuple of str
        Channels of a sample; made-up values of a slow straight drive.
    """
    model = stepper.estimator
    names: dict[str, None] = {}
    for k in range(math.ceil((model.warm_up_steps / model.settings.rate_hz + 1.0) * rate_hz)):
        ripple = 0.01 * math.sin(0.7 * k)
        sample = {
            name: (20.0 if name in ("vx", "motor_speed") or name.startswith("wheel_speed") else 0.0)
            + ripple
            for name in channels
        }
        names |= dict.fromkeys(stepper.step(sample))
    return list(names)


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Let neither the collector of garbage nor another thread hold the receiver for long."""
    interval = sys.getswitchinterval()
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(SWITCH_SECONDS)
    try:
        yield
    finally:
        sys.setswitchinterval(interval)
        gc.unfreeze()
