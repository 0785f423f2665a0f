"""Groups on the machines of a Ray cluster, or on this machine by a Ray of its own.

The parent keeps as few tasks under way as keep all cores busy and packs the next when one ends, by what the last ones took. Ray restarts
nothing by itself: the parent sees each death, says so, and gives what was lost to another worker, which finds what was finished by its key
and goes on from the last checkpoint.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import signal
import threading
import time
import uuid
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vehest.data.errors import MissingError, VehestError
from vehest.data.limits import current_limits
from vehest.run.console import Messages
from vehest.run.failures import Failure, failure_of
from vehest.run.group import Group, Member
from vehest.run.launcher import Done, Reporter
from vehest.run.launchers.board import Board
from vehest.run.launchers.returned import Returned
from vehest.run.launchers.store import Store
from vehest.run.launchers.times import Times, next_lot
from vehest.run.launchers.worker import Order, Report, find_like, inputs_of, mark_shared, moved, run_order, this_world
from vehest.run.signals import StopSignals, TimeLimit

LEAST_SECONDS = 10.0  # that a task should last; what it costs to hand one over is a thousandth of that
MOST_DEATHS = 3  # of workers at one group, after which the group is what kills them
MOST_LOST = 10  # of machines under one group
POLL_SECONDS = 0.2
LOOK_SECONDS = 2.0  # between two looks at which machines are there
SILENT = 4  # exchanges that fail one after another, half a minute each at most, after which the parent is gone
BEATS_A_SECOND = 200.0  # of all workers together, which the board takes with ease
OWN_RAY = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_worker_niceness": "0",  # as workers of the local launcher; Ray's own is 15
}
"""What a Ray that is started here is told, unless the environment says otherwise."""
INSTALL = "pip install 'vehest[ray]'"


@dataclass
class _Lot:
    """Groups that are one task."""

    positions: list[int]


@dataclass
class _Course:
    """Where a launch stands."""

    groups: Sequence[Group]
    waiting: deque[int]
    again: deque[_Lot] = field(default_factory=deque)
    flying: dict[Any, _Lot] = field(default_factory=dict)
    begun: set[int] = field(default_factory=set)
    deaths: Counter[int] = field(default_factory=Counter)
    losses: Counter[int] = field(default_factory=Counter)


class RayLauncher:
    """Runs groups on a Ray cluster.

    Args:
        address: of the cluster, ``auto`` for the one that this machine is part of; none for ``RAY_ADDRESS``, or else a Ray of its own here.
        jobs: most groups at a time; none for as many as there are cores.
        store: where artefacts are kept where machines share no folder.
        output: the output root.
        messages: where deaths and what is left out are said.

    Raises:
        MissingError: Ray is not installed.
    """

    def __init__(self, address: str | None, jobs: int | None, store: Store | None, output: Path, messages: Messages) -> None:
        if importlib.util.find_spec("ray") is None:
            raise MissingError(f"--launcher ray needs Ray, which is not installed: {INSTALL}")
        self._address, self._jobs, self._store, self._messages = address, jobs, store, messages
        self._output = output
        self._run = uuid.uuid4().hex[:12]
        self._ray: Any = None
        self._board: Any = None
        self._task: Any = None
        self._token = ""
        self._shunned: dict[str, str] = {}
        self._pushed: set[Path] = set()
        self._times = Times(output)
        self._returned = Returned(output, self._times, messages, self._here)
        self._there, self._seen = 1, 0.0

    @property
    def cores(self) -> int:
        """Cores of the cluster as it is now, or fewer where fewer are wanted; 1 before it is connected."""
        if self._ray is None:
            return 1
        if time.monotonic() - self._seen > LOOK_SECONDS:
            self._seen = time.monotonic()
            self._there = int(sum(node["Resources"].get("CPU", 0.0) for node in self._nodes()))
        return max(1, min(self._there, self._jobs or self._there))

    def launch(self, groups: Sequence[Group], stop: StopSignals | TimeLimit, report: Reporter) -> Iterator[Done[list[Member]]]:
        """See `Launcher`."""
        if stop.requested() or not groups:
            return
        self._connect()
        course = _Course(groups, deque(range(len(groups))))
        with stop.deferred():
            while course.waiting or course.again or course.flying:
                stopping = stop.requested()
                self._listen(stopping, course, report)
                if stopping:
                    course.waiting.clear()
                    course.again.clear()
                    self._call_off(course)
                    if not course.flying:
                        return
                else:
                    try:
                        self._hand_out(course)
                    except VehestError as error:
                        yield from self._give_up(course, str(error))
                if course.flying:
                    ready, _ = self._ray.wait(list(course.flying), timeout=POLL_SECONDS)
                    for reference in ready:
                        yield from self._ended(reference, course, report)

    def close(self) -> None:
        """Leave the cluster, or end the Ray of one's own."""
        if self._ray is not None:
            with _handlers_kept():
                self._ray.shutdown()
            self._ray = None

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
        self._prepare(ray)
        n_nodes, cores = len(self._nodes()), self.cores
        machines = f"{n_nodes} machine{'s' if n_nodes > 1 else ''}"
        self._messages.line("note", "cluster", ray.get_runtime_context().gcs_address, f"{machines}, {cores} cores")

    def _prepare(self, ray: Any) -> None:
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=True)
        self._board = ray.remote(Board).options(num_cpus=0, max_restarts=-1, max_task_retries=3, scheduling_strategy=here).remote()
        self._task = ray.remote(num_cpus=1, max_retries=0)(_run_on_ray)
        if self._store is None:
            self._token = mark_shared(self._output, self._run)

    def _nodes(self) -> list[Any]:
        return [node for node in self._ray.nodes() if node["Alive"] and node["NodeID"] not in self._shunned]

    def _listen(self, stopping: bool, course: _Course, report: Reporter) -> None:
        """Take the news of all groups, and tell all of them whether to stop."""
        with suppress(self._ray.exceptions.RayError):  # it is being restarted
            for position, news in self._ray.get(self._board.drain.remote(stopping), timeout=30):
                if position < len(course.groups):
                    course.begun.add(position)
                    report(position, news)

    def _hand_out(self, course: _Course) -> None:
        """Have as many tasks under way as keep all cores busy while the next are handed over."""
        cores = self.cores
        most = cores if self._jobs else cores + min(cores, 64)
        while len(course.flying) < most and (course.again or course.waiting):
            lot = course.again.popleft() if course.again else _Lot(self._next(course))
            try:
                course.flying[self._submitted(lot, course, cores)] = lot
            except VehestError:
                course.again.append(lot)
                raise

    def _next(self, course: _Course) -> list[int]:
        forced = any(group.force for group in course.groups)  # of which a second try would do everything anew
        return next_lot(course.waiting, lambda at: self._times.seconds_of(course.groups[at]), 0.0 if forced else LEAST_SECONDS)

    def _submitted(self, lot: _Lot, course: _Course, cores: int) -> Any:
        """Hand a task over; raises VehestError where what it reads cannot be put into the store."""
        here, root = self._output, self._output.resolve()
        groups = [(at, moved(course.groups[at], here, root)) for at in lot.positions]
        inputs = {}
        if self._store is not None:
            for at in lot.positions:
                for artefact in inputs_of(course.groups[at], here):
                    if artefact.folder not in self._pushed:
                        self._store.push(artefact)
                        self._pushed.add(artefact.folder)
                    inputs[artefact.folder] = artefact
        order = Order(
            groups=groups,
            inputs=moved(list(inputs.values()), here, root),
            output=root,
            run=self._run,
            token=self._token,
            store="" if self._store is None else self._store.address,
            world=this_world(),
            limits=current_limits(),
            beat_seconds=max(0.5, cores / BEATS_A_SECOND),
        )
        elsewhere = {"label_selector": {"ray.io/node-id": f"!in({','.join(self._shunned)})"}} if self._shunned else {}
        return self._task.options(name=course.groups[lot.positions[0]].name, **elsewhere).remote(order, self._board)

    def _ended(self, reference: Any, course: _Course, report: Reporter) -> Iterator[Done[list[Member]]]:
        """What became of a task: outcomes of its groups, or what is done about those that were lost."""
        lot = course.flying.pop(reference)
        exceptions = self._ray.exceptions
        try:
            node, told = self._ray.get(reference)
        except exceptions.TaskCancelledError:
            return
        except exceptions.RayTaskError as error:  # a defect, or what a machine lacks
            reason = str(error.cause or error).splitlines()[0]
            missing = isinstance(error.cause, ImportError)
            hint = "; install vehest and its packages on every machine of the cluster" if missing else ""
            for at in lot.positions:
                yield Done(at, Failure(f"{reason}{hint}", detail="" if missing else str(error)))
            return
        except exceptions.RayError as error:
            yield from self._lost(lot, course, error)
            return
        yield from self._reported(node, told, lot, course)

    def _reported(self, node: str, told: Report, lot: _Lot, course: _Course) -> Iterator[Done[list[Member]]]:
        done, left = self._returned.read(told, lot.positions, course.groups)
        yield from done
        if told.unsuitable and left:
            if node not in self._shunned:
                self._shunned[node] = told.unsuitable
                self._messages.line("note", "cluster", told.host, f"is left out: {told.unsuitable}")
                self._seen = 0.0
            if not self._nodes():
                yield from (
                    Done(at, Failure(f"no machine of the cluster can do it; {told.host}: {told.unsuitable}", exit_code=4)) for at in left
                )
            else:
                course.again.append(_Lot(left))

    def _lost(self, lot: _Lot, course: _Course, error: Exception) -> Iterator[Done[list[Member]]]:
        """Give what a dead worker had to others, each group by itself, so that one which kills them takes no other along."""
        exceptions = self._ray.exceptions
        of_machine = isinstance(error, exceptions.NodeDiedError | exceptions.ObjectLostError)
        why = _why(error, exceptions)
        for at in lot.positions:
            (course.losses if of_machine else course.deaths)[at] += 1
            course.begun.discard(at)
            if course.deaths[at] >= MOST_DEATHS or course.losses[at] >= MOST_LOST:
                times = course.deaths[at] + course.losses[at]
                yield Done(at, Failure(f"{why}, the {times}{'rd' if times == 3 else 'th'} time; --launcher local shows what ends it"))
            else:
                self._messages.line("again", "train", course.groups[at].name, f"{why}; it goes on elsewhere from its last checkpoint")
                course.again.append(_Lot([at]))

    def _here(self, members: list[Member]) -> list[Member] | Failure:
        """Bring what was made into this output root."""
        if self._store is None:
            return members
        try:
            for member in members:
                for artefact in (member.model, member.calibration, member.evaluation):
                    if artefact is not None and find_like(artefact) is None and self._store.fetch(artefact.stage, artefact.folder) is None:
                        raise MissingError(f"the store '{self._store.address}' lacks '{artefact.folder.name}'; run the command again")
        except Exception as error:
            return failure_of(error)
        return members

    def _call_off(self, course: _Course) -> None:
        """Take back tasks that no machine has begun."""
        for reference, lot in list(course.flying.items()):
            if not course.begun.intersection(lot.positions):
                self._ray.cancel(reference)

    def _give_up(self, course: _Course, why: str) -> Iterator[Done[list[Member]]]:
        left = [*course.waiting, *(at for lot in course.again for at in lot.positions)]
        course.waiting.clear()
        course.again.clear()
        yield from (Done(at, Failure(why, exit_code=MissingError.exit_code)) for at in left)


def _run_on_ray(order: Order, board: Any) -> tuple[str, Report]:
    """The task that Ray runs: node, and what became of the groups."""
    import ray

    failed = 0

    def exchange(news: Sequence[Any]) -> bool:
        nonlocal failed
        try:
            stopping = bool(ray.get(board.exchange.remote(news), timeout=30))
        except ray.exceptions.RayError:
            failed += 1
            return failed >= SILENT
        failed = 0
        return stopping

    node = str(ray.get_runtime_context().get_node_id())
    return node, run_order(order, exchange, node)


def _why(error: Exception, exceptions: Any) -> str:
    """What ended a worker, for people."""
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
    """Keep the logs of Ray's daemons, which it prints for each death, off the terminal; what died is said in a line of our own."""
    import ray._private.worker as driver

    if hasattr(driver, "print_to_stdstream"):
        driver.print_to_stdstream = lambda *_, **__: None
