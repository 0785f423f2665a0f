"""What a machine of a cluster does with a task: a few groups, one after another, each as anywhere else.

A task is idempotent: what of its groups is there already, made by whomever, is found by its key and not made again. A thread beside it
tells the parent where trainings stand, learns from it whether to stop, and keeps checkpoints where another machine finds them.
"""

from __future__ import annotations

import json
import os
import platform
import resource
import socket
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass, replace
from datetime import UTC, datetime
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar

from vehest.data.errors import MissingError, VehestError
from vehest.data.files import no_room, writing_error
from vehest.data.limits import Limits, use_limits
from vehest.run.artefacts import Artefact, commit, find, library_versions, read_artefact
from vehest.run.failures import Failure, failure_of
from vehest.run.group import Group, Member, calibration_job, run_group
from vehest.run.launcher import Task, guarded
from vehest.run.launchers.store import CHECKPOINT, Store
from vehest.run.locks import Waiting
from vehest.run.train import TrainJob, code_of_training
from vehest.training.checkpoints import resume_epoch
from vehest.training.context import Progress
from vehest.version import __version__

JOURNAL = "journal"  # folder in an output root: what was begun and made by which process, a file a process
SHARED = "shared"  # in a run's journal: by which other machines know that they see the same folder
PROBE_BYTES = 1_000_000  # that a machine must have room for before it begins
DIGITS = ("numpy", "scipy", "torch", "numba")  # libraries whose version may move the last digits
Value = TypeVar("Value")
Exchange = Callable[[Sequence[tuple[int, Progress | Waiting | None]]], bool]


@dataclass(frozen=True)
class World:
    """What must be the same everywhere for results to be those of one machine.

    Args:
        code: hash of vehest's files.
        libraries: version of each of `DIGITS`, and of Python.
        cpu: type of processor, for which kernels are compiled.
    """

    code: str
    libraries: Mapping[str, str]
    cpu: str

    def differs(self, other: World) -> str:
        """Why results made there would not be those made here; empty if nothing is against it."""
        if self.code != other.code:
            return "has other code of vehest; install the same commit on every machine"
        unlike = [name for name in self.libraries if other.libraries.get(name) != self.libraries[name]]
        if unlike:
            there = ", ".join(f"{name} {other.libraries.get(name, 'missing')} instead of {self.libraries[name]}" for name in unlike)
            return f"has {there}; install the same versions on every machine"
        return ""


@dataclass(frozen=True)
class Order:
    """A task.

    Args:
        groups: position of each, and the group; its output root is the parent's, absolute.
        inputs: what they read, to be fetched where machines share no folder.
        output: that root.
        run: name of the parent's run, under which the journal stands.
        token: what the shared folder's mark says; empty where machines share none.
        store: address of the store; empty where machines share a folder.
        world: the parent's.
        limits: in force.
        beat_seconds: how often the parent hears of it [s].
    """

    groups: Sequence[tuple[int, Group]]
    inputs: Sequence[Artefact]
    output: Path
    run: str
    token: str
    store: str
    world: World
    limits: Limits
    beat_seconds: float


@dataclass(frozen=True)
class Ended:
    """How a group ended.

    Args:
        position: of the group.
        outcome: its members, or why it failed; none if it was not begun, since everything stops.
        seconds: it took [s].
    """

    position: int
    outcome: list[Member] | Failure | None
    seconds: float = 0.0


@dataclass(frozen=True)
class Report:
    """What became of a task.

    Args:
        host: name of the machine.
        cpu: its type of processor.
        ended: of the groups that ended here.
        unsuitable: why this machine cannot do the rest; empty if it did everything.
    """

    host: str
    cpu: str
    ended: Sequence[Ended]
    unsuitable: str = ""


@cache
def this_world() -> World:
    """What results depend on here."""
    versions = library_versions()
    libraries = {name: versions.get(name, "missing") for name in DIGITS} | {"python": platform.python_version()}
    return World(f"{__version__} {commit()}", libraries, _cpu())


def _cpu() -> str:
    import llvmlite.binding

    return str(llvmlite.binding.get_host_cpu_name())


def mark_shared(output: Path, run: str) -> str:
    """Leave a mark in an output root by which other machines know that they see the same folder; returns what it says.

    Raises:
        MissingError: the folder cannot be written to.
    """
    token = uuid.uuid4().hex
    mark = output.resolve() / JOURNAL / run / SHARED
    try:
        mark.parent.mkdir(parents=True, exist_ok=True)
        mark.write_text(token, encoding="utf-8")
    except OSError as error:
        raise writing_error(mark, error) from error
    return token


def run_order(order: Order, exchange: Exchange, node: str = "") -> Report:
    """Do a task.

    Args:
        order: the task.
        exchange: tells the parent of progress; returns whether to stop.
        node: what the cluster calls this machine.
    """
    host = socket.gethostname()
    store = Store(order.store) if order.store else None
    unsuitable = _unsuitable(order, store)
    if unsuitable:
        return Report(host, this_world().cpu, [], unsuitable)
    output = order.output if store is None else store.scratch / "outputs"
    journal = _Journal(output / JOURNAL / order.run, host, node)
    ended: list[Ended] = []
    with use_limits(order.limits):
        for position, given in order.groups:
            group, inputs = moved(given, order.output, output), moved(order.inputs, order.output, output)
            with _Beat(position, group, exchange, order.beat_seconds, store) as beat:
                try:
                    own = _done(position, group, inputs, beat, store, journal)
                except VehestError as error:
                    if store is not None and no_room(error) is not None:
                        return Report(host, this_world().cpu, ended, str(error))
                    own = Ended(position, failure_of(error))
                except Exception as error:
                    own = Ended(position, failure_of(error))
            ended.append(moved(own, output, order.output))
    return Report(host, this_world().cpu, ended)


def _unsuitable(order: Order, store: Store | None) -> str:
    """Why this machine cannot do a task; empty if it can."""
    differs = order.world.differs(this_world())
    if differs:
        return differs
    if store is not None:
        try:
            store.scratch.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=store.scratch) as probe:
                probe.write(b"\0" * PROBE_BYTES)
        except OSError as error:
            return f"cannot keep copies in '{store.scratch}' ({error.strerror}); free some space there, or set VEHEST_SCRATCH"
    if order.token:
        with suppress(OSError):
            if (order.output / JOURNAL / order.run / SHARED).read_text(encoding="utf-8") == order.token:
                return ""
        return f"does not see the output root '{order.output}'; mount it there under the same path, or give --store"
    return ""


def _done(position: int, group: Group, inputs: Sequence[Artefact], beat: _Beat, store: Store | None, journal: _Journal) -> Ended:
    if beat.should_stop():
        return Ended(position, None)
    begun = time.monotonic()
    _check_code(group)
    if store is not None:
        _fetch(group, inputs, store)
    journal.say("begun", group, epochs=[resume_epoch(job.plan.checkpoint_folder) for job in group.jobs])
    outcome = guarded(Task(group.name, partial(_run, group)), beat.should_stop, beat.on_progress)
    if isinstance(outcome, _NoRoomError):
        raise outcome.error
    made: list[str] = []
    if not isinstance(outcome, Failure):
        models = [member.model for member in outcome if member.model is not None]
        made = [model.key for model in models if model.status == "complete" and not model.skipped]
        if store is not None:
            _push(outcome, store)
    seconds = time.monotonic() - begun
    failed = outcome.message if isinstance(outcome, Failure) else ""
    journal.say("ended", group, made=made, seconds=round(seconds, 3), failed=failed, peak_mb=round(_peak_mb()))
    return Ended(position, outcome, seconds)


@dataclass(frozen=True)
class _NoRoomError:
    error: VehestError


def _run(group: Group, should_stop: Callable[[], bool], on_progress: Callable[[Progress | Waiting], None]) -> Any:
    """Run a group; a full disk comes back as what it is, since another machine may have room."""
    try:
        return run_group(group, should_stop, on_progress)
    except MissingError as error:
        if no_room(error) is None:
            raise
        return _NoRoomError(error)


def _check_code(group: Group) -> None:
    """Make sure that estimators are of the version that the parent has.

    Raises:
        MissingError: it is another one.
    """
    for name in {str(job.estimator["name"]) for job in group.jobs}:
        if code_of_training(name) != group.jobs[0].plan.code:
            what = f"estimator '{name}' on {socket.gethostname()} is not of the parent's version"
            raise MissingError(f"{what}; install the same on every machine")


def _fetch(group: Group, inputs: Sequence[Artefact], store: Store) -> None:
    """Bring what a group needs, and what of it is made already.

    Raises:
        MissingError: the store does not answer, or lacks what the group needs.
    """
    for artefact in inputs:
        if find_like(artefact) is None:
            found = store.fetch(artefact.stage, artefact.folder)
            if found is None or found.digest != artefact.digest:
                raise MissingError(f"the store '{store.address}' lacks '{artefact.stage}/{artefact.folder.name}'; run the command again")
    for job in group.jobs:
        model = None if "train" in group.force else find(job.plan) or store.fetch(job.plan.stage, job.plan.folder)
        if model is None or model.status != "complete":
            store.fetch_checkpoint(job.plan.checkpoint_folder)
        else:
            _fetch_what_follows(group, job, model, store)


def _fetch_what_follows(group: Group, job: TrainJob, model: Artefact, store: Store) -> None:
    calibrating = calibration_job(group, job, model)
    calibration = None
    if calibrating is not None:
        calibration = find(calibrating.plan) or store.fetch(calibrating.plan.stage, calibrating.plan.folder)
        if calibration is None:
            return
    if group.evaluation is not None:
        plan = group.evaluation.of(model, calibration).plan
        if find(plan) is None:
            store.fetch(plan.stage, plan.folder)


def inputs_of(group: Group, output: Path) -> list[Artefact]:
    """Artefacts of an output root that a group reads, each once: recordings, and the models that trainings start from.

    Raises:
        MissingError: such a model is not there.
    """
    found = {artefact.folder: artefact for job in group.jobs for artefact in job.data.values()}
    for job in group.jobs:
        start = start_of(job)
        if start is not None and start.is_relative_to(output.resolve()):
            found[start] = read_artefact(start)
    if group.evaluation is not None:
        found |= {artefact.folder: artefact for artefact in (*group.evaluation.data.values(), *group.evaluation.references.values())}
    return list(found.values())


def start_of(job: TrainJob) -> Path | None:
    """Folder of the model that a training starts from."""
    start = job.training.get("start_from")
    return None if start is None else Path(str(start))


def find_like(artefact: Artefact) -> Artefact | None:
    """The artefact in its folder, if it is there whole and the same."""
    with suppress(VehestError):
        here = read_artefact(artefact.folder)
        return here if here.digest == artefact.digest else None
    return None


def _push(members: Sequence[Member], store: Store) -> None:
    """Put there what members have, finished or stopped with their best so far; then forget what is needed no more."""
    for member in members:
        for artefact in (member.model, member.calibration, member.evaluation):
            if artefact is not None:
                store.push(artefact)
        folder = member.job.plan.checkpoint_folder
        if member.model is not None and member.model.status == "complete":
            store.drop_checkpoint(folder)
        elif (folder / CHECKPOINT).is_file():
            store.push_checkpoint(folder)


class _Beat:
    """Tells the parent of a group while it runs, and hears whether to stop; keeps checkpoints in the store."""

    def __init__(self, position: int, group: Group, exchange: Exchange, seconds: float, store: Store | None) -> None:
        self._position, self._group, self._exchange, self._seconds, self._store = position, group, exchange, seconds, store
        self._news: list[Progress | Waiting | None] = [None]
        self._kept: dict[Path, int] = {}
        self._stopping, self._over = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._go_on, daemon=True)

    def __enter__(self) -> _Beat:
        self._tell()
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._over.set()
        self._thread.join()

    def should_stop(self) -> bool:
        return self._stopping.is_set()

    def on_progress(self, progress: Progress | Waiting) -> None:
        if isinstance(progress, Progress):  # the latest alone
            self._news = [own for own in self._news if not isinstance(own, Progress)]
        self._news = [*self._news, progress]

    def _go_on(self) -> None:
        while not self._over.wait(self._seconds):
            self._tell()
            if self._store is not None:
                self._keep_checkpoints(self._store)

    def _tell(self) -> None:
        news, self._news = self._news, []
        if self._exchange([(self._position, own) for own in news]):
            self._stopping.set()

    def _keep_checkpoints(self, store: Store) -> None:
        for job in self._group.jobs:
            folder = job.plan.checkpoint_folder
            with suppress(OSError, VehestError):  # it is replaced or over; a store that is away shows when the group ends
                written = (folder / CHECKPOINT).stat().st_mtime_ns
                if self._kept.get(folder) != written:
                    store.push_checkpoint(folder)
                    self._kept[folder] = written


class _Journal:
    """What was begun and made by this process, a line each; nothing depends on it but those who want to know."""

    def __init__(self, folder: Path, host: str, node: str) -> None:
        self._file, self._node = folder / f"{host}-{os.getpid()}.jsonl", node

    def say(self, event: str, group: Group, **further: Any) -> None:
        keys = [job.plan.key for job in group.jobs]
        at = datetime.now(UTC).isoformat(timespec="milliseconds")
        line = {"at": at, "node": self._node, "event": event, "group": group.name, "keys": keys, **further}
        with suppress(OSError):
            self._file.parent.mkdir(parents=True, exist_ok=True)
            with open(self._file, "a", encoding="utf-8") as stream:
                stream.write(json.dumps(line) + "\n")


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def moved(value: Value, before: Path, after: Path) -> Value:
    """The same with every path below one folder below another instead; models to start from are paths, too."""
    return _moved(value, before, after)  # type: ignore[no-any-return]


def _moved(value: Any, before: Path, after: Path) -> Any:
    if before == after:
        return value
    if isinstance(value, Path):
        return after / value.relative_to(before) if value.is_relative_to(before) else value
    if is_dataclass(value) and not isinstance(value, type):
        changed = {}
        for field in fields(value):
            old = getattr(value, field.name)
            new = _moved(old, before, after)
            if new is not old:
                changed[field.name] = new
        return replace(value, **changed) if changed else value
    if isinstance(value, Mapping):
        new = {key: _moved_entry(key, own, before, after) for key, own in value.items()}
        return new if any(new[key] is not own for key, own in value.items()) else value
    if isinstance(value, list | tuple):
        parts = [_moved(own, before, after) for own in value]
        return type(value)(parts) if any(a is not b for a, b in zip(parts, value, strict=True)) else value
    return value


def _moved_entry(key: Any, value: Any, before: Path, after: Path) -> Any:
    if key == "start_from" and isinstance(value, str) and Path(value).is_relative_to(before):
        return str(_moved(Path(value), before, after))
    return _moved(value, before, after)
