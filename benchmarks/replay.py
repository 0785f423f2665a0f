"""Models on the frames of a bus: against themselves offline (check), and in real time for half an hour (soak).

`check` makes a log of the real Ferrari's test range with jitter and 1 % of its frames lost, and writes errors online and offline of the
pre-trained model and of those in the output root that learnt from nothing but its training range, to results/export/replay.csv. `soak`
replays a log of 30 minutes at 100 Hz in real time and writes deadlines and memory to results/export/replay_30min.csv.
"""

from __future__ import annotations

import argparse
import csv
import math
import os
import platform
import re
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from vehest.run.table_records import record_tables

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "sources"), str(ROOT / "tests" / "bus")]
RESULTS = ROOT / "results" / "export"
TRAINING = (149.0, 450.0)  # s of the Ferrari's drive
TOLERATED = 0.05
VERSION = "1"
"""Raised when the numbers of its tables move."""


def models_of_training_range(output: Path) -> list[Path]:
    """Causal models in the output root that learnt from the training range and nothing else, one of each variant and rate."""
    from vehest.estimators.model_files import load_model, read_description

    found: dict[tuple[str, str, float], Path] = {}
    for folder in sorted((output / "train").glob("[!.]*")):
        described = read_description(folder)
        ranges = [
            re.search(r"\[([\d.]+), ([\d.]+)\)", text) for text in described.about.trained_on or ()
        ]
        if not ranges or any("20140222" not in text for text in described.about.trained_on or ()):
            continue
        if not all(
            one and float(one[1]) >= TRAINING[0] and float(one[2]) <= TRAINING[1] for one in ranges
        ):
            continue
        model = load_model(folder)
        if model.causal:
            found.setdefault(
                (described.estimator, described.variant, model.settings.rate_hz), folder
            )
    return list(found.values())


def check(names: list[str]) -> None:
    """Compare models online and offline, and say which are worse online by more than 5 %."""
    from can_drive import ferrari
    from replayed_drive import FERRARI, compare

    output = Path(os.environ.get("VEHEST_OUTPUT", "outputs"))
    drive = ferrari(*FERRARI)
    rows = []
    for name in names or ["pretrained", *map(str, models_of_training_range(output))]:
        with tempfile.TemporaryDirectory() as folder:
            found = compare(name, drive, Path(folder), output)
        ratio_v, ratio_beta = found.ratios
        row = {
            "model": re.sub(r"-[0-9a-f]{12}$", "", Path(name).name),
            "rmse_vy_offline": found.offline[0],
            "rmse_vy_online": found.online[0],
            "rmse_sideslip_offline_deg": found.offline[1],
            "rmse_sideslip_online_deg": found.online[1],
            "ratio_vy": ratio_v,
            "ratio_sideslip": ratio_beta,
            "within_5_percent": "yes" if max(ratio_v, ratio_beta) <= 1.0 + TOLERATED else "no",
            "rmse_vy_at_sample": found.at_sample[0],
            "rmse_sideslip_at_sample_deg": found.at_sample[1],
            "samples": found.samples,
            "samples_lost": found.lost,
        }
        rows.append(row)
        say(
            f"{row['model']:<44} RMSE(v) {found.offline[0]:.4f} offline, {found.online[0]:.4f} online ({ratio_v - 1:+.1%}); "
            f"RMSE(β) {found.offline[1]:.4f}° offline, {found.online[1]:.4f}° online ({ratio_beta - 1:+.1%})"
        )
    write(RESULTS / "replay.csv", rows)
    beyond = [str(row["model"]) for row in rows if row["within_5_percent"] == "no"]
    say(f"worse online by more than 5 %: {', '.join(beyond) or 'none'}")


def soak(minutes: float, model: str) -> int:
    """Replay in real time, and look at the memory of this process once a second; returns the deadlines missed."""
    from can_drive import write_log
    from replayed_drive import FERRARI, JITTER, LOST, signals_for

    from conftest import planar_drive
    from vehest.api import load_model
    from vehest.run.replay import replay_log

    torch.set_num_threads(1)
    if os.environ.get("VEHEST_DATA"):
        from can_drive import ferrari

        name = "ferrari_250lm"
        drive = ferrari(*FERRARI)
    else:
        name = "planar"
        drive = planar_drive(150.0, 100.0)
    repeats = max(math.ceil(60.0 * minutes / drive.duration), 1)
    with tempfile.TemporaryDirectory() as folder:
        drive = drive.cut(drive.start_time, drive.start_time + 60.0 * minutes / repeats)
        written = write_log(drive, Path(folder), ".blf", jitter=JITTER, lost=LOST, repeats=repeats)
        signals = signals_for(load_model(model).channels)
        out = Path(folder) / "estimates.csv"
        resident: list[float] = []

        def look() -> bool:
            if time.monotonic() > begun + len(resident):
                resident.append(
                    int(Path("/proc/self/statm").read_text().split()[1])
                    * os.sysconf("SC_PAGE_SIZE")
                    / 1e6
                )
            return False

        begun = time.monotonic()
        figures = replay_log(
            written.log,
            (),
            look,
            model=model,
            dbc=written.dbc,
            signals=signals,
            out=out,
            quiet=False,
        )
    row: dict[str, Any] = {
        "drive": name,
        "model": re.sub(r"-[0-9a-f]{12}$", "", Path(model).name),
        "minutes": round(figures["seconds"] / 60, 3),
    }
    keys = ("samples_hz", "samples", "samples_lost", "estimates", "latest_ms", "deadlines_missed")
    row |= {key: figures[key] for key in keys} | {
        "memory_growth_mb": max(resident) - resident[min(3, len(resident) - 1)]
    }
    row |= {"python": platform.python_version(), "processors": os.cpu_count()}
    for key, value in row.items():
        say(f"{key}: {value}")
    write(RESULTS / "replay_30min.csv", [row])
    return int(figures["deadlines_missed"])


def write(path: Path, rows: list[dict[str, Any]]) -> None:
    """A table of figures."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(
            {
                key: f"{value:.5g}" if isinstance(value, float) else value
                for key, value in row.items()
            }
            for row in rows
        )
    record_tables(
        [path],
        "make replay_check" if path.name == "replay.csv" else "make replay_30min",
        ["script benchmarks/replay.py", "data ferrari_250lm"],
    )
    say(f"written: {path}")


def say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("what", choices=["check", "soak"])
    parser.add_argument(
        "--model", action="append", default=[], help="a folder, or a name; several for check"
    )
    parser.add_argument("--minutes", type=float, default=30.0)
    asked = parser.parse_args()
    if asked.what == "check":
        check(asked.model)
    elif soak(asked.minutes, (asked.model or ["pretrained"])[0]):
        sys.exit(1)


if __name__ == "__main__":
    main()
