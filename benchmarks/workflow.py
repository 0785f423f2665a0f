"""What a user waits for: a finished study run again, an estimate of a minute and of fifteen hours of driving.

Writes results/benchmarks/workflow.json. Every case is the command line in a process of its own, the best of its repeats. Beside each
stands the plain way in the same run: loading the libraries without which nothing of it can be done, or reading the same file with
pyarrow. Data: the quickstart's own simulated drives, and a sine in the shape of a drive (the time does not depend on values).
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

ROOT = Path(__file__).parents[1]
RESULT = ROOT / "results" / "benchmarks" / "workflow.json"
REPEATS = 5
RATE = 100.0
MINUTE = 60.0
LONG = 15 * 3600.0
LIBRARIES = "import numba, scipy.special, pyarrow.parquet, hydra"


def measured(
    command: Sequence[str], folder: Path, repeats: int = REPEATS, source: Path | None = None
) -> dict[str, float]:
    """Seconds of the quickest run and peak memory [MB] of the largest, of the code in ``source`` or else of the installed one."""
    seconds = []
    memory = []
    environment = {**os.environ, "VEHEST_OUTPUT": str(folder / "outputs")} | (
        {"PYTHONPATH": str(source)} if source else {}
    )
    for _ in range(repeats):
        begun = time.perf_counter()
        process = subprocess.Popen(
            command,
            cwd=folder,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        _, status, usage = os.wait4(process.pid, 0)
        if status != 0:
            raise SystemExit(f"{' '.join(command)} ended with {os.waitstatus_to_exitcode(status)}")
        seconds.append(time.perf_counter() - begun)
        memory.append(usage.ru_maxrss / 1024)
    return {"seconds": round(min(seconds), 3), "peak_mb": round(max(memory), 0)}


def write_drive(file: Path, seconds: float) -> None:
    """A sine in the shape of a drive; in a process of its own, whose memory would count as that of its children."""
    t = np.arange(round(seconds * RATE)) / RATE
    vx = 25.0 + 3.0 * np.sin(t / 7.0)
    yaw_rate = 0.2 * np.sin(t / 2.0)
    columns = {
        "time": t,
        "yaw_rate": yaw_rate,
        "vx": vx,
        "ay": vx * yaw_rate,
        "ax": 3.0 / 7.0 * np.cos(t / 7.0),
        "steer": 0.03 * np.sin(t / 2.0),
    }
    pq.write_table(pa.table(columns), file)


def cases_of(folder: Path, source: Path | None = None) -> dict[str, dict[str, float]]:
    """The command line's cases, after a run that fills the compile cache and the output root."""
    folder.mkdir()
    for file in ("minute.parquet", "long.parquet"):
        (folder / file).symlink_to(folder.parent / file)
    vehest = (sys.executable, "-c", "from vehest.cli import main; main()")
    run = (*vehest, "run", "quickstart", "tracking=none")
    minute = (*vehest, "estimate", "minute.parquet", "-o", "out.parquet")
    for command in (run, minute):
        measured(command, folder, 1, source)
    return {
        "help": measured((*vehest, "--help"), folder, REPEATS, source),
        "run_finished": measured(run, folder, REPEATS, source),
        "estimate_minute": measured(minute, folder, REPEATS, source),
        "estimate_15_h": measured(
            (*vehest, "estimate", "long.parquet", "-o", "out.parquet"), folder, 2, source
        ),
    }


def main() -> None:
    """Measure every case, print and write it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--before", metavar="REV", help="a commit whose code is measured in the same run"
    )
    before = parser.parse_args().before
    with tempfile.TemporaryDirectory(prefix="workflow-") as scratch:
        folder = Path(scratch)
        for file, seconds in (("minute.parquet", MINUTE), ("long.parquet", LONG)):
            process = get_context("spawn").Process(
                target=write_drive, args=(folder / file, seconds)
            )
            process.start()
            process.join()
        plain = {
            "python": measured((sys.executable, "-c", "pass"), folder),
            "libraries": measured((sys.executable, "-c", LIBRARIES), folder),
            "read_15_h": measured(
                (
                    sys.executable,
                    "-c",
                    "import pyarrow.parquet; pyarrow.parquet.read_table('long.parquet')",
                ),
                folder,
                2,
            ),
        }
        now = cases_of(folder / "now")
        result: dict[str, object] = {
            "command": " ".join(["benchmarks/workflow.py", *sys.argv[1:]]),
            "plain": plain,
            "now": now,
        }
        ratios = {
            f"{name} over libraries": now[name]["seconds"] / plain["libraries"]["seconds"]
            for name in ("run_finished", "estimate_minute")
        }
        ratios["estimate_15_h over read_15_h"] = (
            now["estimate_15_h"]["seconds"] / plain["read_15_h"]["seconds"]
        )
        if before:
            subprocess.run(
                ["git", "worktree", "add", "-q", "--detach", folder / "code", before],
                cwd=ROOT,
                check=True,
            )
            try:
                then = cases_of(folder / "then", folder / "code" / "src")
            finally:
                subprocess.run(
                    ["git", "worktree", "remove", "--force", folder / "code"], cwd=ROOT, check=True
                )
            result["before"] = {"commit": before, **then}
            ratios |= {
                f"{name} before over now": then[name]["seconds"] / now[name]["seconds"]
                for name in now
            }
    result["ratios"] = {name: round(value, 2) for name, value in ratios.items()}
    result["machine"] = (
        f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    )
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    RESULT.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
