"""A group as a task of a cluster: idempotent by the keys of its members, so that a second try makes nothing twice.

Group -> TaskSpec -> `run_task` on a machine: same versions? same output root? -> Done -> artefacts in the driver's output root
"""

from __future__ import annotations

import platform
import socket
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import chdir
from dataclasses import dataclass
from pathlib import Path

from vehest.data.errors import MissingError
from vehest.data.files import remove_leftovers, written_aside
from vehest.data.limits import Limits, current_limits, use_limits
from vehest.run.artefacts import MANIFEST, commit, library_versions, read_artefact
from vehest.run.failures import Failure
from vehest.run.group import Group, Member, existing
from vehest.run.launchers.local import Done, Files, guarded
from vehest.version import __version__

TIMES = 3  # that a group is tried, if its tasks end without a report


class NotShared(Exception):
    """A machine does not share the output root, and got no copies."""


@dataclass(frozen=True)
class TaskSpec:
    """A group with the driver's paths, relative ones by ``folder``; a machine that sees ``mark`` shares the output root."""

    position: int
    group: Group
    folder: Path
    mark: Path
    versions: Mapping[str, str]
    limits: Limits


def new_mark(output: Path) -> Path:
    """A new folder in an output root, which only its owner can read."""
    folder = output.resolve() / "clusters"
    folder.mkdir(parents=True, exist_ok=True)
    return Path(tempfile.mkdtemp(prefix="run-", dir=folder))


def task_of(position: int, group: Group, output: Path, mark: Path) -> TaskSpec:
    """What a machine is sent of a group."""
    return TaskSpec(position, group, output if output.is_absolute() else Path.cwd(), mark, versions_here(), current_limits())


def run_task(spec: TaskSpec, copies: Files | None, should_stop: Callable[[], bool]) -> Done:
    """Run a group on a machine of a cluster; ``copies`` are the artefacts that it reads, none while machines are taken to share the root.

    Raises:
        MissingError: the machine has other versions, or copies cannot be written.
        NotShared: it does not share the output root, and has no copies.
    """
    begun, here = time.monotonic(), versions_here()
    unlike = [f"{name} {here.get(name, 'missing')} instead of {own}" for name, own in spec.versions.items() if here.get(name) != own]
    if unlike:
        raise MissingError(f"{socket.gethostname()} has {', '.join(unlike)}; install the same versions on every machine")
    shared = spec.mark.is_dir()
    if not shared and copies is None:
        raise NotShared(socket.gethostname())
    spec.folder.mkdir(parents=True, exist_ok=True)
    with chdir(spec.folder), use_limits(spec.limits):
        unpack({} if shared or copies is None else copies)
        outcome = guarded(spec.group.run, should_stop, lambda _: None)
        made = {} if shared or isinstance(outcome, Failure) else pack(folders_of(outcome).difference(copies or ()))
    return Done(spec.position, outcome, time.monotonic() - begun, made)


def versions_here() -> dict[str, str]:
    """What must be the same everywhere for results to be those of one machine."""
    return {"vehest": f"{__version__} {commit()}".strip(), "python": platform.python_version(), **library_versions()}


def inputs_of(group: Group) -> set[Path]:
    """Folders of artefacts that a group reads, or of which it has some already."""
    data = [job.data for job in group.jobs]
    if group.evaluation is not None:
        data += [group.evaluation.data, group.evaluation.references]
    starts = {Path(start) for job in group.jobs if (start := job.training.get("start_from"))}
    return folders_of(existing(group)) | {artefact.folder for own in data for artefact in own.values()} | starts


def folders_of(members: Sequence[Member]) -> set[Path]:
    """Folders of the artefacts of members."""
    return {own.folder for member in members for own in (member.model, member.calibration, member.evaluation) if own is not None}


def pack(folders: set[Path]) -> Files:
    """The files of artefacts, their manifests included."""
    return {own: {file.relative_to(own).as_posix(): file.read_bytes() for file in own.rglob("*") if file.is_file()} for own in folders}


def unpack(packed: Files) -> None:
    """Put artefacts in their places, each whole or not at all, unless they are there.

    Raises:
        DataError: files are not those that a manifest names.
        MissingError: they cannot be written.
    """
    for folder, files in packed.items():
        if not (folder / MANIFEST).is_file() or (folder / MANIFEST).read_bytes() != files[MANIFEST]:
            remove_leftovers(folder.parent)
            with written_aside(folder, replace_folder=True) as aside:
                for name, content in files.items():
                    (aside / name).parent.mkdir(parents=True, exist_ok=True)
                    (aside / name).write_bytes(content)
                read_artefact(aside)
