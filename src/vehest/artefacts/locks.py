"""Locks across processes: one process at a time makes an artefact.

The operating system drops a lock when its holder ends. The files stay: removing one while another
process waits for it would make two locks. A process that waits holds no other lock, except that of
the tracking store, under which nothing waits: so there is no deadlock.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout

from vehest.data.files import file_name, writing_error

LOCKS = "locks"  # folder of the lock files in an output root
POLL_SECONDS = 0.05  # s between two attempts to take a lock that another process has


@dataclass(frozen=True)
class Waiting:
    """Description of the lock for which a process waits, since another one makes the artefact."""

    stage: str  # name of the stage
    label: str  # label of the artefact
    holder: str  # text on the process that has the lock, for messages


class Lock:
    """A lock in an output root, identified by a stage and a name that is unique in the stage.

    It ends with the process that holds it.
    """

    def __init__(self, output: Path, stage: str, name: str) -> None:
        self.stage = stage
        self.name = name
        self._path = output / LOCKS / file_name(f"{stage}-{name}", ".lock")
        self._lock = FileLock(
            self._path, fallback_to_soft=False
        )  # a file that only stands for a lock would outlive its process

    def take(self) -> bool:
        """Take the lock if it is free; returns whether it was.

        Raises
        ------
        MissingError
            The output root cannot be written to.
        """
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._lock.acquire(blocking=False)
        except Timeout:
            return False
        except OSError as error:
            raise writing_error(self._path, error) from error
        with suppress(OSError):  # for people only
            self._path.write_text(
                f"process {os.getpid()} on {socket.gethostname()}\n", encoding="utf-8"
            )
        return True

    @property
    def holder(self) -> str:
        """Text on the process that took the lock last, for messages."""
        with suppress(OSError, UnicodeDecodeError):
            return self._path.read_text(encoding="utf-8").strip() or "another process"
        return "another process"

    def release(self) -> None:
        """Release the lock, if it is held."""
        self._lock.release()


@contextmanager
def held(
    lock: Lock,
    should_stop: Callable[[], bool] = lambda: True,
    on_wait: Callable[[Waiting], None] | None = None,
) -> Iterator[bool]:
    """Hold a lock within a ``with`` block; yields whether it is held.

    Parameters
    ----------
    lock : Lock
        The lock to take.
    should_stop : callable
        Whether to end the wait for another process; by default there is no wait.
    on_wait : callable or None
        Called once where another process has the lock.

    Raises
    ------
    MissingError
        The output root cannot be written to.
    """
    try:
        mine = lock.take()
        if not mine and on_wait is not None:
            on_wait(Waiting(lock.stage, lock.name, lock.holder))
        while not mine and not should_stop():
            time.sleep(POLL_SECONDS)
            mine = lock.take()
        yield mine
    finally:
        lock.release()
