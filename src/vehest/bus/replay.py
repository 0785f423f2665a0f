"""A log's frames onto a bus, in real time or as fast as it goes, and a model that takes them off it."""

from __future__ import annotations

import gc
import math
import sys
import threading
import time
from array import array
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np

from vehest.bus.mapping import BusSignals
from vehest.bus.messages import FIRST_ID, EstimateFrames, check_id
from vehest.bus.outputs import Output
from vehest.bus.receiver import Figures, Receiver, Said, warmed_up
from vehest.bus.sampling import Sampler, Timing, timing_of
from vehest.bus.view import Shown, View
from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.text_files import first_line
from vehest.sources.can import decoded, is_on, never_occurs
from vehest.sources.can.logs import Frames
from vehest.trust.contract import GuardedStepper

SURVEY_SECONDS = 20.0
LEAD_SECONDS = 0.5
"""From the start of a replay in real time to its first frame."""

PATIENCE = 0.25
"""Seconds after which the receiver looks whether it is to stop."""

SWITCH_SECONDS = 2e-4
"""How long another thread of Python may go on when the receiver has something to do."""


@dataclass(frozen=True)
class Bus:
    """Where frames go.

    Args:
        interface: of python-can: ``virtual``, ``socketcan`` and others.
        channel: of that interface.
        speed: times real time; None for as fast as it goes.
        first_id: identifier of the estimates.
    """

    interface: str = "virtual"
    channel: str = "vehest"
    speed: float | None = 1.0
    first_id: int = FIRST_ID

    def __post_init__(self) -> None:
        check_id(self.first_id)
        if self.speed is not None and not (math.isfinite(self.speed) and self.speed > 0):
            raise ConfigurationError(f"--speed must be a positive number or max, not {self.speed:g}")
        if self.speed is None and self.interface != "virtual":
            raise ConfigurationError(f"as fast as it goes needs the virtual bus, not '{self.interface}'; give --speed 1")


@dataclass(frozen=True)
class Survey:
    """What a log says of its bus before it is replayed.

    Args:
        first: time of its first frame [s].
        timing: of the wanted signals.
    """

    first: float
    timing: Timing


def survey(log: Frames, signals: BusSignals, rate_hz: float | None = None) -> Survey:
    """Look at the first seconds of a log, and further on for signals that come later.

    Raises:
        DataError: it cannot be used, or a signal never occurs.
        ConfigurationError: the rate is none.
    """
    stamps = {name: array("d") for name in signals.wanted}
    first = math.nan
    for frame, values in decoded(log, signals.database, signals.wanted, signals.bus):
        first = frame.timestamp if math.isnan(first) else first
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
    return Survey(first, timing_of({name: np.array(times) for name, times in stamps.items()}, rate_hz))


def replay(
    log: Frames,
    signals: BusSignals,
    found: Survey,
    make_stepper: Callable[[], GuardedStepper],
    bus: Bus,
    make_output: Callable[[list[str]], Output],
    view: View,
    stopped: Callable[[], bool] = lambda: False,
) -> tuple[Figures, Output]:
    """Replay a log onto a bus and let a model estimate from what it takes off it.

    Args:
        log: frames to send.
        signals: of the bus that the model reads.
        found: what the log says of its bus.
        make_stepper: of the model, at the rate of the samples; called twice, since the first is for warming up.
        bus: where frames go.
        make_output: what writes estimates that hold these quantities.
        view: shown to people.
        stopped: whether to end early; what was written is kept.

    Raises:
        ConfigurationError: the log or the DBC has the identifiers of the estimates.
        MissingError: the bus cannot be opened, or an output not be written.
    """
    for identifier in (bus.first_id, bus.first_id + 1):
        if (identifier, False) in signals.database.taken:
            raise ConfigurationError(f"'{signals.database.file}' has a message {identifier:#x}, as estimates would; give another --id")
    stepper = make_stepper()
    names = warmed_up(make_stepper(), found.timing.rate_hz, tuple(signals.wanted))
    with _two_buses(bus, signals) as (sender, unit), make_output(names) as output, view:
        run = _Run(log, signals, found, stepper, bus, output, view, stopped, sender, unit)
        with _undisturbed():
            run.go()
    return run.receiver.figures, output


class _Run:
    """One replay: a sender, which is the car, and a receiver, which is the control unit."""

    def __init__(
        self,
        log: Frames,
        signals: BusSignals,
        found: Survey,
        stepper: GuardedStepper,
        bus: Bus,
        output: Output,
        view: View,
        stopped: Callable[[], bool],
        sender: Any,
        unit: Any,
    ) -> None:
        self.log, self.signals, self.first, self.bus = log, signals, found.first, bus
        self.output, self.view, self.stopped = output, view, stopped
        self.sender, self.unit = sender, unit
        self.speed = bus.speed or 1.0
        self.begin = 0.0
        self.frames_of_estimates = EstimateFrames(bus.first_id)
        finished = None if bus.speed is None else lambda: self._on_bus(time.time())
        self.receiver = Receiver(signals, Sampler(found.timing), stepper, self._send, finished)
        self.said: Said | None = None
        self.last = math.inf  # time of the last frame, once it was sent [s]
        self.failure: BaseException | None = None
        self.over = threading.Event()

    def go(self) -> None:
        """From the first frame to the last, or until it is stopped."""
        if self.bus.speed is None:
            self._as_fast_as_it_goes()
        else:
            self._in_real_time()
        self._drain_sender()
        self._show()

    def _on_bus(self, wall: float) -> float:
        """Time of the bus at a time of the clock on the wall [s]."""
        return self.first + (wall - self.begin) * self.speed

    def _frames(self) -> Iterator[Any]:
        """Frames of the log, those before the first that is wanted and those of other buses left out."""
        for frame in self.log:
            if frame.timestamp >= self.first and is_on(frame, self.signals.bus):
                yield frame

    def _as_fast_as_it_goes(self) -> None:
        last = self.first
        for frame in self._frames():
            if self.stopped():
                return
            self.sender.send(frame)
            self.receiver.figures.sent += 1
            last = frame.timestamp
            while (received := self.unit.recv(0)) is not None:
                self.receiver.frame(received, received.timestamp)
            self._drain_sender()
            self._show()
        self.receiver.advance(last + self.receiver.sampler.cycle)

    def _in_real_time(self) -> None:
        frames = self._frames()
        head = next(frames, None)  # what looks at the log beforehand has its time now
        self.begin = time.time() + LEAD_SECONDS
        thread = threading.Thread(target=self._send_in_time, args=(chain([head] if head else [], frames),), name="sender", daemon=True)
        thread.start()
        receiver, sampler = self.receiver, self.receiver.sampler
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
                self._show()
        finally:
            self.over.set()
            thread.join(timeout=5.0)
        if self.failure is not None:
            raise self.failure

    def _send_in_time(self, frames: Iterable[Any]) -> None:
        """The sender's thread: each frame at its time; between them what others sent is taken off the bus."""
        last = self.first
        try:
            for frame in frames:
                due = self.begin + (frame.timestamp - self.first) / self.speed
                while (left := due - time.time()) > 0:
                    if self.over.is_set():
                        return
                    time.sleep(min(left, PATIENCE))
                if self.over.is_set():
                    return
                self.sender.send(frame)
                self.receiver.figures.sent += 1
                last = frame.timestamp
                self._drain_sender()
        except BaseException as error:
            self.failure = error
        finally:
            self.last = last
            self.over.set()

    def _drain_sender(self) -> None:
        """What the sender hears: the estimates, whose frames are written."""
        while (heard := self.sender.recv(0)) is not None:
            if heard.arbitration_id in (self.bus.first_id, self.bus.first_id + 1) and not heard.is_extended_id:
                stamp = heard.timestamp if self.bus.speed is None else self._on_bus(heard.timestamp)
                self.output.frame(heard, stamp)

    def _send(self, said: Said) -> None:
        for frame in self.frames_of_estimates(said.values, said.sampled):
            self.unit.send(frame)
        self.output.estimate(said)
        self.said = said

    def _show(self) -> None:
        if self.view.is_due(self.receiver.figures.samples):
            self.view.show(Shown(self.receiver.figures, self.said, self.receiver.last_sample, self.first))


@contextmanager
def _two_buses(bus: Bus, signals: BusSignals) -> Iterator[tuple[Any, Any]]:
    """The sender's end of a bus, and the control unit's, which hears wanted messages only.

    Raises:
        MissingError: it cannot be opened.
    """
    try:
        import can
    except ImportError:
        raise MissingError("CAN needs the packages python-can and cantools; pip install 'vehest[bus]'") from None
    options: dict[str, Any] = {"interface": bus.interface, "channel": bus.channel}
    if bus.interface == "virtual":
        options |= {"preserve_timestamps": bus.speed is None, "ignore_config": True}
    mask = {False: 0x7FF, True: 0x1FFFFFFF}
    filters: Any = [
        {"can_id": identifier, "can_mask": mask[extended], "extended": extended} for identifier, extended in signals.database.messages
    ]
    opened: list[Any] = []
    try:
        try:
            opened.append(can.Bus(**options))
            opened.append(can.Bus(**options, can_filters=filters))
        except Exception as error:  # each interface has errors of its own
            what = f"cannot open channel '{bus.channel}' of interface '{bus.interface}' ({first_line(error)[:160]})"
            raise MissingError(f"{what}; --interface virtual needs nothing") from None
        yield opened[0], opened[1]
    finally:
        for one in opened:
            with suppress(Exception):
                one.shutdown()


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
