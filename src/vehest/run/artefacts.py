"""What a stage leaves behind: one folder with a manifest, complete or not there at all.

The folder's name ends in the stage's key. The key is a hash of everything that determines the content: the stage's
configuration, the digests of its inputs and the version of its code. Commit, library versions, time and machine are
written down as provenance and are not part of the key.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import subprocess
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from vehest.data.errors import DataError, MissingError
from vehest.data.files import file_name, remove_leftovers, sha256_of, written_aside
from vehest.data.schema import check_format, validated
from vehest.data.text_files import read_json
from vehest.run.locks import Lock, Waiting, held
from vehest.version import __version__

CHECKOUT = Path(__file__).resolve().parents[3]
MANIFEST = "manifest.json"
TIMINGS = "timings.csv"  # what a stage took; no part of its content, since it is never the same twice
FORMAT = 1
DIGEST = re.compile(r"[0-9a-f]{64}")
Status = Literal["complete", "interrupted"]


@dataclass(frozen=True)
class StagePlan:
    """What a stage is going to make.

    Args:
        stage: name of the stage.
        label: what it is made from, for people; start of the folder's name.
        config: the part of the configuration that matters here, plain values.
        inputs: input name -> digest.
        code: version of the stage's code.
        output: the output root.
    """

    stage: str
    label: str
    config: Mapping[str, Any]
    inputs: Mapping[str, str]
    code: str
    output: Path

    @property
    def key(self) -> str:
        """Hash of what determines the content."""
        content = {"stage": self.stage, "config": self.config, "inputs": dict(self.inputs), "code": self.code}
        return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()

    @property
    def folder(self) -> Path:
        """Where the artefact belongs."""
        return self.output / file_name(self.stage) / self._folder_name

    @property
    def lock(self) -> Lock:
        """What a process holds while it makes the artefact."""
        return Lock(self.output, self.stage, self.folder.name)

    @property
    def checkpoint_folder(self) -> Path:
        """Where an unfinished run of this stage keeps its state."""
        return self.output / "checkpoints" / self._folder_name

    @property
    def _folder_name(self) -> str:
        return file_name(self.label, f"-{self.key[:12]}")


@dataclass(frozen=True)
class Artefact:
    """What a stage made.

    Args:
        folder: where it is.
        stage: which stage made it.
        label: what it was made from.
        key: see the module.
        status: ``complete``, or ``interrupted`` where a fit was stopped with its best so far.
        outputs: file -> sha256.
        config: configuration of the stage.
        inputs: input name -> digest.
        provenance: time, seconds, versions, machine.
        skipped: whether it was there already.
        code: version of the code that made it.
    """

    folder: Path
    stage: str
    label: str
    key: str
    status: Status
    outputs: Mapping[str, str]
    config: Mapping[str, Any]
    inputs: Mapping[str, str]
    provenance: Mapping[str, Any] = field(default_factory=dict)
    skipped: bool = False
    code: str = ""

    @property
    def digest(self) -> str:
        """Hash of the content, times aside, for the stages that build on it."""
        content = {name: digest for name, digest in self.outputs.items() if name != TIMINGS}
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class Output:
    """A file of an artefact: digest and length of its bytes."""

    sha256: str
    bytes: int


@dataclass(frozen=True)
class Manifest:
    """What manifest.json says; see `Artefact`, and docs/cli.md.

    Args:
        stage: name of the stage that wrote it.
        label: what the artefact is made from, for people.
        key: hash of what determines the content.
        status: ``complete``, or ``interrupted``.
        config: configuration of the stage.
        inputs: input name -> digest.
        outputs: file, relative to the folder -> what it is.
        provenance: circumstances.
        code: version of the stage's code.
        format: version of this layout; 0 where none is stated, which is otherwise the same as 1.
    """

    stage: str
    label: str
    key: str
    status: Status
    config: dict[str, Any]
    inputs: dict[str, str]
    outputs: dict[str, Output]
    provenance: dict[str, Any]
    code: str = ""
    format: int = 0


def find(plan: StagePlan) -> Artefact | None:
    """The finished artefact of a plan, if it is there whole."""
    try:
        artefact = read_artefact(plan.folder)
    except (DataError, MissingError):
        return None
    if artefact.key != plan.key or artefact.status != "complete":
        return None
    return artefact


def read_artefact(folder: Path) -> Artefact:
    """Read a stage's folder.

    Raises:
        MissingError: there is no manifest.
        DataError: the manifest is damaged, or a file it names is gone or has another size.
    """
    path = folder / MANIFEST
    try:
        content = read_json(path)
    except MissingError:
        raise MissingError(f"'{folder}' is not something that vehest made: there is no {MANIFEST} in it") from None
    if not isinstance(content, dict):
        raise DataError(f"'{path}' is damaged (it is no mapping); remove the folder and run the stage again")
    check_format(content.get("format", 0), FORMAT, f"'{path}'", oldest=0)
    manifest = validated(Manifest, content, f"'{path}'")
    for name, entry in manifest.outputs.items():
        _check_output(folder, name, entry, manifest.stage)
    return Artefact(
        folder=folder,
        stage=manifest.stage,
        label=manifest.label,
        key=manifest.key,
        status=manifest.status,
        outputs={name: entry.sha256 for name, entry in manifest.outputs.items()},
        config=manifest.config,
        inputs=manifest.inputs,
        provenance=manifest.provenance,
        skipped=True,
        code=manifest.code,
    )


def _check_output(folder: Path, name: str, entry: Output, stage: str) -> None:
    """See that a file of a manifest is there, in its size, and lies in the folder itself.

    Raises:
        DataError: it does not.
    """
    parts = PurePosixPath(name).parts
    longest = max((len(part.encode("utf-8", "surrogatepass")) for part in parts), default=256)
    if longest > 255 or PurePosixPath(*parts).as_posix() != name or parts[0] == "/" or ".." in parts or "\\" in name or "\0" in name:
        raise DataError(
            f"'{folder / MANIFEST}': outputs names {name[:80]!r}, which is no file inside the folder; run the stage '{stage}' again"
        )
    if not DIGEST.fullmatch(entry.sha256):
        raise DataError(f"'{folder / MANIFEST}': the digest of '{name}' is not 64 hexadecimal digits; run the stage '{stage}' again")
    path = folder.joinpath(*parts)
    if any(folder.joinpath(*parts[: n + 1]).is_symlink() for n in range(len(parts))):
        raise DataError(f"'{path}' is a link; an artefact holds its files itself: run the stage '{stage}' again")
    if not path.is_file() or path.stat().st_size != entry.bytes:
        raise DataError(f"'{path}' is gone or truncated; run the stage '{stage}' again")


def make(plan: StagePlan, write: Callable[[Path], Status | None]) -> Artefact:
    """Run a stage: let ``write`` fill a folder aside, add the manifest, put the folder in its place.

    Args:
        plan: what is made.
        write: fills an empty folder; returns ``interrupted`` if it was stopped.

    Raises:
        MissingError: the disk is full or not writable.
        VehestError: whatever ``write`` raises; nothing is left behind then.
    """
    started = time.monotonic()
    remove_leftovers(plan.folder.parent)
    with written_aside(plan.folder, replace_folder=True) as aside:
        aside.mkdir()
        status = write(aside) or "complete"
        files = sorted(file for file in aside.rglob("*") if file.is_file())
        outputs = {file.relative_to(aside).as_posix(): {"sha256": sha256_of(file), "bytes": file.stat().st_size} for file in files}
        manifest = {
            "format": FORMAT,
            "stage": plan.stage,
            "label": plan.label,
            "key": plan.key,
            "status": status,
            "config": plan.config,
            "inputs": dict(plan.inputs),
            "code": plan.code,
            "outputs": outputs,
            "provenance": provenance(time.monotonic() - started),
        }
        (aside / MANIFEST).write_text(json.dumps(manifest, indent=1, default=str), encoding="utf-8")
    made = read_artefact(plan.folder)
    return Artefact(**{**made.__dict__, "skipped": False})


def ensured(
    plan: StagePlan,
    write: Callable[[Path], Status | None],
    force: bool,
    should_stop: Callable[[], bool],
    say: Callable[[Waiting], None],
) -> Artefact | None:
    """Make an artefact, or take the one that another process is making; none if ``should_stop`` ended the waiting for it.

    Args:
        plan: what is made.
        write: see `make`.
        force: whether to make it although it is there.
        should_stop: asked while another process makes it.
        say: told what is waited for.

    Raises:
        VehestError: as `make` does.
    """
    with held(plan.lock, should_stop, say) as mine:
        if not mine:
            return None
        return (None if force else find(plan)) or make(plan, write)


def provenance(seconds: float) -> dict[str, Any]:
    """Circumstances that are worth knowing and do not determine the content."""
    return {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": round(seconds, 3),
        "vehest": __version__,
        "commit": commit(),
        "python": platform.python_version(),
        "libraries": library_versions(),
        "constraints": constraints(),
        "platform": platform.platform(),
        "cpu_count": os.cpu_count(),
    }


@cache
def library_versions() -> dict[str, str]:
    """Versions of the libraries that numbers depend on."""
    names = ("torch", "numpy", "scipy", "numba", "pandas", "pyarrow", "hydra-core", "mlflow", "commonroad-vehicle-models")
    versions = {}
    for name in names:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return versions


@cache
def constraints() -> dict[str, str]:
    """Name and digest of the checkout's file of locked versions; empty without a checkout."""
    file = CHECKOUT / "constraints.txt"
    return {file.name: sha256_of(file)} if file.is_file() else {}


@cache
def commit() -> str:
    """Commit of the checkout that vehest runs from, with a mark if it has changes; empty if it is no checkout."""
    if not (CHECKOUT / ".git").exists() or "site-packages" in CHECKOUT.parts:
        return ""
    try:
        result = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"],
            cwd=CHECKOUT,
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return result.stdout.strip()
