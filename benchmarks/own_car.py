"""From a raw CSV of the real Ferrari to a verdict: how long, and what came of it.

Writes the drive as a logger would (km/h, deg/s, g, names of its own, the lateral axis turned) into a folder of its own, runs
``vehest new`` without questions and ``vehest run --minutes 15`` there, and keeps times, verdict and leaderboard in results/own_car. On an
idle machine; the second run shows that a run goes on.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from vehest.run.table_records import record_tables

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "results" / "own_car"
DRIVE = Path("revs") / "20140222_01_01_03_250lm"
WHEELBASE = "2.4"
MASS = "982"  # m, kg (data sheet)
G = 9.80665
VERSION = "1"
"""Raised when the numbers of its tables move."""


def write_log(data: Path, file: Path) -> None:
    """The drive in a logger's dress."""
    told = {
        name: np.loadtxt(data / DRIVE / f"{name}.txt").ravel()
        for name in ("t", "vx", "axCG", "ayCG", "yawRate", "delta", "beta_true")
    }
    columns = {
        "Time": told["t"],
        "Speed": told["vx"] * 3.6,
        "GyroZ": -np.degrees(told["yawRate"]),
        "AccX": told["axCG"] / G,
        "AccY": -told["ayCG"] / G,
        "Steering": np.degrees(told["delta"]),
        "SlipAngle": np.degrees(told["beta_true"]),
    }
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(columns)
        writer.writerows(
            zip(*(np.round(values, 6).tolist() for values in columns.values()), strict=True)
        )


def timed(folder: Path, *words: str) -> tuple[float, str]:
    """Seconds and standard output of a command without VEHEST_DATA; its standard error goes on to ours."""
    environment = os.environ | {"VEHEST_OUTPUT": str(folder / "outputs")}
    del environment["VEHEST_DATA"]
    start = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-m", "vehest", *words],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    if done.returncode != 0:
        sys.exit(f"vehest {' '.join(words)} ended with {done.returncode}")
    return time.monotonic() - start, done.stdout


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--minutes", type=float, default=15.0)
    minutes = parser.parse_args().minutes
    data = os.environ.get("VEHEST_DATA")
    if not data:
        sys.exit("set VEHEST_DATA to the folder with the recordings")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_log(Path(data), folder / "lap.csv")
        rows = []
        output = ""
        new = ["new", "my_car", "lap.csv", "--yes", "--wheelbase", WHEELBASE, "--mass", MASS]
        run = ["run", "my_car", "--minutes", f"{minutes:g}", "tracking=none"]
        for words in (new, run, run):
            seconds, output = timed(folder, *words)
            left = len(re.findall(r"^left out: .*not done yet", output, re.MULTILINE))
            rows.append(
                {
                    "command": f"vehest {' '.join(words)}",
                    "seconds": f"{seconds:.1f}",
                    "left": left,
                    "processors": os.cpu_count(),
                }
            )
            sys.stdout.write(f"{rows[-1]}\n{output}\n")
            sys.stdout.flush()
        _, told = timed(folder, "report", "my_car", "--json", "--quiet")
    figures = json.loads(told)
    RESULTS.mkdir(parents=True, exist_ok=True)
    with (RESULTS / "run.csv").open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    verdict = "\n".join(figures["verdict"])
    (RESULTS / "verdict.txt").write_text(
        re.sub(r"-[0-9a-f]{12}\b", "-…", verdict) + "\n", encoding="utf-8"
    )
    keys = (
        "title",
        "rmse_sideslip",
        "rmse_sideslip_low",
        "rmse_sideslip_high",
        "against_best",
        "beats_zero",
        "beats_static_map",
        "n_seeds",
    )
    with (RESULTS / "leaderboard.csv").open("w", newline="", encoding="utf-8") as stream:
        board = csv.DictWriter(stream, keys, lineterminator="\n", extrasaction="ignore")
        board.writeheader()
        for row in figures["leaderboard"]:
            board.writerow(
                {
                    key: f"{row[key]:.4f}" if isinstance(row[key], float) else row[key]
                    for key in keys
                }
            )
    record_tables(
        [RESULTS / name for name in ("run.csv", "verdict.txt", "leaderboard.csv")],
        "make own_car",
        ["script benchmarks/own_car.py", "data ferrari_250lm", "report own_car"],
    )


if __name__ == "__main__":
    main()
