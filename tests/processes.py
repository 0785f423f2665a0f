"""Processes that tests start: each ends with its test, and with the process that runs the tests."""

import ctypes
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace

HANGS = 900.0  # s after which a test fails; until then it waits for what happens
MOMENT = 0.02  # s between two looks
PR_SET_PDEATHSIG = 1  # of Linux's prctl
die_with_parent = partial(ctypes.CDLL(None).prctl, PR_SET_PDEATHSIG, signal.SIGKILL)
_started = []


def start(command, **options):
    """Start a process that leads a session of its own; see `end_all`."""
    process = subprocess.Popen(
        list(map(str, command)), start_new_session=True, preexec_fn=die_with_parent, **options
    )
    _started.append(process)
    return process


def end_all():
    """Kill what `start` has started, with everything in the same process groups."""
    while _started:
        with _started.pop() as process, suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def wait_for(event, process=None, output=None):
    """Wait for an event and return what it says.

    A process that ends before it fails the test, with what it wrote, ``output``.
    """
    limit = time.monotonic() + HANGS
    while not (result := event()):
        assert process is None or process.poll() is None, (
            f"it ended before the event: {(output or process.communicate)()}"
        )
        assert time.monotonic() < limit, f"the event did not come: {output() if output else ''}"
        time.sleep(MOMENT)
    return result


def is_alive(pid):
    """Whether a process has not ended."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state not in "ZX"


def status_kb(field, pid="self"):
    """A figure of /proc/PID/status [kB]."""
    with open(f"/proc/{pid}/status", encoding="utf-8") as stream:
        return next(int(line.split()[1]) for line in stream if line.startswith(f"{field}:"))


class Striking:
    """A function that sends its process a signal once it is through for the n-th time.

    Keeps its arguments.
    """

    def __init__(self, function, call=0, number=0):
        self.function = function
        self.call = call
        self.number = number
        self.calls = []

    def __call__(self, *arguments, **options):
        result = self.function(*arguments, **options)
        self.calls.append(arguments)
        if len(self.calls) == self.call:
            os.kill(os.getpid(), self.number)
        return result


class ForkedReader:
    """The process of `vehest.sources.limited`, forked from this one: it need not import again what
    it reads with.
    """

    def __init__(self):
        order, stdin = os.pipe()
        stdout, answers = os.pipe()
        self.pid = os.fork()
        self._code = None
        if self.pid == 0:
            os.closerange(stdin, stdin + 1)
            _read_order(order, answers)
        os.close(order)
        os.close(answers)
        self.stdin = os.fdopen(stdin, "wb")
        self.stdout = os.fdopen(stdout, "rb")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.stdout.close()
        self.wait()

    def wait(self):
        """Exit status, negative for a signal."""
        if self._code is None:
            self._code = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        return self._code

    def kill(self):
        """End the process at once."""
        if self._code is None:
            os.kill(self.pid, signal.SIGKILL)


def _read_order(order, answers):
    """What the module does when it is run."""
    try:
        from vehest.sources.limited import _answer, _send

        signal.signal(signal.SIGINT, signal.SIG_IGN)
        # Open as long as the process lives.
        sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115
        with os.fdopen(order, "rb") as orders, os.fdopen(answers, "wb") as stream:
            request = json.load(orders)
            _send(
                stream,
                *_answer(request | {"memory": request["memory"] + 1024 * status_kb("VmData")}),
            )
    finally:
        os._exit(0)


def _reading_process(command, **options):
    """As `subprocess.Popen`, which it is where memory is limited, since this process has taken more
    than a new one would.
    """
    from vehest.data.limits import Limits, current_limits

    return (
        ForkedReader()
        if current_limits().memory == Limits().memory
        else subprocess.Popen(command, **options)
    )


READING = SimpleNamespace(Popen=_reading_process, PIPE=subprocess.PIPE, DEVNULL=subprocess.DEVNULL)
