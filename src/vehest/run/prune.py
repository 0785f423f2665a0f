"""Lists artefacts that no current configuration can reuse, and removes them after agreement.

output root -> artefacts, checkpoints, leftovers -> `unused_artefacts` -> `remove_unused`

An artefact is listed if its code is not today's, if it is damaged, or if its inputs are not in the
output root; trainings stay without their recordings, which can be made again. Only folders whose
manifest gives their own name are artefacts; links are left alone.
"""

from __future__ import annotations

import os
import shutil
import stat
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from vehest.artefacts.artefact import MANIFEST, Artefact, read_artefact
from vehest.data.errors import VehestError
from vehest.data.files import aside_of, is_left_over, writing_error
from vehest.data.text_files import read_json
from vehest.run.ingest import PARTS_PREFIX
from vehest.run.ingest import STAGE as INGEST
from vehest.run.run_cache import FINISHED
from vehest.run.train import STAGE as TRAIN
from vehest.run.versions import VERSIONS, code_of

CHECKPOINTS = "checkpoints"  # folder of checkpoints in an output root
OUTDATED = "its code has changed"  # reason for the removal of an artefact or leftover
DAMAGED = "it is damaged"  # reason, likewise
ORPHANED = "its inputs are gone"  # reason, likewise
SUPERFLUOUS = "its model is there, or listed"  # reason for the removal of a checkpoint
LEFT_OVER = "left by a process that was killed"  # reason for the removal of an unfinished folder


def unused_artefacts(output: Path) -> list[dict[str, Any]]:
    """List everything in an output root that no current configuration can reuse, stage by stage.

    Parameters
    ----------
    output : Path
        Output root; nothing in it is changed.

    Returns
    -------
    list[dict[str, Any]]
        ``path``, ``reason``, ``bytes`` of all its files, and ``seconds`` since it was last written
        to.
    """
    artefacts = _artefacts(output)
    readable = [artefact for artefact in artefacts.values() if artefact is not None]
    present = {
        digest for artefact in readable for digest in (artefact.digest, *artefact.outputs.values())
    }
    reasons = {
        folder: reason
        for folder, artefact in artefacts.items()
        if (reason := _reason(artefact, present))
    }
    for folder in _entries(output / CHECKPOINTS):  # without a model its training may go on
        model = output / TRAIN / folder.name
        if model in reasons or any(
            artefact.folder == model and artefact.status == "complete" for artefact in readable
        ):
            reasons[folder] = SUPERFLUOUS
    for path in (
        path for place in (*VERSIONS, CHECKPOINTS, FINISHED) for path in _entries(output / place)
    ):
        parts_of = path.with_name(path.name.removeprefix(PARTS_PREFIX))
        if is_left_over(path) or (parts_of != path and parts_of in artefacts):
            reasons[path] = LEFT_OVER
    return [
        {"path": str(path), "reason": reason} | _size_and_age(path)
        for path, reason in reasons.items()
    ]


def remove_unused(paths: Iterable[Path], on_removed: Callable[[Path], None]) -> None:
    """Remove files and folders, each renamed first, so that no process finds a half of one;
    ``on_removed`` is called after each.

    Parameters
    ----------
    paths : iterable of Path
        As `unused_artefacts` lists them; those that another process removed are passed over.
    on_removed : callable
        Takes a path.

    Raises
    ------
    MissingError
        A path cannot be removed.
    """
    for path in paths:
        aside = aside_of(path)
        try:
            os.rename(path, aside)
            shutil.rmtree(aside) if aside.is_dir() else aside.unlink()
        except FileNotFoundError:  # another process was quicker
            continue
        except OSError as error:
            raise writing_error(path, error) from error
        on_removed(path)


def _artefacts(output: Path) -> dict[Path, Artefact | None]:
    """Folder -> its artefact, for folders whose manifest gives their own name; None for one that is
    damaged.
    """
    artefacts: dict[Path, Artefact | None] = {}
    for folder in (folder for stage in VERSIONS for folder in _entries(output / stage)):
        with suppress(VehestError, KeyError, TypeError):
            manifest = read_json(folder / MANIFEST)
            named = (manifest["stage"], f"{manifest['label']}-{manifest['key'][:12]}")
            if named == (folder.parent.name, folder.name) and not (folder / MANIFEST).is_symlink():
                artefacts[folder] = None
                artefacts[folder] = read_artefact(folder, hash_files=False)
    return artefacts


def _reason(artefact: Artefact | None, present: set[str]) -> str:
    """Reason why an artefact cannot be reused; empty where it can, and where its estimator or study
    is not installed.
    """
    if artefact is None:
        return DAMAGED
    if not artefact.code.startswith(f"{artefact.stage}="):  # of a vehest without versions
        return OUTDATED
    name = artefact.code.partition(" ")[2].partition("=")[0]  # train=1 NAME=1 training=1
    with suppress(VehestError):
        if artefact.code not in (
            code_of(artefact.stage, name),
            code_of(artefact.stage, name, faults=True),
        ):
            return OUTDATED
    orphaned = artefact.stage not in (INGEST, TRAIN) and not present.issuperset(
        artefact.inputs.values()
    )
    return ORPHANED if orphaned else ""


def _entries(place: Path) -> list[Path]:
    """Files and folders in a folder, sorted by name, without links."""
    return (
        [path for path in sorted(place.iterdir()) if not path.is_symlink()]
        if place.is_dir() and not place.is_symlink()
        else []
    )


def _size_and_age(path: Path) -> dict[str, int]:
    """Size of all files [bytes], and time since the last of them was written [s]."""
    about = [entry.lstat() for entry in (path, *path.rglob("*"))]
    size = sum(entry.st_size for entry in about if not stat.S_ISDIR(entry.st_mode))
    return {
        "bytes": size,
        "seconds": round(max(0.0, time.time() - max(entry.st_mtime for entry in about))),
    }
