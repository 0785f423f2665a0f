"""Groups on the machines of a Ray cluster, or on this machine by a Ray of its own.

The driver hands out as many tasks as keep all cores busy, a group each. A task that was lost with its worker or machine is handed out
again: it finds finished artefacts by their keys and, where machines share the output root, goes on from the last checkpoint. Where they
do not, inputs travel through Ray's object store, artefacts return with the report, and a lost task begins again.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import signal
import threading
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from vehest.data.errors import MissingError
from vehest.data.limits import current_limits
from vehest.run.console import Messages
from vehest.run.failures import Failure
from vehest.run.group import Group, Member
from vehest.run.launchers.local import Done, Reporter
from vehest.run.launchers.task import (
    News,
    TaskReport,
    TaskSpec,
    forget_mark,
    inputs_of,
    leave_mark,
    moved,
    new_run,
    pack,
    received,
    run_task,
    versions_here,
)
from vehest.run.signals import StopSignals, TimeLimit

MOST_LOST = 3  # workers at one group, after which the group is what ends them
POLL_SECONDS = 0.2
SILENT = 4  # exchanges that fail one after another, half a minute each at most, after which the driver is gone
BEATS_A_SECOND = 200.0  # of all workers together
OWN_RAY = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_worker_niceness": "0",  # as workers of the local launcher; Ray's own is 15
}
"""Environment of a Ray that is started here, unless it is set otherwise."""
INSTALL = "pip install 'vehest[ray]'"


class ProgressMailbox:
    """News of groups, until the driver takes them, and whether to stop; an actor of its own."""

    def __init__(self) -> None:
        self._news: list[tuple[int, News]] = []
        self._stopping = False

    def exchange(self, position: int, news: News) -> bool:
        """Take news of a group; returns whether to stop."""
        self._news.append((position, news))
        return self._stopping

    def drain(self, stopping: bool) -> list[tuple[int, News]]:
        """Hand the news to the driver; from now on groups are told ``stopping``."""
        self._stopping = stopping
        news, self._news = self._news, []
        return news


class RayLauncher:
    """Runs groups on a Ray cluster.

    Args:
        address: of the cluster, ``auto`` for the one that this machine is part of; none for ``RAY_ADDRESS``, or else a Ray of its own here.
        jobs: most groups at a time; none for as many as there are cores.
        output: the output root.
        messages: prints lost tasks and machines that are left out.

    Raises:
        MissingError: Ray is not installed.
    """

    def __init__(self, address: str | None, jobs: int | None, output: Path, messages: Messages) -> None:
        if importlib.util.find_spec("ray") is None:
            raise MissingError(f"--launcher ray needs Ray, which is not installed: {INSTALL}")
        self._address, self._jobs, self._output, self._messages = address, jobs, output, messages
        self._run = new_run()
        self._ray: Any = None
        self._mailbox: Any = None
        self._task: Any = None
        self._left_out: set[str] = set()
        self._packed: dict[str, Any] | None = None  # folder below the output root -> its files in Ray's object store

    @property
    def cores(self) -> int:
        """Cores of the cluster as it is now, or fewer where fewer are wanted; 1 before it is connected."""
        if self._ray is None:
            return 1
        there = int(sum(node["Resources"].get("CPU", 0.0) for node in self._nodes()))
        return max(1, min(there, self._jobs or there))

    def launch(self, groups: Sequence[Group], stop: StopSignals | TimeLimit, report: Reporter) -> Iterator[Done[list[Member]]]:
        """See `Launcher`."""
        if stop.requested() or not groups:
            return
        self._connect()
        waiting = deque(range(len(groups)))
        flying: dict[Any, int] = {}
        begun: set[int] = set()
        lost: Counter[int] = Counter()
        with stop.deferred():
            while waiting or flying:
                stopping = stop.requested()
                for position, news in self._news(stopping):
                    begun.add(position)
                    report(position, news)
                if stopping:
                    waiting.clear()
                    for reference in [own for own, position in flying.items() if position not in begun]:
                        self._ray.cancel(reference)
                while waiting and len(flying) < self.cores:
                    position = waiting.popleft()
                    flying[self._submitted(position, groups[position])] = position
                ready, _ = self._ray.wait(list(flying), timeout=POLL_SECONDS) if flying else ([], [])
                for reference in ready:
                    position = flying.pop(reference)
                    done = self._ended(reference, position, groups[position], lost)
                    if done is not None:
                        yield done
                    elif not stop.requested():
                        begun.discard(position)
                        waiting.append(position)

    def close(self) -> None:
        """Leave the cluster, or end the Ray of one's own."""
        if self._ray is not None:
            with _handlers_kept():
                self._ray.shutdown()
            self._ray = None
            forget_mark(self._output, self._run)

    def _connect(self) -> None:
        """Join the cluster, or start a Ray here.

        Raises:
            MissingError: there is none at that address, or the output root cannot be written to.
        """
        if self._ray is not None:
            return
        for name, value in OWN_RAY.items():
            os.environ.setdefault(name, value)
        import ray
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        address = self._address or os.environ.get("RAY_ADDRESS") or "local"
        own: dict[str, Any] = {"num_cpus": self._jobs, "include_dashboard": False} if address == "local" else {}
        with _handlers_kept():
            try:
                ray.init(address=address, log_to_driver=False, logging_level=logging.CRITICAL, **own)
            except Exception as error:  # ConnectionError, RuntimeError, ValueError, … by what is wrong
                words = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
                raise MissingError(
                    f"there is no Ray cluster at '{address}' ({words}); start one: ray start --head, or leave --address out"
                ) from error
        _silence()
        self._ray = ray
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=True)
        self._mailbox = (
            ray.remote(ProgressMailbox).options(num_cpus=0, max_restarts=-1, max_task_retries=3, scheduling_strategy=here).remote()
        )
        self._task = ray.remote(num_cpus=1, max_retries=0)(_run_on_ray)
        leave_mark(self._output, self._run)
        n_nodes = len(self._nodes())
        machines = f"{n_nodes} machine{'s' if n_nodes > 1 else ''}, {self.cores} cores"
        self._messages.line("note", "cluster", ray.get_runtime_context().gcs_address, machines)

    def _nodes(self) -> list[Any]:
        return [node for node in self._ray.nodes() if node["Alive"] and node["NodeID"] not in self._left_out]

    def _news(self, stopping: bool) -> list[tuple[int, News]]:
        with suppress(self._ray.exceptions.RayError):  # the mailbox is being restarted
            return list(self._ray.get(self._mailbox.drain.remote(stopping), timeout=30))
        return []

    def _submitted(self, position: int, group: Group) -> Any:
        """Hand a task out."""
        here, root = self._output, self._output.resolve()
        beat = max(0.5, self.cores / BEATS_A_SECOND)
        spec = TaskSpec(moved(group, here, root), root, self._run, versions_here(), current_limits(), beat)
        copies = {}
        if self._packed is not None:
            for name, folder in inputs_of(group, here).items():
                copies[name] = self._packed.setdefault(name, None) or self._ray.put(pack(folder))
                self._packed[name] = copies[name]
        elsewhere = {"label_selector": {"ray.io/node-id": f"!in({','.join(sorted(self._left_out))})"}} if self._left_out else {}
        return self._task.options(name=group.name, **elsewhere).remote(position, spec, copies, self._mailbox)

    def _ended(self, reference: Any, position: int, group: Group, lost: Counter[int]) -> Done[list[Member]] | None:
        """The outcome of a task; none where it is to be handed out again, or was called off."""
        exceptions = self._ray.exceptions
        try:
            node, report = self._ray.get(reference)
        except exceptions.TaskCancelledError:
            return None
        except exceptions.RayTaskError as error:  # a defect, or a package that a machine lacks
            reason = str(error.cause or error).splitlines()[0]
            if isinstance(error.cause, ImportError):
                return Done(position, Failure(f"{reason}; install vehest and its packages on every machine of the cluster"))
            return Done(position, Failure(reason, detail=str(error)))
        except exceptions.RayError as error:
            lost[position] += 1
            why = _why(error, exceptions)
            if lost[position] >= MOST_LOST:
                return Done(position, Failure(f"{why}, the {MOST_LOST}rd time; --launcher local shows what ends it"))
            how = "from its last checkpoint" if self._packed is None else "from the start"
            self._messages.line("again", "train", group.name, f"{why}; it goes on elsewhere {how}")
            return None
        return self._reported(node, report, position)

    def _reported(self, node: str, report: TaskReport, position: int) -> Done[list[Member]] | None:
        if report.apart and self._packed is None:
            self._packed = {}
            self._messages.line("note", "cluster", report.host, "does not see the output root: recordings and artefacts are sent")
        if report.unsuitable:
            if node not in self._left_out:
                self._left_out.add(node)
                self._messages.line("note", "cluster", report.host, f"is left out: {report.unsuitable}")
            if not self._nodes():
                return Done(position, Failure(f"no machine of the cluster can do it; {report.host}: {report.unsuitable}", exit_code=4))
        outcome = received(report, self._output)
        return None if outcome is None else Done(position, outcome, report.seconds)


def _run_on_ray(position: int, spec: TaskSpec, copies: dict[str, Any], mailbox: Any) -> tuple[str, TaskReport]:
    """The task that Ray runs: its node, and its report."""
    import ray

    failed = 0

    def exchange(news: News) -> bool:
        nonlocal failed
        try:
            stopping = bool(ray.get(mailbox.exchange.remote(position, news), timeout=30))
        except ray.exceptions.RayError:
            failed += 1
            return failed >= SILENT
        failed = 0
        return stopping

    found = dict(zip(copies, ray.get(list(copies.values())), strict=True))
    return str(ray.get_runtime_context().get_node_id()), run_task(spec, found, exchange)


def _why(error: Exception, exceptions: Any) -> str:
    """What ended a worker."""
    if isinstance(error, exceptions.NodeDiedError | exceptions.ObjectLostError):
        return "its machine was lost"
    if isinstance(error, exceptions.OutOfMemoryError):
        return "its worker was ended, since its machine ran out of memory"
    if isinstance(error, exceptions.WorkerCrashedError):
        return "its worker died"
    return f"its worker ended ({str(error).splitlines()[0][:200]})"


@contextmanager
def _handlers_kept() -> Iterator[None]:
    """Keep this process's own handlers of signals, which Ray replaces."""
    numbers = (signal.SIGINT, signal.SIGTERM) if threading.current_thread() is threading.main_thread() else ()
    former = {number: signal.getsignal(number) for number in numbers}
    try:
        yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


def _silence() -> None:
    """Keep the logs of Ray's daemons, which it prints for each death, off the terminal; each death has a line of our own."""
    import ray._private.worker as driver

    if hasattr(driver, "print_to_stdstream"):
        driver.print_to_stdstream = lambda *_, **__: None
