"""Groups on the machines of a Ray cluster, or on this machine by a Ray of its own.

Ray repeats tasks that are lost with their worker or machine. Machines that share the output root work in it; to others inputs go through
Ray's object store, and artefacts return with the report.
"""

from __future__ import annotations

import logging
import os
import signal
import threading
from collections import ChainMap, deque
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from vehest.data.errors import MissingError
from vehest.run.console import Messages
from vehest.run.failures import Failure
from vehest.run.group import Group
from vehest.run.launchers.local import POLL_SECONDS, Done, Files, Reporter
from vehest.run.launchers.task import TIMES, NotShared, TaskSpec, inputs_of, new_mark, pack, run_task, task_of, unpack
from vehest.run.signals import StopSignals, TimeLimit

ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_worker_niceness": "0",  # of a Ray that is started here, as of the local launcher; Ray's own is 15
    "RAY_task_oom_retries": str(TIMES - 1),  # Ray's own is without end
}
"""Unless it is set otherwise."""


class RayLauncher:
    """Runs groups on a Ray cluster, as many at a time as there are cores.

    Args:
        address: ``auto`` for the cluster that this machine is part of; none for ``RAY_ADDRESS``, or else a Ray of its own here.
        jobs: most groups at a time; none for as many as there are cores.
        output: the output root.
        messages: prints what the cluster is.
    """

    def __init__(self, address: str | None, jobs: int | None, output: Path, messages: Messages) -> None:
        self._address = address or os.environ.get("RAY_ADDRESS") or "local"
        self._jobs, self._output, self._messages = jobs, output, messages
        self._ray: Any = None
        self._task: Any = None
        self._mark = Path()
        self._stored: dict[Path, Any] | None = None  # artefacts in Ray's object store; none while machines are taken to share the root

    @property
    def cores(self) -> int:
        """Cores of the cluster as it is now, or fewer where fewer are wanted; 1 before it is connected."""
        there = int(self._ray.cluster_resources().get("CPU", 1)) if self._ray else 1
        return min(there, self._jobs or there)

    def launch(self, groups: Sequence[Group], stop: StopSignals | TimeLimit, report: Reporter) -> Iterator[Done]:
        """See `Launcher`."""
        if stop.requested() or not groups:
            return
        if self._ray is None:
            self._connect()
        waiting, running, stopping = deque(range(len(groups))), dict[Any, int](), False
        with stop.deferred():
            while waiting or running:
                if stop.requested() and not stopping:
                    stopping = True
                    waiting.clear()
                    for task in running:
                        self._ray.cancel(task)
                while waiting and len(running) < self.cores:
                    position = waiting.popleft()
                    running[self._begin(position, groups[position])] = position
                    report(position, None)
                for task in self._ray.wait(list(running), timeout=POLL_SECONDS)[0] if running else []:
                    position = running.pop(task)
                    done = self._done(position, task)
                    if done is not None:
                        yield done
                    elif not stopping:
                        waiting.append(position)

    def close(self) -> None:
        """Leave the cluster, or end the Ray of one's own."""
        if self._ray is not None:
            self._mark.rmdir()
            self._ray.shutdown()

    def _connect(self) -> None:
        os.environ.update({name: value for name, value in ENVIRONMENT.items() if name not in os.environ})
        import ray

        own: dict[str, Any] = {"num_cpus": self._jobs, "include_dashboard": False} if self._address == "local" else {}
        handler = signal.getsignal(signal.SIGTERM)
        try:
            ray.init(address=self._address, log_to_driver=False, logging_level=logging.CRITICAL, **own)
        except Exception as error:  # ConnectionError, RuntimeError, ValueError, … by what is wrong
            hint = "start one: ray start --head, or leave --address out"
            raise MissingError(f"there is no Ray cluster at '{self._address}' ({_line(error)}); {hint}") from error
        finally:
            signal.signal(signal.SIGTERM, handler)  # Ray replaces it
        ray._private.worker.print_to_stdstream = self._print  # would go to standard output
        self._ray, self._mark = ray, new_mark(self._output)
        self._task = ray.remote(num_cpus=1, max_retries=TIMES - 1)(_run)
        n_nodes = sum(node["Alive"] for node in ray.nodes())
        machines = f"{n_nodes} machine{'s' if n_nodes > 1 else ''}, {self.cores} cores"
        self._messages.line("note", "cluster", ray.get_runtime_context().gcs_address, machines)

    def _print(self, data: Mapping[str, Any], **_: Any) -> None:
        """Print what Ray says of a lost worker or machine."""
        self._messages.line("again", "ray", str(data["lines"][0]).partition("\n")[0])

    def _begin(self, position: int, group: Group) -> Any:
        task = self._task.options(name=group.name)
        spec = task_of(position, group, self._output, self._mark)
        if self._stored is None:
            return task.remote(spec)
        inputs = inputs_of(group)
        self._stored |= {folder: self._ray.put(pack({folder})) for folder in inputs if folder not in self._stored}
        return task.remote(spec, *(self._stored[folder] for folder in inputs))

    def _done(self, position: int, task: Any) -> Done | None:
        """The outcome of a task; none if it was called off before it began, or needs copies."""
        errors = self._ray.exceptions
        try:
            done: Done = self._ray.get(task)
        except errors.TaskCancelledError:
            return None
        except errors.RayTaskError as error:
            if not isinstance(error.cause, NotShared):
                raise MissingError(f"a machine of the cluster cannot run tasks: {_line(error.cause or error)}") from error
            if self._stored is None:
                self._stored = {}
                detail = "does not share the output root: recordings and artefacts are sent"
                self._messages.line("note", "cluster", str(error.cause), detail)
            return None
        except errors.RayError as error:
            return Done(position, Failure(f"{_line(error)} ({TIMES} times; --launcher local shows what ends it)"))
        unpack(done.made)
        return done


def _run(spec: TaskSpec, *copies: Files) -> Done:
    """The task that Ray runs, and cancels by SIGINT."""
    cancelled = threading.Event()
    handler = signal.signal(signal.SIGINT, lambda *_: cancelled.set())
    try:
        return run_task(spec, ChainMap(*copies) if copies else None, cancelled.is_set)
    finally:
        signal.signal(signal.SIGINT, handler)


def _line(error: BaseException) -> str:
    return (str(error) or type(error).__name__).splitlines()[0][:200]
