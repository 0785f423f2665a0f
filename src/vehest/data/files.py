"""Writes files so that no reader meets half of one: write aside, flush to disk, rename."""

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

from vehest.data.errors import DataError, MissingError, VehestError, closest

ASIDE_PREFIX = ".writing-"  # start of the name of a file or folder that is being written
# process and host before the name
_ASIDE = re.compile(rf"{re.escape(ASIDE_PREFIX)}(\d+)-(?:([0-9a-f]{{8}})[0-9a-f]{{8}}-)?")
# after which files of another host count as left over, whose processes cannot be seen from here
FOREIGN_SECONDS = 24 * 3600.0
# numbers of the errors of a full disk
NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
# words in the text of an error without a number -> number of the error
_NO_ROOM_WORDS = {os.strerror(number): number for number in NO_ROOM} | dict.fromkeys(
    ("os error 28", "database or disk is full"), errno.ENOSPC
)


@contextmanager
def written_aside(path: Path, *, replace_folder: bool = False) -> Iterator[Path]:
    """Yield a path beside ``path``; on success it takes the place of ``path`` in one step, else it
    is removed.

    A file that is there may always be replaced, a folder by ``replace_folder``.

    Raises
    ------
    MissingError
        The disk is full or the folder cannot be written to.
    """
    aside = aside_of(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield aside
        _flush(aside)
        if replace_folder and path.is_dir() and not path.is_symlink():
            replaced = aside_of(path, "replaced")
            os.rename(path, replaced)
            os.rename(aside, path)
            shutil.rmtree(replaced, ignore_errors=True)
        else:
            os.replace(aside, path)
    except OSError as error:
        named = Path(error.filename) if isinstance(error.filename, str) else aside
        raise writing_error(
            path if named.is_relative_to(aside) or ASIDE_PREFIX in str(named) else named, error
        ) from error
    except Exception as error:
        full = None if isinstance(error, VehestError) else no_room(error)
        if full is None:
            raise
        raise writing_error(path, full) from error
    finally:
        with suppress(OSError):  # nothing was written where the folder itself cannot be
            remove(aside)


def missing_file(path: Path) -> MissingError:
    """The error for a file that does not exist, with a name of its folder that is close to it."""
    names: list[str] = []
    with suppress(OSError):
        names = sorted(os.listdir(path.parent))
    close = closest(path.name, names)
    hint = f"; did you mean '{path.parent / close}'?" if close else ""
    return MissingError(f"there is no file '{path}'{hint}")


def regular_file(path: Path) -> Path:
    """A file that can be read to its end: no folder, pipe or device.

    Raises
    ------
    MissingError
        There is nothing.
    DataError
        It is something else, or cannot be looked at.
    """
    try:
        mode = os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        raise missing_file(path) from None
    except (OSError, ValueError) as error:  # a name may be too long, or hold a null character
        raise DataError(
            f"cannot read '{path}': {getattr(error, 'strerror', None) or error}"
        ) from None
    if not stat.S_ISREG(mode):
        kind = {"d": "a folder", "p": "a pipe", "s": "a socket"}.get(
            stat.filemode(mode)[0], "a device"
        )
        raise DataError(f"'{path}' is {kind}, not a file")
    return path


def without_links(path: Path) -> Path:
    """The absolute path behind all links.

    Raises
    ------
    DataError
        Links lead to each other.
    """
    try:
        return path.resolve()
    except (OSError, RuntimeError):  # the latter up to Python 3.12
        raise DataError(f"cannot follow '{path}': its links lead to each other") from None


def file_name(name: str, ending: str = "") -> str:
    """A name as one component of a path, another for another name: what is no letter, digit or one
    of ``_-+=.`` is replaced, a name cut at 100 bytes, and the start of its hash added.

    Parameters
    ----------
    name : str
        Any text, an empty one too; one that is a good name already stays as it is.
    ending : str
        Appended as it is, such as ``.parquet``.
    """
    component = re.sub(r"[^\w.+=-]", "_", name).lstrip(".")
    if component != name or not name or len(component.encode()) > 120:
        digest = hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()[:8]
        component = f"{component.encode()[:100].decode('utf-8', 'ignore')}~{digest}"
    return f"{component}{ending}"


def no_room(error: BaseException) -> OSError | None:
    """The error of a full disk behind an exception, also where a library only reports it as text;
    None for another cause.

    None where the cause is another.
    """
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno in NO_ROOM:
            return cause
        if not isinstance(cause, VehestError):
            number = next(
                (number for words, number in _NO_ROOM_WORDS.items() if words in str(cause)), None
            )
            if number is not None:
                return OSError(number, os.strerror(number))
        cause = cause.__cause__ or cause.__context__
    return None


def writing_error(path: Path, error: OSError) -> VehestError:
    """The one-line error for a failure to write to ``path``."""
    path = Path(*(_ASIDE.sub("", part) for part in path.parts))
    full = no_room(error)  # as it is called in the end
    if full is not None:
        return MissingError(
            f"no room left to write '{path}' ({full.strerror}); free some space and run again"
        )
    return MissingError(
        f"cannot write '{path}': {error.strerror or error}; check the folder and its permissions"
    )


def as_os_error(error: Exception) -> OSError:
    """The failed write that safetensors reports as text, with the number of its error."""
    number = re.search(r"os error (\d+)", str(error))
    return OSError(int(number[1]) if number else errno.EIO, str(error))


def remove(path: Path) -> None:
    """Remove a file or folder if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def remove_leftovers(folder: Path) -> int:
    """Remove files of ended writers in ``folder``.

    Those of running processes stay. Returns their number.
    """
    leftovers = (
        [path for path in folder.glob(f"{ASIDE_PREFIX}*") if is_left_over(path)]
        if folder.is_dir()
        else []
    )
    for leftover in leftovers:
        remove(leftover)
    return len(leftovers)


def is_left_over(path: Path) -> bool:
    """Whether ``path`` was written aside and its process has ended.

    Of another host: whether it is a day old.
    """
    if not path.name.startswith(ASIDE_PREFIX):
        return False
    process, host = match.groups() if (match := _ASIDE.match(path.name)) else ("0", None)
    if (
        host in (None, _host()) and os.name == "posix"
    ):  # elsewhere os.kill would end what it asks for
        return not _is_alive(int(process))
    try:
        return time.time() - path.lstat().st_mtime > FOREIGN_SECONDS
    except OSError:
        return False


def aside_of(path: Path, name: str = "") -> Path:
    """A free path beside ``path`` at which this process may write what later becomes ``path`` or
    another name.

    Files that stay there are removed later.
    """
    return path.with_name(
        f"{ASIDE_PREFIX}{os.getpid()}-{_host()}{uuid.uuid4().hex[:8]}-{name or path.name}"
    )


def sha256_of(path: Path) -> str:
    """Hex digest of a file's bytes.

    Raises
    ------
    DataError
        It is not there, cannot be read, or is a folder, pipe or device.
    """
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):
            regular_file(path)  # which names what it is
        with open(path, "rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise DataError(f"cannot read '{path}': {error.strerror}") from error


def stamp_of(*paths: Path) -> str:
    """Hash by which changes of files are found: of names, sizes, times and inodes of files and of
    all files below folders, except compiled code; links are followed.

    Times of inodes show files that were replaced by others of the same size and date.
    """
    files = {str(path) for path in paths}
    visited: set[str] = set()
    for path in paths:
        for folder, folders, names in os.walk(path, followlinks=True):
            if os.path.realpath(folder) in visited or folder.endswith("__pycache__"):
                folders.clear()
                continue
            visited.add(os.path.realpath(folder))
            files.update(os.path.join(folder, name) for name in names)
    states = []
    for file in sorted(files):
        with suppress(OSError):  # a link to nothing
            about = os.stat(file)
            if not stat.S_ISDIR(about.st_mode):
                states.append(
                    (file, about.st_size, about.st_mtime_ns, about.st_ctime_ns, about.st_ino)
                )
    return hashlib.sha256(repr(states).encode("utf-8", "surrogateescape")).hexdigest()


@cache
def _host() -> str:
    """Start of a hash of this host's name, since process numbers mean nothing on another host that
    shares the folder.
    """
    return hashlib.sha256(socket.gethostname().encode("utf-8", "surrogateescape")).hexdigest()[:8]


def _is_alive(process: int) -> bool:
    """Whether a process of that number runs, whosever it is; never one of number 0 or below."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return process > 0


def _flush(path: Path) -> None:
    """Force the contents of a file, or of all files in a folder, onto the disk."""
    for file in (
        [entry for entry in path.rglob("*") if entry.is_file()] if path.is_dir() else [path]
    ):
        descriptor = os.open(
            file, os.O_RDWR
        )  # Windows flushes no file that is open for reading alone
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
