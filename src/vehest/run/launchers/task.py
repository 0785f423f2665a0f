"""A group as a task of a cluster: done as on this machine, found again by its keys, so that a second try makes nothing twice.

TaskSpec -> same versions? same folder? -> `Group.run` in the driver's output root, or in a scratch folder with copies -> TaskReport
"""

from __future__ import annotations

import platform
import shutil
import socket
import tempfile
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from vehest.data.errors import VehestError
from vehest.data.files import remove_leftovers, writing_error, written_aside
from vehest.data.limits import Limits, use_limits
from vehest.run.artefacts import Artefact, commit, library_versions, read_artefact
from vehest.run.failures import Failure, failure_of
from vehest.run.group import Group, Member, existing
from vehest.run.launchers.local import guarded
from vehest.run.locks import Waiting
from vehest.training.context import Progress
from vehest.version import __version__

MARKS = "clusters"  # folder in an output root with a file a run, by which other machines know that they see the same folder
Files = Mapping[str, bytes]
News = Progress | Waiting | None
Value = TypeVar("Value")


@dataclass(frozen=True)
class TaskSpec:
    """A group to run.

    Args:
        group: with its output root as ``output``.
        output: the driver's output root, absolute.
        run: name of the driver's run, whose mark ``output`` holds.
        versions: of vehest and of its libraries at the driver (`versions_here`).
        limits: in force.
        beat_seconds: between two looks for news [s].
    """

    group: Group
    output: Path
    run: str
    versions: Mapping[str, str]
    limits: Limits
    beat_seconds: float


@dataclass(frozen=True)
class TaskReport:
    """The end of a task.

    Args:
        host: name of the machine.
        outcome: members, or why the group failed; none if it was not begun.
        seconds: it took [s].
        unsuitable: why this machine cannot do it; empty if it can.
        apart: whether this machine does not see the output root and was given no copies.
        files: folder below the output root -> files of an artefact, where the machine does not see the output root.
    """

    host: str
    outcome: list[Member] | Failure | None = None
    seconds: float = 0.0
    unsuitable: str = ""
    apart: bool = False
    files: Mapping[str, Files] = field(default_factory=dict)


def versions_here() -> dict[str, str]:
    """What must be the same everywhere for results to be those of one machine."""
    return {"vehest": f"{__version__} {commit()}".strip(), "python": platform.python_version(), **library_versions()}


def leave_mark(output: Path, run: str) -> None:
    """Leave a file in an output root by which other machines know that they see the same folder.

    Raises:
        MissingError: the folder cannot be written to.
    """
    mark = output / MARKS / run
    try:
        mark.parent.mkdir(parents=True, exist_ok=True)
        mark.write_text("", encoding="utf-8")
    except OSError as error:
        raise writing_error(mark, error) from error


def new_run() -> str:
    """A name for a driver's run that no other has."""
    return uuid.uuid4().hex[:12]


def inputs_of(group: Group, output: Path) -> dict[str, Path]:
    """Artefacts that a group reads, or of which it has some already: folder below the output root -> folder."""
    found: list[Artefact | None] = [artefact for job in group.jobs for artefact in job.data.values()]
    if group.evaluation is not None:
        found += [*group.evaluation.data.values(), *group.evaluation.references.values()]
    for member in existing(group):
        found += [member.model, member.calibration, member.evaluation]
    folders = {artefact.folder for artefact in found if artefact is not None}
    folders |= {Path(str(start)) for job in group.jobs if (start := job.training.get("start_from")) is not None}
    inside = {folder.resolve() for folder in folders if folder.resolve().is_relative_to(output.resolve())}
    return {folder.relative_to(output.resolve()).as_posix(): folder for folder in sorted(inside)}


def pack(folder: Path) -> Files:
    """The files of an artefact, its manifest included."""
    return {file.relative_to(folder).as_posix(): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


def unpack(files: Files, folder: Path) -> None:
    """Put an artefact in its place, whole or not at all.

    Raises:
        DataError: its files are not those that its manifest names.
        MissingError: it cannot be written.
    """
    remove_leftovers(folder.parent)
    with written_aside(folder, replace_folder=True) as aside:
        for name, content in files.items():
            (aside / name).parent.mkdir(parents=True, exist_ok=True)
            (aside / name).write_bytes(content)
        read_artefact(aside)


def run_task(spec: TaskSpec, copies: Mapping[str, Files], exchange: Callable[[News], bool]) -> TaskReport:
    """Run a group.

    Args:
        spec: of the group.
        copies: folder below the output root -> files of an artefact that it reads, where machines share no folder; else empty.
        exchange: tells the driver of progress; returns whether to stop.
    """
    host = socket.gethostname()
    here = versions_here()
    unlike = [
        f"{name} {here.get(name, 'missing')} instead of {version}" for name, version in spec.versions.items() if here.get(name) != version
    ]
    if unlike:
        return TaskReport(host, unsuitable=f"has {', '.join(unlike)}; install the same versions on every machine")
    if (spec.output / MARKS / spec.run).is_file():
        outcome, seconds = _run(spec.group, spec, exchange)
        return TaskReport(host, outcome, seconds)
    if not copies:
        return TaskReport(host, apart=True)
    try:
        scratch = Path(tempfile.mkdtemp(prefix="vehest-"))
    except OSError as error:
        return TaskReport(
            host, unsuitable=f"cannot keep copies in '{tempfile.gettempdir()}' ({error.strerror}); free some space or set TMPDIR"
        )
    try:
        for name, files in copies.items():
            unpack(files, scratch / name)
        outcome, seconds = _run(moved(spec.group, spec.output, scratch), spec, exchange)
        made = {} if outcome is None or isinstance(outcome, Failure) else _made(outcome, scratch, copies)
        return TaskReport(host, moved(outcome, scratch, spec.output), seconds, files=made)
    except VehestError as error:
        return TaskReport(host, failure_of(error))
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _run(group: Group, spec: TaskSpec, exchange: Callable[[News], bool]) -> tuple[list[Member] | Failure | None, float]:
    line = _Line(exchange, spec.beat_seconds)
    if line.should_stop():
        return None, 0.0
    begun = time.monotonic()
    with use_limits(spec.limits):
        return guarded(group, line.should_stop, line.on_progress), time.monotonic() - begun


def _made(members: Sequence[Member], scratch: Path, copies: Mapping[str, Files]) -> dict[str, Files]:
    folders = [own.folder for member in members for own in (member.model, member.calibration, member.evaluation) if own is not None]
    names = {folder.relative_to(scratch).as_posix(): folder for folder in folders}
    return {name: pack(folder) for name, folder in names.items() if name not in copies}


class _Line:
    """Tells the driver of a group's progress, and hears whether to stop, once a beat."""

    def __init__(self, exchange: Callable[[News], bool], seconds: float) -> None:
        self._exchange, self._seconds = exchange, seconds
        self._news: News = None
        self._stopping, self._due = False, 0.0

    def should_stop(self) -> bool:
        if not self._stopping and time.monotonic() >= self._due:
            self._stopping = self._exchange(self._news)
            self._due = time.monotonic() + self._seconds
        return self._stopping

    def on_progress(self, progress: Progress | Waiting) -> None:
        self._news = progress


def received(report: TaskReport, output: Path) -> list[Member] | Failure | None:
    """The outcome of a task, with its artefacts in the driver's output root."""
    if report.outcome is None or isinstance(report.outcome, Failure):
        return report.outcome
    try:
        for name, files in report.files.items():
            unpack(files, output / name)
    except VehestError as error:
        return failure_of(error)
    return moved(report.outcome, output.resolve(), output)


def moved(value: Value, before: Path, after: Path) -> Value:
    """The same with every path below one folder below another instead; models to start from are paths, too."""
    return _moved(value, before, after)  # type: ignore[no-any-return]


def _moved(value: Any, before: Path, after: Path) -> Any:
    if isinstance(value, Path):
        return after / value.relative_to(before) if value.is_relative_to(before) else value
    if is_dataclass(value) and not isinstance(value, type):
        changed = {own.name: _moved(getattr(value, own.name), before, after) for own in fields(value) if own.init}
        return replace(value, **changed)
    if isinstance(value, Mapping):
        return {key: _moved_start(own, before, after) if key == "start_from" else _moved(own, before, after) for key, own in value.items()}
    if isinstance(value, list | tuple) and type(value) in (list, tuple):
        return type(value)(_moved(own, before, after) for own in value)
    return value


def _moved_start(value: Any, before: Path, after: Path) -> Any:
    return str(_moved(Path(value), before, after)) if isinstance(value, str) else value


def forget_mark(output: Path, run: str) -> None:
    """Remove the mark of a run that is over."""
    with suppress(OSError):
        (output / MARKS / run).unlink()
