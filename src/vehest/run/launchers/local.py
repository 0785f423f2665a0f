"""Runs functions in processes of this machine.

What one raises is returned as a value, and the others go on.
"""

from __future__ import annotations

import gc
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from vehest.artefacts.locks import Waiting
from vehest.data.errors import MissingError
from vehest.data.limits import Limits, current_limits, use_limits
from vehest.run.failures import Failure, failure_of
from vehest.run.signals import StopSignals, TimeLimit, blocked_signals
from vehest.training.context import Progress

if TYPE_CHECKING:
    from vehest.run.group import Group  # with torch, which processes of an ingest do without

Task = Callable[
    [Callable[[], bool], Callable[[Progress | Waiting], None]], Any
]  # a function of (should_stop, on_progress), picklable
# takes the index of a task and its progress, what it waits for, or None when it begins
Reporter = Callable[[int, Progress | Waiting | None], None]
# s for which workers are waited for at a time, and between two reports of progress
POLL_SECONDS = 0.2
READY = "ready"  # kind of a worker's message: it waits for its first task
PROGRESS = "progress"  # kind of a worker's message: progress of its task
ENDED = "ended"  # kind of a worker's message: its task returned or failed
Files = MutableMapping[Path, Mapping[str, bytes]]  # folder of an artefact -> its files


@dataclass(frozen=True)
class Done:
    """Outcome of a task, and the artefacts that it made which are not in the output root yet."""

    position: int  # index of the task
    outcome: Any  # result of the task, or a `Failure`
    # folder of an artefact -> its files, where machines do not share the output root
    made: Files = field(default_factory=dict)


@dataclass(frozen=True)
class LocalLauncher:
    """Runs groups in processes of this machine."""

    cores: int = 1  # number of processes; 1: everything runs in this process

    def launch(
        self, groups: Sequence[Group], stop: StopSignals | TimeLimit, report: Reporter
    ) -> Iterator[Done]:
        """Run groups as `launch` runs tasks, with members as outcomes; on a cluster only the begin
        of a group is reported.

        Parameters
        ----------
        groups : sequence of Group
            Run in their order.
        stop : StopSignals or TimeLimit
            Ends running groups after their batch.
        report : callable
            Takes a group's position and its progress.

        Yields
        ------
        Done
            One a group, in the order in which they end.

        Raises
        ------
        MissingError
            There is no cluster, it takes no tasks, or one of its machines cannot run them.
        """
        return launch([group.run for group in groups], self.cores, stop, report)

    def close(self) -> None:
        """Do nothing, since no resources are kept."""


def launch(
    tasks: Sequence[Task], jobs: int, stop: StopSignals | TimeLimit, report: Reporter
) -> Iterator[Done]:
    """Run tasks in their order, as many at a time as ``jobs`` says, and yield them as they end.

    Parameters
    ----------
    tasks : sequence of Task
        Picklable where there are several processes.
    jobs : int
        Processes; 1 runs everything in this one.
    stop : StopSignals or TimeLimit
        When a signal came or the time is up, running tasks are asked to end and no other is
        started.
    report : Reporter
        Called with the task's position and its progress (None when it starts), or what it waits
        for.

    Yields
    ------
    Done
        Position and outcome, a `Failure` where the task raised. Tasks that were not begun when
        ``stop`` came yield nothing.
    """
    if min(jobs, len(tasks)) > 1 and not stop.requested():
        yield from _launch_in_processes(tasks, min(jobs, len(tasks)), stop, report)
        return
    for position, task in enumerate(tasks):
        if stop.requested():
            return
        report(position, None)
        with stop.deferred():
            outcome = guarded(task, stop.requested, partial(report, position))
        yield Done(position, outcome)


def default_jobs() -> int:
    """Cores that this process may use.

    A restricted affinity is respected where the system tells it; else all cores count.
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def guarded(
    task: Task, should_stop: Callable[[], bool], on_progress: Callable[[Progress | Waiting], None]
) -> Any:
    """Run a task, and return its result, or a `Failure` for what it raises."""
    try:
        return task(should_stop, on_progress)
    except Exception as error:
        return failure_of(error)


def _launch_in_processes(
    tasks: Sequence[Task], jobs: int, stop: StopSignals | TimeLimit, report: Reporter
) -> Iterator[Done]:
    """Run tasks in worker processes, each of which runs one after another until none is left."""
    waiting = deque(enumerate(tasks))
    workers: dict[Connection, _Worker] = {}
    with stop.deferred():
        try:
            while waiting or workers:
                if stop.requested():
                    waiting.clear()
                    for worker in list(workers.values()):
                        if not worker.stop():
                            del workers[worker.connection]
                while waiting and len(workers) < jobs:
                    worker = _Worker(*waiting.popleft())
                    workers[worker.connection] = worker
                for connection in wait(list(workers), POLL_SECONDS):
                    worker = workers[cast(Connection, connection)]
                    message = worker.receive()
                    if not isinstance(message, Done):
                        report(worker.position, message)
                        continue
                    if waiting and worker.is_alive:
                        worker.begin(*waiting.popleft())
                        report(worker.position, None)
                    else:
                        worker.end()
                        del workers[worker.connection]
                    yield message
        finally:
            with blocked_signals():  # a worker that outlives this would be waited for at exit
                for worker in workers.values():
                    worker.kill()


class _Worker:
    """A process that runs one task at a time.

    Each has a pipe of its own, so that no lock is shared with one that is killed.
    """

    def __init__(self, position: int, task: Task) -> None:
        context = get_context("spawn")
        self.connection, remote_end = context.Pipe()
        self.position = position
        self.is_alive = True
        self._is_stopping = False
        self._task: Task | None = task  # until it is sent
        self._process = context.Process(target=_serve, args=(remote_end, current_limits()))
        with blocked_signals():
            self._process.start()
        remote_end.close()

    def begin(self, position: int, task: Task) -> None:
        """Send a task to a worker that waits for it."""
        self.position = position
        self._task = None
        with suppress(ConnectionError):  # it was killed, which `receive` reports
            self.connection.send(task)

    def receive(self) -> Done | Progress | Waiting | None:
        """Receive the next message of a worker: None when a task begins, its progress, or its end.
        A dead worker fails the task that it had.
        """
        try:
            kind, value = self.connection.recv()
        except (EOFError, ConnectionError):
            self._process.join()
            self.is_alive = False
            failure = Failure(
                _describe_exit(self._process.exitcode), exit_code=MissingError.exit_code
            )
            return Done(self.position, failure)
        if kind == READY:
            assert self._task is not None
            self.begin(self.position, self._task)
            return None
        progress: Progress | Waiting = value
        return progress if kind == PROGRESS else Done(self.position, value)

    def stop(self) -> bool:
        """Ask the task to end soon; returns False where it had not begun, and the process was ended
        instead.
        """
        if self._task is not None:
            self.kill()
            return False
        if not self._is_stopping:
            self._is_stopping = True
            with suppress(ConnectionError):
                self.connection.send(None)
        return True

    def end(self) -> None:
        """End a worker without a task, by a message, since one that was forked has the other end of
        the pipe as well.
        """
        with suppress(OSError):  # it was killed
            self.connection.send(None)
        self.connection.close()
        self._process.join()

    def kill(self) -> None:
        """End the process at once."""
        self._process.kill()
        self.end()


def _describe_exit(code: int | None) -> str:
    """One line on why a worker process ended, by its exit code."""
    if code is None or code >= 0:
        return f"a worker process ended unexpectedly with exit code {code}"
    name = signal.Signals(-code).name
    hint = "; if memory ran out, --jobs 1 needs less" if name == "SIGKILL" else ""
    return f"a worker process was ended by {name}{hint}; the same command goes on"


def _serve(connection: Connection, limits: Limits) -> None:
    """Main loop of a worker: run the tasks that arrive, leave signals to the parent, and end with
    it.

    Whatever arrives while a task runs, be it a message or the end of the pipe, asks the task to
    stop.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    gc.set_threshold(10_000)  # as cli.main does
    threading.Thread(target=_end_with_parent, daemon=True).start()
    last = time.monotonic()

    def on_progress(progress: Progress | Waiting) -> None:
        nonlocal last
        if isinstance(progress, Waiting) or time.monotonic() - last > POLL_SECONDS:
            last = time.monotonic()
            connection.send((PROGRESS, progress))

    with use_limits(limits), suppress(EOFError, ConnectionError):  # the parent has ended
        connection.send((READY, None))
        while (task := connection.recv()) is not None:
            connection.send((ENDED, guarded(task, connection.poll, on_progress)))


def _end_with_parent() -> None:
    """End this process when its parent has ended, even if the parent was killed."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
