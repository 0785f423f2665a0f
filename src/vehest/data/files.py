"""Writing so that a reader never meets half a file: write aside, flush to disk, rename."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from vehest.data.errors import DataError, MissingError, VehestError

ASIDE_PREFIX = ".writing-"


@contextmanager
def written_aside(path: Path, *, replace_folder: bool = False) -> Iterator[Path]:
    """Yield a path beside ``path``; on success it takes the place of ``path`` in one step, else it is removed.

    Args:
        path: file or folder to write.
        replace_folder: whether a folder that is there already may go; a file may always be replaced.

    Raises:
        MissingError: the disk is full or the folder cannot be written to.
    """
    aside = path.with_name(_aside_name(path.name))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield aside
        _flush(aside)
        if replace_folder and path.is_dir() and not path.is_symlink():
            replaced = path.with_name(_aside_name("replaced"))
            os.rename(path, replaced)
            os.rename(aside, path)
            shutil.rmtree(replaced, ignore_errors=True)
        else:
            os.replace(aside, path)
    except OSError as error:
        raise writing_error(path, error) from error
    finally:
        with suppress(OSError):  # nothing was written where the folder itself cannot be
            remove(aside)


def writing_error(path: Path, error: OSError) -> VehestError:
    """The one-line error for a failure to write to ``path``."""
    if error.errno in {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}:
        return MissingError(f"no room left to write '{path}' ({os.strerror(error.errno)}); free some space and run again")
    return MissingError(f"cannot write '{path}': {error.strerror or error}; check the folder and its permissions")


def remove(path: Path) -> None:
    """Remove a file or folder if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def remove_leftovers(folder: Path) -> int:
    """Remove what killed writers left in ``folder``; what a living process is writing stays. Returns how many."""
    leftovers = [path for path in folder.glob(f"{ASIDE_PREFIX}*") if not _is_alive(_writer(path))] if folder.is_dir() else []
    for leftover in leftovers:
        remove(leftover)
    return len(leftovers)


def sha256_of(path: Path) -> str:
    """Hex digest of a file's bytes.

    Raises:
        DataError: the file cannot be read.
    """
    try:
        with open(path, "rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise DataError(f"cannot read '{path}': {error.strerror}") from error


def _aside_name(name: str) -> str:
    return f"{ASIDE_PREFIX}{os.getpid()}-{uuid.uuid4().hex[:8]}-{name}"


def _writer(path: Path) -> int:
    number = path.name.removeprefix(ASIDE_PREFIX).split("-")[0]
    return int(number) if number.isdigit() else 0


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return process > 0


def _flush(path: Path) -> None:
    files = [p for p in path.rglob("*") if p.is_file()] if path.is_dir() else [path]
    for file in files:
        descriptor = os.open(file, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
