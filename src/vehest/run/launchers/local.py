"""Runs jobs on the machine's cores; a job that fails is returned as a value and the others go on."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any, Generic, Protocol, TypeVar

from vehest.data.limits import Limits, current_limits, use_limits
from vehest.run.failures import Failure, failure_of
from vehest.run.group import Group, Member
from vehest.run.locks import Waiting
from vehest.run.signals import StopSignals, TimeLimit
from vehest.training.context import Progress

Outcome = TypeVar("Outcome", covariant=True)
PR_SET_PDEATHSIG = 1  # of Linux's prctl: the signal that a process gets when the one that started it ends


class Runnable(Protocol[Outcome]):
    """Something to run, picklable: a `Task`, or a group of trainings."""

    @property
    def name(self) -> str:
        """For people."""

    def run(self, should_stop: Callable[[], bool], on_progress: Callable[[Progress | Waiting], None]) -> Outcome:
        """Run it until it is done, or ``should_stop`` says so."""


@dataclass(frozen=True)
class Task(Generic[Outcome]):
    """A function to run.

    Args:
        name: for people.
        run: called with (should_stop, on_progress); picklable.
    """

    name: str
    run: Callable[[Callable[[], bool], Callable[[Progress | Waiting], None]], Outcome]


@dataclass(frozen=True)
class Done(Generic[Outcome]):
    """How a task ended, and how long it ran [s]."""

    position: int
    outcome: Outcome | Failure
    seconds: float = 0.0


Reporter = Callable[[int, Progress | Waiting | None], None]


class LocalLauncher:
    """Runs groups in processes of this machine.

    Args:
        jobs: processes that run side by side; 1 runs everything in this one.
    """

    def __init__(self, jobs: int = 1) -> None:
        self.cores = jobs

    def launch(self, groups: Sequence[Group], stop: StopSignals | TimeLimit, report: Reporter) -> Iterator[Done[list[Member]]]:
        """See `Launcher`."""
        return launch(groups, self.cores, stop, report)

    def close(self) -> None:
        """Nothing is kept."""


def launch(tasks: Sequence[Runnable[Outcome]], jobs: int, stop: StopSignals | TimeLimit, report: Reporter) -> Iterator[Done[Outcome]]:
    """Run tasks, as many at a time as ``jobs`` says, and yield them as they end.

    Args:
        tasks: started in this order.
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
        begun = time.monotonic()
        with stop.deferred():
            outcome = guarded(task, stop.requested, lambda progress, at=position: report(at, progress))  # type: ignore[misc]
        yield Done(position, outcome, time.monotonic() - begun)


def default_jobs() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _launch_in_processes(
    tasks: Sequence[Runnable[Outcome]], jobs: int, stop: StopSignals | TimeLimit, report: Reporter
) -> Iterator[Done[Outcome]]:
    context = get_context("spawn")
    stopping, messages = context.Event(), context.SimpleQueue()
    pool = ProcessPoolExecutor(
        jobs, mp_context=context, initializer=_start_worker, initargs=(stopping, messages, os.getpid(), current_limits())
    )
    with stop.deferred(), pool:
        futures = {pool.submit(_work, position, task): position for position, task in enumerate(tasks)}
        waiting = set(futures)
        while waiting:
            done, waiting = wait(waiting, timeout=0.2, return_when=FIRST_COMPLETED)
            while not messages.empty():
                report(*messages.get())
            if stop.requested() and not stopping.is_set():
                stopping.set()
                for future in waiting:
                    future.cancel()
            for future in done:
                if future.cancelled():
                    continue
                error = future.exception()
                failed = (Failure(f"a worker process ended unexpectedly ({error})"), 0.0)
                outcome, seconds = future.result() if error is None else failed
                if outcome is not None:
                    yield Done(futures[future], outcome, seconds)


_worker: dict[str, Any] = {}


def _start_worker(stopping: Any, messages: Any, parent: int, limits: Limits) -> None:
    """Leave signals to the parent, and end with it: at once where the system does that, else within half a second."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    _worker.update(stopping=stopping, messages=messages, limits=limits)


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def _work(position: int, task: Runnable[Outcome]) -> tuple[Outcome | Failure | None, float]:
    stopping, messages = _worker["stopping"], _worker["messages"]
    if stopping.is_set():
        return None, 0.0
    messages.put((position, None))
    last, begun = 0.0, time.monotonic()

    def on_progress(progress: Progress | Waiting) -> None:
        nonlocal last
        if isinstance(progress, Waiting) or time.monotonic() - last > 0.2:
            last = time.monotonic()
            messages.put((position, progress))

    with use_limits(_worker["limits"]):
        return guarded(task, stopping.is_set, on_progress), time.monotonic() - begun


def guarded(
    task: Runnable[Outcome], should_stop: Callable[[], bool], on_progress: Callable[[Progress | Waiting], None]
) -> Outcome | Failure:
    """Run a task; what it raises comes back as a value."""
    try:
        return task.run(should_stop, on_progress)
    except Exception as error:
        return failure_of(error)
