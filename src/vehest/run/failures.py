"""Turns exceptions into one line, an exit code and, for a defect, its traceback."""

from __future__ import annotations

import os
import traceback
from dataclasses import dataclass

from vehest.data.errors import MissingError, VehestError
from vehest.data.files import no_room


@dataclass(frozen=True)
class Failure:
    """Failure of a job or command, for its message and exit code."""

    message: str  # one line on what failed and how to remedy it
    detail: str = ""  # traceback of a defect; else empty
    exit_code: int = 1  # exit code of a command that runs this job alone


def failure_of(error: Exception) -> Failure:
    """Turn an exception that a job or command raised into a failure: a defect with traceback,
    unless the user or the machine can change it.

    Returns
    -------
    Failure
        One line for what the user or the machine can change; with the traceback for a defect.
    """
    expected = error if isinstance(error, VehestError) else _of_machine(error)
    if expected is not None:
        return Failure(str(expected), exit_code=expected.exit_code)
    deep = (
        "; something that was read nests too deeply: make it flatter"
        if isinstance(error, RecursionError)
        else ""
    )
    return Failure(
        f"{type(error).__name__}: {error}{deep}", "".join(traceback.format_exception(error))
    )


def _of_machine(error: Exception) -> MissingError | None:
    """Error with a message for the user where the machine is short of memory, disk or files, or a
    file cannot be reached; None for another error.
    """
    full = no_room(error)
    if full is not None:
        target = f"'{full.filename}'" if full.filename else "where results and temporary files go"
        return MissingError(
            f"no room left to write {target} ({full.strerror}); free some space and run again"
        )
    if isinstance(error, FileNotFoundError):
        try:
            os.getcwd()
        except OSError:
            return MissingError("the working folder has been removed; change to another")
    if isinstance(error, OSError) and error.filename is not None:
        return MissingError(
            f"'{error.filename}' cannot be used: {error.strerror}; check the file, its folder and "
            "their permissions"
        )
    if isinstance(error, MemoryError) or "can't allocate memory" in str(error):
        return MissingError(
            "out of memory; close other programs, or ask for less at a time: --jobs 1, shorter "
            "recordings, smaller networks"
        )
    return None
