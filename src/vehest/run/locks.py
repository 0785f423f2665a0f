"""One process at a time makes an artefact: a lock a name in an output root, which the operating system drops when its holder dies.

The files stay: one that is removed while somebody waits for it would be two locks. Nothing waits while it holds another lock, other than
for the tracking store, which waits for nothing; so no two runs can wait for each other.
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

LOCKS = "locks"
POLL_SECONDS = 0.05


@dataclass(frozen=True)
class Waiting:
    """A lock that somebody else holds.

    Args:
        stage: of the artefact that is wanted.
        label: of the artefact that is wanted.
        holder: who holds it, for people.
    """

    stage: str
    label: str
    holder: str


class Lock:
    """A lock across processes; it ends with the process that holds it, however that ends.

    Args:
        output: the output root.
        stage: of what is locked.
        name: of what is locked, unique in its stage; need not suit a file.
    """

    def __init__(self, output: Path, stage: str, name: str) -> None:
        self.stage, self.name = stage, name
        self._path = output / LOCKS / file_name(f"{stage}-{name}", ".lock")
        self._lock = FileLock(self._path, fallback_to_soft=False)  # a file that only stands for a lock would outlive its process

    def take(self) -> bool:
        """Take the lock if nobody holds it.

        Raises:
            MissingError: the output root cannot be written to.
        """
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._lock.acquire(blocking=False)
        except Timeout:
            return False
        except OSError as error:
            raise writing_error(self._path, error) from error
        with suppress(OSError):  # for people only
            self._path.write_text(f"process {os.getpid()} on {socket.gethostname()}\n", encoding="utf-8")
        return True

    def wait(self, should_stop: Callable[[], bool], say: Callable[[Waiting], None] | None = None) -> bool:
        """Take the lock as soon as it is free; False if ``should_stop`` says so before.

        Args:
            should_stop: asked while waiting.
            say: told once what is waited for, and who holds it.
        """
        said = False
        while not self.take():
            if say is not None and not said:
                said = True
                say(Waiting(self.stage, self.name, self.holder))
            if should_stop():
                return False
            time.sleep(POLL_SECONDS)
        return True

    @property
    def holder(self) -> str:
        """Who took the lock last, for people."""
        try:
            return self._path.read_text(encoding="utf-8").strip() or "another process"
        except (OSError, UnicodeDecodeError):
            return "another process"

    def release(self) -> None:
        """Let it go; nothing happens where it is not held."""
        self._lock.release()


@contextmanager
def held(lock: Lock, should_stop: Callable[[], bool], say: Callable[[Waiting], None] | None = None) -> Iterator[bool]:
    """Wait for a lock and hold it; yields False, and holds nothing, if ``should_stop`` ended the waiting."""
    try:
        yield lock.wait(should_stop, say)
    finally:
        lock.release()


@contextmanager
def held_at_once(lock: Lock) -> Iterator[bool]:
    """Hold a lock if nobody does; yields whether it is held."""
    try:
        yield lock.take()
    finally:
        lock.release()
