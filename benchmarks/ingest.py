"""Ingest of one official Revs CSV file, 791,000 rows x 55 columns, against a bare pyarrow.csv.read_csv of the same file.

Writes results/benchmarks/ingest.json. The bare call skips the 12 lines above the rows, takes the names from there and parses all 55
columns as numbers, with pyarrow's defaults (all cores, blocks of 1 MiB). Every measurement runs in a process of its own, by turns, with
the file in the page cache; a case's figures are medians of its repeats. Memory is the peak of the process beyond its imports. Times
and memory without imports. The file is made first, in a temporary folder, and removed (BENCH_ROWS makes a shorter one).
"""

from __future__ import annotations

import json
import os
import platform
import resource
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RESULT = ROOT / "results" / "benchmarks" / "ingest.json"
RECORDING = "20140222_01_01_03_250lm"
ROWS = int(os.environ.get("BENCH_ROWS", "791000"))
COLUMNS = 55
REPEATS = 5
TABLE_MB = ROWS * COLUMNS * 8 / 1e6
MOST_TIME = 2.0
MOST_MEMORY = 3.0  # of the bare call's time, of the table's size


def generate(root: Path) -> None:
    """Write the file; values with six decimals, as a logger would."""
    sys.path.insert(0, str(ROOT / "tests"))
    from revs_files import smooth_drive, write_csv, write_vehicle_parameters

    (root / "revs").mkdir()
    write_csv(csv_file(root), smooth_drive(ROWS / 1000, decimals=6)[0])
    write_vehicle_parameters(root / "revs" / "250lm.csv")


def bare(root: Path) -> Callable[[], Any]:
    """The yardstick: pyarrow alone."""
    import pyarrow.csv as pc

    with open(csv_file(root), encoding="latin-1") as stream:
        names = [next(stream) for _ in range(12)][10].strip().split(",")
    assert len(names) == COLUMNS
    return lambda: pc.read_csv(csv_file(root), pc.ReadOptions(skip_rows=12, column_names=names))


def declared_channels(root: Path) -> Callable[[], Any]:
    """The source's read of the channels in conf/dataset/revs_targa_2014.yaml."""
    from vehest.sources.base import open_source

    source = open_source(configuration(root)["dataset"])
    return lambda: source.read(RECORDING)


def all_channels(root: Path) -> Callable[[], Any]:
    """The source's read of as many columns as there are channels."""
    from vehest.data.channels import CHANNELS
    from vehest.sources.base import open_source

    with open(csv_file(root), encoding="latin-1") as stream:
        names = [next(stream) for _ in range(12)][10].strip().split(",")[1:]
    channels = {
        name: {"column": column, "unit": CHANNELS[name].unit}
        for name, column in zip(CHANNELS, names, strict=False)
    }
    source = open_source(
        {**configuration(root)["dataset"], "channels": channels, "units_row": "ignore"}
    )
    return lambda: source.read(RECORDING)


def whole_stage(root: Path) -> Callable[[], Any]:
    """What ``vehest ingest`` does: hash the files, read, check, write Parquet, hash that."""
    from vehest.artefacts.artefact import make
    from vehest.run.ingest import plan_ingest, write_ingest
    from vehest.run.signals import StopSignals

    config = configuration(root)

    def run() -> Any:
        plan = plan_ingest(config)
        return make(
            plan,
            lambda folder: write_ingest(config, plan, folder, 1, StopSignals(), lambda *_: None),
        )

    return run


def configuration(root: Path) -> dict[str, Any]:
    """The data set's configuration, one recording long."""
    from vehest.configuration.composition import compose_config

    overrides = [
        "dataset=revs_targa_2014",
        f"dataset.recordings=[{RECORDING}]",
        f"root={root}",
        f"output={root / 'outputs'}",
    ]
    return compose_config("ingest", overrides)


def csv_file(root: Path) -> Path:
    """The file that all read."""
    return root / "revs" / f"{RECORDING}.csv"


def measured(prepare: Callable[[Path], Callable[[], Any]], root: Path) -> tuple[float, float]:
    """Seconds, and peak memory beyond what imports and configuration took [MB]."""
    work = prepare(root)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    started = time.perf_counter()
    result = work()
    seconds = time.perf_counter() - started
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    del result
    return seconds, (peak - before) * 1024 / 1e6


def in_own_process(work: Callable[..., Any], *arguments: object) -> Any:
    """Run in a fresh process, so that peak memory is its own; this one stays small, for a child's peak begins at its parent's size."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(work, *arguments).result()


def median(runs: list[tuple[float, float]]) -> tuple[float, float]:
    """Medians of seconds and memory."""
    return statistics.median(seconds for seconds, _ in runs), statistics.median(
        memory for _, memory in runs
    )


def case(name: str, baseline: tuple[float, float], ours: tuple[float, float]) -> dict[str, Any]:
    """One row of the result file."""
    return {
        "case": name,
        "baseline_seconds": round(baseline[0], 3),
        "ours_seconds": round(ours[0], 3),
        "ratio": round(baseline[0] / ours[0], 2),
        "baseline_mb": round(baseline[1], 1),
        "ours_mb": round(ours[1], 1),
    }


def versions() -> dict[str, str]:
    """Versions of the libraries; in a process of its own."""
    from vehest.artefacts.artefact import library_versions

    return library_versions()


def main() -> None:
    """Generate, measure by turns, write, print the ratios."""
    cases = {
        f"{ROWS} rows x {COLUMNS} columns: source reads the 12 declared channels": declared_channels,
        f"{ROWS} rows x {COLUMNS} columns: source reads as many columns as there are channels": all_channels,
        f"{ROWS} rows x {COLUMNS} columns: whole ingest of the 12 declared channels (hash, read, check, Parquet)": whole_stage,
    }
    free = shutil.disk_usage(tempfile.gettempdir()).free
    needed = ROWS * COLUMNS * 14
    if free < needed:
        sys.exit(
            f"{needed / 1e9:.1f} GB are needed in {tempfile.gettempdir()}, {free / 1e9:.1f} GB are free; set TMPDIR"
        )
    with tempfile.TemporaryDirectory(prefix="vehest-bench-") as folder:
        root = Path(folder)
        in_own_process(generate, root)
        size = csv_file(root).stat().st_size / 1e6
        print(f"{size:.0f} MB of CSV, a table of {TABLE_MB:.0f} MB")
        runs: dict[str, list[tuple[float, float]]] = {name: [] for name in ("bare", *cases)}
        for turn in range(REPEATS + 1):  # the first warms the page cache and is not counted
            for name, prepare in {"bare": bare, **cases}.items():
                figures = in_own_process(measured, prepare, root)
                shutil.rmtree(root / "outputs", ignore_errors=True)
                if turn:
                    runs[name].append(figures)
    rows = [case(name, median(runs["bare"]), median(runs[name])) for name in cases]
    machine = {
        "processor": platform.processor() or platform.machine(),
        "system": platform.system(),
        "cores_used": os.cpu_count(),
    }
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    RESULT.write_text(
        json.dumps(
            {"cases": rows, "versions": in_own_process(versions), "machine": machine}, indent=1
        )
        + "\n"
    )
    for row in rows:
        time_share = row["ours_seconds"] / row["baseline_seconds"]
        memory_share = row["ours_mb"] / TABLE_MB
        met = "met" if time_share <= MOST_TIME and memory_share < MOST_MEMORY else "MISSED"
        print(
            f"{row['ratio']:6.2f} x  {row['case']}  ({row['baseline_seconds']:.2f} s -> {row['ours_seconds']:.2f} s; "
            f"{row['ours_mb']:.0f} MB, {memory_share:.2f} tables; target {met})"
        )


if __name__ == "__main__":
    main()
