"""Runs functions in processes of this machine; what one raises is returned as a value, and the others go on."""

from __future__ import annotations

import gc
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vehest.data.limits import Limits, current_limits, use_limits
from vehest.run.failures import Failure, failure_of
from vehest.run.locks import Waiting
from vehest.run.signals import StopSignals, TimeLimit
from vehest.training.context import Progress

if TYPE_CHECKING:
    from vehest.run.group import Group  # with torch, which processes of an ingest do without

Task = Callable[
    [Callable[[], bool], Callable[[Progress | Waiting], None]], Any
]  # a function of (should_stop, on_progress), picklable
Reporter = Callable[[int, Progress | Waiting | None], None]
POLL_SECONDS = 0.2
Files = MutableMapping[Path, Mapping[str, bytes]]  # folder of an artefact -> its files


@dataclass(frozen=True)
class Done:
    """What a task returned, or why it failed, and what it made that is not in the output root yet."""

    position: int
    outcome: Any
    made: Files = field(default_factory=dict)


@dataclass(frozen=True)
class LocalLauncher:
    """Runs groups in so many processes of this machine; one runs everything in this one."""

    cores: int = 1

    def launch(
        self, groups: Sequence[Group], stop: StopSignals | TimeLimit, report: Reporter
    ) -> Iterator[Done]:
        """Run groups as `launch` runs tasks, with members as outcomes; on a cluster only the begin of a group is reported.

        Raises `MissingError` where there is no cluster, it takes no tasks, or one of its machines cannot run them.
        """
        return launch([group.run for group in groups], self.cores, stop, report)

    def close(self) -> None:
        """Nothing is kept."""


def launch(
    tasks: Sequence[Task], jobs: int, stop: StopSignals | TimeLimit, report: Reporter
) -> Iterator[Done]:
    """Run tasks in their order, as many at a time as ``jobs`` says, and yield them as they end.

    Args:
        jobs: processes; 1 runs everything in this one.
        stop: when a signal came or the time is up, running tasks are asked to end and no other is started.
        report: called with the task's position and its progress (None when it starts), or what it waits for.
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
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def guarded(
    task: Task, should_stop: Callable[[], bool], on_progress: Callable[[Progress | Waiting], None]
) -> Any:
    """Run a task; what it raises is returned as a `Failure`."""
    try:
        return task(should_stop, on_progress)
    except Exception as error:
        return failure_of(error)


def _launch_in_processes(
    tasks: Sequence[Task], jobs: int, stop: StopSignals | TimeLimit, report: Reporter
) -> Iterator[Done]:
    context = get_context("spawn")
    stopping = context.Event()
    messages = context.SimpleQueue()
    pool = ProcessPoolExecutor(jobs, context, _start_worker, (stopping, messages, current_limits()))
    with stop.deferred(), pool:
        futures = {
            pool.submit(_work, position, task): position for position, task in enumerate(tasks)
        }
        waiting = set(futures)
        while waiting:
            ended, waiting = wait(waiting, POLL_SECONDS, FIRST_COMPLETED)
            while not messages.empty():
                report(*messages.get())
            if stop.requested():
                stopping.set()
                for future in waiting:
                    future.cancel()
            for future in ended:
                error = None if future.cancelled() else future.exception()
                if error is not None:
                    yield Done(
                        futures[future], Failure(f"a worker process ended unexpectedly ({error})")
                    )
                elif not future.cancelled() and (done := future.result()) is not None:
                    yield done


_worker: dict[str, Any] = {}


def _start_worker(stopping: Any, messages: Any, limits: Limits) -> None:
    """Leave signals to the parent, and end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    gc.set_threshold(10_000)  # as cli.main does
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _worker.update(stopping=stopping, messages=messages, limits=limits)


def _end_with_parent() -> None:
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _work(position: int, task: Task) -> Done | None:
    """Run a task in a worker; none if it was stopped before it began."""
    stopping = _worker["stopping"]
    messages = _worker["messages"]
    if stopping.is_set():
        return None
    messages.put((position, None))
    last = time.monotonic()

    def on_progress(progress: Progress | Waiting) -> None:
        nonlocal last
        if isinstance(progress, Waiting) or time.monotonic() - last > POLL_SECONDS:
            last = time.monotonic()
            messages.put((position, progress))

    with use_limits(_worker["limits"]):
        return Done(position, guarded(task, stopping.is_set, on_progress))
