"""Reads one file in a process of its own, with limits on memory and time.

file and request (JSON) -> function of a reader's module, in the limited process -> arrays and a
summary (Arrow) -> caller
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, cast

import pyarrow as pa
from numpy.typing import NDArray

from vehest.data import errors
from vehest.data.errors import DataError, MissingError, VehestError, printable
from vehest.data.limits import Limits, current_limits, use_limits

Arrays = dict[str, NDArray[Any]]  # name -> array

SECONDS = 15.0  # s of processor time, to which SECONDS_PER_BYTE of the file are added
SECONDS_PER_BYTE = 1e-6  # s of processor time more for each byte of the file
# longest time a reader may take in all, over the processor time: for a busy machine, or one without
# limits of its own
WAITING = 8.0
MEMORY_PER_BYTE = 10.0  # bytes of memory for each byte of the file, besides the limit `memory`
NO_MEMORY = 77  # exit status of a reader that ran out of memory
# command that starts the limited process
_COMMAND = [sys.executable, "-P", "-m", "vehest.sources.limited"]
# environment variables by which libraries use one thread
_SINGLE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"
)


class Reading(NamedTuple):
    """Result of a reader."""

    arrays: Arrays  # name -> samples, one-dimensional
    summary: dict[str, Any]  # everything else, as JSON holds it


def read_limited(reader: str, file: Path, *, packed: Path | None = None, **request: Any) -> Reading:
    """Call ``reader(file, **request)`` in a process that may not exceed its memory and time or
    write a file.

    Processor time is 15 s and 1 s for each MB of the file or folder, memory is ``limits.memory``
    and ten times its size. Where the system has no such limits (Windows), eight times that time is
    all that ends it.

    Parameters
    ----------
    reader : str
        ``module:function``, which returns arrays and a summary.
    file : Path
        File or folder that is read.
    packed : Path or None
        Where ``file`` was unpacked, the file or folder that the user has, by whose size memory is
        limited.
    **request : object
        Further arguments of the function, such as JSON holds.

    Raises
    ------
    VehestError
        As the reader raises it.
    DataError
        The process ended otherwise, as the file is damaged, or asks for more.
    """
    seconds = SECONDS + SECONDS_PER_BYTE * _size(file)
    memory = current_limits().memory + MEMORY_PER_BYTE * _size(packed or file)
    order = {
        "reader": reader,
        "file": str(file),
        "request": request,
        "limits": asdict(current_limits()),
        "seconds": seconds,
        "memory": memory,
    }
    environment = {
        **os.environ,
        **_SINGLE_THREAD,
        "ARROW_DEFAULT_MEMORY_POOL": "system",
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
    }
    with subprocess.Popen(
        _COMMAND,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=environment,
    ) as process:
        timer = threading.Timer(WAITING * seconds, process.kill)
        timer.start()
        try:
            with suppress(BrokenPipeError), cast(BinaryIO, process.stdin) as stdin:
                stdin.write(json.dumps(order).encode())
            table = pa.ipc.open_stream(process.stdout).read_all()
        except (pa.ArrowException, OSError):
            raise _ended(file, process.wait(), seconds, memory) from None
        finally:
            timer.cancel()
            process.kill()
    answer = json.loads(table.schema.metadata[b"answer"])
    if "error" in answer:
        raise getattr(errors, answer["error"])(answer["message"])
    arrays = {
        name: table.column(name).chunk(0).values.to_numpy(zero_copy_only=False)
        for name in table.column_names
    }
    return Reading(arrays, answer)


def require_package(module: str, extra: str, purpose: str) -> None:
    """Raise an error unless an optional package is installed, without importing it.

    Parameters
    ----------
    module : str
        Name by which it is imported.
    extra : str
        Extra of vehest that installs it.
    purpose : str
        What needs it, for the message.

    Raises
    ------
    MissingError
        It is not installed.
    """
    if find_spec(module) is None:
        raise MissingError(
            f"{purpose} needs the package {module}; install it with: pip install 'vehest[{extra}]'"
        )


def _size(file: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    parts = file.rglob("*") if file.is_dir() else [file]
    return sum(part.stat().st_size for part in parts if part.is_file())


def _ended(file: Path, code: int, seconds: float, memory: float) -> DataError:
    """The error of a process that sent no answer, by its exit status or the signal that ended
    it.
    """
    if code in (-getattr(signal, "SIGXCPU", 0), -getattr(signal, "SIGKILL", 0)):
        return DataError(
            f"'{file}' takes more than {seconds:.0f} s to read, too long for its size; it is "
            "damaged, or of another format"
        )
    if code == NO_MEMORY:
        return DataError(
            f"'{file}' takes more than {memory / 1e6:.0f} MB of memory; if that is meant, raise "
            "it: limits.memory=NUMBER"
        )
    return DataError(f"'{file}' is damaged: reading it ends with status {code}")


def _answer(order: Mapping[str, Any]) -> tuple[Arrays, dict[str, Any]]:
    """Result of the reader within memory and processor time, without writing a file, or the error
    that it raises.
    """
    module, _, name = order["reader"].partition(":")
    file = Path(order["file"])
    read = getattr(importlib.import_module(module), name)
    with suppress(ImportError):
        import resource

        limits = {
            resource.RLIMIT_DATA: int(order["memory"]),
            resource.RLIMIT_CPU: int(order["seconds"]),
            resource.RLIMIT_FSIZE: 0,
            resource.RLIMIT_CORE: 0,
        }
        for kind, limit in limits.items():
            with suppress(ValueError, OSError):
                resource.setrlimit(kind, (limit, limit))
    try:
        with use_limits(Limits(**order["limits"])):
            return read(file, **order["request"])
    except VehestError as error:
        return {}, {"error": type(error).__name__, "message": str(error)}
    except MemoryError:
        os._exit(NO_MEMORY)
    except Exception as error:
        reason = printable(str(error).partition("\n")[0][:160]) or type(error).__name__
        return {}, {
            "error": "DataError",
            "message": f"'{file}' is damaged ({reason}); make it again",
        }


def _send(stream: BinaryIO, arrays: Arrays, answer: Mapping[str, Any]) -> None:
    """Write arrays and answer as one Arrow stream: a row with a list a column, the answer as
    metadata.
    """
    columns = [
        pa.LargeListArray.from_arrays(pa.array([0, len(array)], pa.int64()), pa.array(array))
        for array in arrays.values()
    ]
    kinds = [pa.field(name, column.type) for name, column in zip(arrays, columns, strict=True)]
    schema = pa.schema(kinds, metadata={"answer": json.dumps(answer)})
    with pa.ipc.new_stream(stream, schema) as writer:
        writer.write_batch(pa.record_batch(columns, schema=schema))


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the caller ends it
    with os.fdopen(os.dup(1), "wb") as answers:
        os.dup2(2, 1)  # what a library prints is no answer
        _send(answers, *_answer(json.load(sys.stdin)))
