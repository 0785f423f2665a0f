"""Writing so that a reader never meets half a file: write aside, flush to disk, rename."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import shutil
import socket
import stat
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from vehest.data.errors import DataError, MissingError, VehestError

ASIDE_PREFIX = ".writing-"
FOREIGN_SECONDS = 24 * 3600.0  # after which what another host writes is taken for left over; its processes cannot be looked at from here
NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
_NO_ROOM_WORDS = {
    **{os.strerror(number): number for number in sorted(NO_ROOM)},
    "os error 28": errno.ENOSPC,
    "database or disk is full": errno.ENOSPC,
}


@contextmanager
def written_aside(path: Path, *, replace_folder: bool = False) -> Iterator[Path]:
    """Yield a path beside ``path``; on success it takes the place of ``path`` in one step, else it is removed.

    Args:
        path: file or folder to write.
        replace_folder: whether a folder that is there already may go; a file may always be replaced.

    Raises:
        MissingError: the disk is full or the folder cannot be written to.
    """
    aside = aside_of(path)
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
        raise writing_error(_target(path, aside, error), error) from error
    except VehestError:
        raise
    except Exception as error:
        full = no_room(error)
        if full is None:
            raise
        raise writing_error(path, full) from error
    finally:
        with suppress(OSError):  # nothing was written where the folder itself cannot be
            remove(aside)


def regular_file(path: Path) -> Path:
    """A file that can be read to its end: no folder, pipe or device.

    Raises:
        MissingError: there is nothing.
        DataError: it is something else, or cannot be looked at.
    """
    try:
        mode = os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        raise MissingError(f"there is no file '{path}'") from None
    except (OSError, ValueError) as error:  # a name may be too long, or hold a null character
        raise DataError(f"cannot read '{path}': {getattr(error, 'strerror', None) or error}") from None
    if not stat.S_ISREG(mode):
        kinds = {
            stat.S_IFDIR: "a folder",
            stat.S_IFIFO: "a pipe",
            stat.S_IFCHR: "a device",
            stat.S_IFBLK: "a device",
            stat.S_IFSOCK: "a socket",
        }
        raise DataError(f"'{path}' is {kinds.get(stat.S_IFMT(mode), 'something else')}, not a file")
    return path


def file_name(name: str, ending: str = "") -> str:
    """A name from anywhere as a file's name: one component of a path, the same for the same name, another for another.

    Letters, digits, ``_``, ``-``, ``+``, ``=`` and ``.`` stay; a name that holds anything else, begins with a dot or is long gets what is
    left of it and the start of its hash.
    """
    kept = re.sub(r"[^\w.+=-]", "_", name).lstrip(".")
    if kept != name or not name or len(kept.encode()) > 120:
        digest = hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()[:8]
        short = kept.encode()[:100].decode("utf-8", "ignore")
        return f"{short}~{digest}{ending}"
    return f"{kept}{ending}"


def no_room(error: BaseException) -> OSError | None:
    """The full disk behind an error of a library that has its own kind of error for it; None where it is something else."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno in NO_ROOM:
            return cause
        if not isinstance(cause, VehestError):
            number = next((number for words, number in _NO_ROOM_WORDS.items() if words in str(cause)), None)
            if number is not None:
                return OSError(number, os.strerror(number))
        cause = cause.__cause__ or cause.__context__
    return None


def writing_error(path: Path, error: OSError) -> VehestError:
    """The one-line error for a failure to write to ``path``."""
    path, full = _as_finished(path), no_room(error)
    if full is not None:
        return MissingError(f"no room left to write '{path}' ({full.strerror}); free some space and run again")
    return MissingError(f"cannot write '{path}': {error.strerror or error}; check the folder and its permissions")


def as_os_error(error: Exception) -> OSError:
    """The failed write that safetensors reports in prose, with the number of its error."""
    text = str(error)
    marker = "os error "
    number = int(text.split(marker)[1].split(")")[0]) if marker in text else errno.EIO
    return OSError(number, text)


def remove(path: Path) -> None:
    """Remove a file or folder if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def remove_leftovers(folder: Path) -> int:
    """Remove what killed writers left in ``folder``; what a living process is writing stays. Returns how many."""
    leftovers = [path for path in folder.glob(f"{ASIDE_PREFIX}*") if is_left_over(path)] if folder.is_dir() else []
    for leftover in leftovers:
        remove(leftover)
    return len(leftovers)


def is_left_over(path: Path) -> bool:
    """Whether the process that was writing ``path``, by its name something aside, is gone; on another host: whether it is a day old."""
    if not path.name.startswith(ASIDE_PREFIX):
        return False
    host = re.match(rf"{re.escape(ASIDE_PREFIX)}\d+-([0-9a-f]{{8}})[0-9a-f]{{8}}-", path.name)
    if host is not None and host[1] != _host():
        try:
            return time.time() - path.lstat().st_mtime > FOREIGN_SECONDS
        except OSError:
            return False
    return not _is_alive(_writer(path))


def aside_of(path: Path) -> Path:
    """A free place beside ``path`` for what this process writes or takes away; what is left there is removed later."""
    return path.with_name(_aside_name(path.name))


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


def _target(path: Path, aside: Path, error: OSError) -> Path:
    """What could not be written: the file that the error names, unless it is a part of what is written aside."""
    named = error.filename
    if not isinstance(named, str) or Path(named).is_relative_to(aside) or ASIDE_PREFIX in named:
        return path
    return Path(named)


def _as_finished(path: Path) -> Path:
    """A path as it will be called once what is written aside is in its place."""
    return Path(*(re.sub(rf"^{re.escape(ASIDE_PREFIX)}\d+-(?:[0-9a-f]{{8}}){{1,2}}-", "", part) for part in path.parts))


def _aside_name(name: str) -> str:
    return f"{ASIDE_PREFIX}{os.getpid()}-{_host()}{uuid.uuid4().hex[:8]}-{name}"


@cache
def _host() -> str:
    """Start of a hash of this host's name: process numbers mean nothing on another one that shares the folder."""
    return hashlib.sha256(socket.gethostname().encode("utf-8", "surrogateescape")).hexdigest()[:8]


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
