"""A process that spins beside a benchmark where BENCH_BUSY is set (`BENCH_BUSY=1 make bench-ksnn`); results then go to NAME_busy.json."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

BUSY = bool(os.environ.get("BENCH_BUSY"))


@contextmanager
def spinning() -> Iterator[None]:
    """Keep one core busy, if that is asked for."""
    process = subprocess.Popen([sys.executable, "-c", "while True: pass"]) if BUSY else None
    try:
        yield
    finally:
        if process is not None:
            process.kill()
            process.wait()


def result_file(name: str) -> Path:
    """Where the results of a benchmark go."""
    return (
        Path(__file__).parents[1]
        / "results"
        / "benchmarks"
        / f"{name}{'_busy' if BUSY else ''}.json"
    )
