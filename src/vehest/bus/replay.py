"""Sends a log's frames onto a bus, in real time or as fast as possible; a model takes them off it and sends its estimates.

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
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from vehest.bus.mapping import BusSignals
from vehest.bus.messages import EstimateFrames
from vehest.bus.outputs import Output
from vehest.bus.receiver import Receiver, warmed_up
from vehest.bus.sampling import Timing, timing_of
from vehest.bus.view import Figures, View
from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.text_files import first_line
from vehest.sources.can import decoded, is_on, never_occurs
from vehest.sources.can.logs import Frames
from vehest.trust.contract import GuardedStepper

SURVEY_SECONDS = 20.0
LEAD_SECONDS = 0.5  # from the start of a replay in real time to its first frame
PATIENCE = 0.25  # s, after which a thread looks whether it is to stop
SWITCH_SECONDS = 2e-4  # that another thread of Python may go on when the receiver has something to do


def survey(log: Frames, signals: BusSignals, rate_hz: float | None = None) -> Timing:
    """Timing of a bus from the first seconds of a log, and from further on for signals that come later.

    Raises:
        DataError: it cannot be used, or a signal never occurs.
        ConfigurationError: the rate is none.
    """
    stamps = {name: array("d") for name in signals.wanted}
    first = math.inf
    for frame, values in decoded(log, signals.database, signals.wanted, signals.bus):
        first = min(first, frame.timestamp)
        for name in values:
            stamps[name].append(frame.timestamp)
        if frame.timestamp - first > SURVEY_SECONDS and all(len(times) > 1 for times in stamps.values()):
            break
    for name, wanted in signals.wanted.items():
        if len(stamps[name]) < 2:
            raise DataError(never_occurs(log.file, name, wanted, len(stamps[name]), signals.bus))
        if (np.diff(stamps[name]) <= 0).any():
            raise DataError(
                f"'{log.file}': stamps of message '{wanted.message.name}' repeat or go back; where two buses carry it, name one"
            )
    return timing_of({name: np.array(times) for name, times in stamps.items()}, rate_hz)


@dataclass(frozen=True)
class Bus:
    """An interface of python-can and its channel, and the speed: times real time, or None for as fast as possible."""

    interface: str = "virtual"
    channel: str = "vehest"
    speed: float | None = 1.0

    @contextmanager
    def ends(self, messages: Iterable[tuple[int, bool]]) -> Iterator[tuple[Any, Any]]:
        """The sender's end of the bus, and the control unit's, which hears the messages only.

        Raises:
            MissingError: it cannot be opened.
        """
        import can

        options: dict[str, Any] = {"interface": self.interface, "channel": self.channel}
        if self.interface == "virtual":
            options |= {"preserve_timestamps": self.speed is None, "ignore_config": True}
        mask = {False: 0x7FF, True: 0x1FFFFFFF}
        filters: Any = [{"can_id": identifier, "can_mask": mask[long], "extended": long} for identifier, long in messages]
        opened: list[Any] = []
        try:
            try:
                opened.append(can.Bus(**options))
                opened.append(can.Bus(**options, can_filters=filters))
            except Exception as error:  # each interface has errors of its own
                what = f"cannot open channel '{self.channel}' of interface '{self.interface}' ({first_line(error)[:160]})"
                raise MissingError(f"{what}; --interface virtual needs nothing") from None
            yield opened[0], opened[1]
        finally:
            for one in opened:
                with suppress(Exception):
                    one.shutdown()


class Replay:
    """A log, replayed onto a bus.

    Args:
        log: frames to send.
        signals: of the bus that the model reads.
        timing: of the log.
        bus: where frames go.
        frames: writes estimates as frames.
        stopped: whether to end early; what was written is kept.

    Raises:
        ConfigurationError: the DBC has the identifiers of the estimates.
    """

    def __init__(
        self, log: Frames, signals: BusSignals, timing: Timing, bus: Bus, frames: EstimateFrames, stopped: Callable[[], bool]
    ) -> None:
        for identifier in frames.identifiers:
            if (identifier, False) in signals.database.taken:
                raise ConfigurationError(f"'{signals.database.file}' has a message {identifier:#x}, as estimates would; give another --id")
        self.log, self.signals, self.timing, self.bus, self.frames, self.stopped = log, signals, timing, bus, frames, stopped
        self.first, self.speed = timing.first, bus.speed or 1.0
        self.begin = 0.0  # time of the clock on the wall at the first frame [s]
        self.last = math.inf  # time of the last frame, once it was sent [s]
        self.failure: BaseException | None = None
        self.over = threading.Event()

    def run(self, make_stepper: Callable[[], GuardedStepper], out: Path | None, view: View) -> Figures:
        """Estimate from the frames; the first stepper is for warming up.

        Raises:
            DataError: the log is damaged.
            MissingError: the bus cannot be opened, or ``out`` not be written.
        """
        names = warmed_up(make_stepper(), self.timing.rate_hz, tuple(self.signals.wanted))
        with (
            self.bus.ends(self.signals.database.messages) as (self.sender, self.unit),
            closing(Output(out, names, self.frames.identifiers[0])) as self.output,
            view,
            _undisturbed(),
        ):
            now = None if self.bus.speed is None else lambda: self._on_bus(time.time())
            receiver = Receiver(self.signals, self.timing, make_stepper(), self._send, view, now)
            if self.bus.speed is None:
                self._as_fast_as_possible(receiver)
            else:
                self._in_real_time(receiver)
            self._drain_sender()
        return receiver.figures

    def _on_bus(self, wall: float) -> float:
        """Time of the bus at a time of the clock on the wall [s]."""
        return self.first + (wall - self.begin) * self.speed

    def _frames(self) -> Iterator[Any]:
        """Frames of the log, those before the first that is wanted and those of other buses left out."""
        return (frame for frame in self.log if frame.timestamp >= self.first and is_on(frame, self.signals.bus))

    def _as_fast_as_possible(self, receiver: Receiver) -> None:
        last = self.first
        for frame in self._frames():
            if self.stopped():
                return
            self.sender.send(frame)
            receiver.figures.frames_sent += 1
            last = frame.timestamp
            while (received := self.unit.recv(0)) is not None:
                receiver.frame(received, received.timestamp)
            self._drain_sender()
        receiver.advance(last + receiver.sampler.cycle)

    def _in_real_time(self, receiver: Receiver) -> None:
        frames = self._frames()
        head = next(frames, None)  # what looks at the log beforehand has its time now
        self.begin = time.time() + LEAD_SECONDS
        given = (chain([head] if head else [], frames), receiver.figures)
        thread = threading.Thread(target=self._send_in_time, args=given, name="sender", daemon=True)
        thread.start()
        sampler = receiver.sampler
        try:
            while not self.stopped():
                ended = self.over.is_set() and self._on_bus(time.time()) > self.last + sampler.cycle
                wait = self.begin + (sampler.next_time - self.first) / self.speed - time.time()
                frame = self.unit.recv(0.0 if ended else min(max(wait, 0.0), PATIENCE))
                if frame is not None:
                    receiver.frame(frame, self._on_bus(frame.timestamp))
                elif ended:  # and nothing is left that a late receiver has not taken
                    receiver.advance(self.last + sampler.cycle)
                    break
                else:
                    receiver.advance(self._on_bus(time.time()))
        finally:
            self.over.set()
            thread.join(timeout=5.0)
        if self.failure is not None:
            raise self.failure

    def _send_in_time(self, frames: Iterable[Any], figures: Figures) -> None:
        """The sender's thread: each frame at its time; between them estimates are taken off the bus."""
        last = self.first
        try:
            for frame in frames:
                due = self.begin + (frame.timestamp - self.first) / self.speed
                while (left := due - time.time()) > 0 and not self.over.is_set():
                    time.sleep(min(left, PATIENCE))
                if self.over.is_set():
                    return
                self.sender.send(frame)
                figures.frames_sent += 1
                last = frame.timestamp
                self._drain_sender()
        except BaseException as error:
            self.failure = error
        finally:
            self.last = last
            self.over.set()

    def _drain_sender(self) -> None:
        """Write the frames of estimates that the sender hears."""
        while (heard := self.sender.recv(0)) is not None:
            if heard.arbitration_id in self.frames.identifiers and not heard.is_extended_id:
                if self.bus.speed is not None:
                    heard.timestamp = self._on_bus(heard.timestamp)
                self.output.frame(heard)

    def _send(self, held: float, sampled: float, values: Any) -> None:
        for frame in self.frames(values, sampled):
            self.unit.send(frame)
        self.output.estimate(held, sampled, values)


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
