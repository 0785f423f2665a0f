"""Processes that tests start: each ends with its test, and with the process that runs the tests."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

HANGS = 900.0  # s after which a test fails; until then it waits for what happens
MOMENT = 0.02  # s between two looks
PR_SET_PDEATHSIG = 1  # of Linux's prctl
_libc = ctypes.CDLL(None)
_started = []


def start(command, **options):
    """Start a process that leads a session of its own; see `end_all`."""
    process = subprocess.Popen(list(map(str, command)), start_new_session=True, preexec_fn=_end_with_parent, **options)
    _started.append(process)
    return process


def _end_with_parent():
    _libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def end_all():
    """Kill what `start` has started, with everything in the same process groups."""
    while _started:
        with _started.pop() as process, suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def wait_for(event, process=None, said=None):
    """Wait for an event and return what it says; a process that ends before it fails the test with what it ``said``."""
    limit = time.monotonic() + HANGS
    while not (found := event()):
        assert process is None or process.poll() is None, f"it ended before the event: {(said or process.communicate)()}"
        assert time.monotonic() < limit, f"the event did not come: {said() if said else ''}"
        time.sleep(MOMENT)
    return found


def is_alive(pid):
    try:
        state = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state not in "ZX"


class Striking:
    """A function that sends its process a signal once it is through for the n-th time; keeps its arguments."""

    def __init__(self, function, call=0, number=0):
        self.function, self.call, self.number = function, call, number
        self.calls: list[tuple[Any, ...]] = []

    def __call__(self, *arguments, **options):
        result = self.function(*arguments, **options)
        self.calls.append(arguments)
        if len(self.calls) == self.call:
            os.kill(os.getpid(), self.number)
        return result
