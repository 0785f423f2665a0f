"""Early ends of the work: Ctrl-C and SIGTERM, after which a fit keeps the best so far and other
stages leave nothing, and a time limit.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from types import FrameType


class Stopped(BaseException):
    """Raised where a signal, whose number it has, asked vehest to stop."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.exit_code = 128 + number


class DryRunStop(Exception):
    """Raised where a dry run meets a stage that needs the result of one that has not run."""


class StopSignals:
    """Records the first SIGINT or SIGTERM.

    Raises
    ------
    Stopped
        At once, or later where a fit is to end cleanly.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self._deferred = False

    def requested(self) -> bool:
        """Whether a signal came."""
        return self.number is not None

    def raise_if_requested(self) -> None:
        """Raise `Stopped` if a signal came."""
        if self.number is not None:
            raise Stopped(self.number)

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Context that records signals, and restores the former handlers afterwards.

        Raises `Stopped` in place of an exception after a signal: compiled modules turn one into
        another, and what a signal ends may fail.

        Raises
        ------
        Stopped
            A signal came; also in place of what it made fail.
        """
        former = {
            number: signal.signal(number, self._handle)
            for number in (signal.SIGINT, signal.SIGTERM)
        }
        try:
            yield
        except Exception:
            self.raise_if_requested()
            raise
        finally:
            for number, handler in former.items():
                signal.signal(number, handler)

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """Context in which a first signal is only recorded; a second one stops at once."""
        self._deferred = True
        try:
            yield
        finally:
            self._deferred = False

    def _handle(self, number: int, frame: FrameType | None) -> None:
        """Record a signal, and raise `Stopped` unless it is the first one and deferred."""
        first = self.number is None
        self.number = self.number or number
        if not (self._deferred and first):
            raise Stopped(number)


@contextmanager
def blocked_signals() -> Iterator[None]:
    """Context in which processes can be started that leave SIGINT and SIGTERM to this one: they
    inherit that both signals are blocked.

    A handler that they install themselves comes too late for a Ctrl-C while they start.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # which unblocks both when it starts
    former = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, former)


class TimeLimit:
    """Stops on a signal, and once ``time.monotonic`` [s] has reached ``until``; None: no time
    limit.
    """

    def __init__(self, stop: StopSignals, until: float | None) -> None:
        self._stop = stop
        self._until = until
        self.deferred = stop.deferred

    def requested(self) -> bool:
        """Whether a signal came, or the time is up."""
        return self._stop.requested() or (
            self._until is not None and time.monotonic() >= self._until
        )
