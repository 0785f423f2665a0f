"""The proving ground: the compiled plant against the library in plain Python, and data sets made side by side against one after another.

Writes results/benchmarks/simulation.json. The plant drives two seconds of a turn at 25 m/s, 1 ms a step; both ways must end in the same
state. Data sets are made from nothing by the ordinary ingest, each run in a process of its own with the machine code of the plant already
on disk, as after the first run on a machine. Memory is the peak of the largest process of a run. BENCH_DATASETS names other data sets.
"""

from __future__ import annotations

import json
import os
import platform
import resource
import statistics
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RESULT = ROOT / "results" / "benchmarks" / "simulation.json"
DATASETS = os.environ.get("BENCH_DATASETS", "sim_small,sim_bmw").split(",")
MOST_SECONDS = {"sim_small": 20.0, "sim_bmw": 480.0}  # on two cores
SECONDS = 2.0
SPEED = 25.0
STEP = 1e-3
REPEATS = 3
STEERING = 0.02  # rad/s for the first second


def plant_runs() -> tuple[float, float, float]:
    """Seconds of plain Python and of the compiled plant, and the largest difference of their last states."""
    import numpy as np
    from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb

    from vehest.configuration.composition import compose_config
    from vehest.simulation.plant.multi_body import MultiBodyPlant
    from vehest.simulation.plant.parameters import library_parameters, vehicle_from_configuration

    config = compose_config("ingest", ["dataset=sim_small"])["dataset"]["vehicle"]
    plant = MultiBodyPlant(vehicle_from_configuration(config), STEP)
    parameters = library_parameters(plant.vehicle)
    start = plant.initial_state(0.0, 0.0, 0.0, SPEED)
    n_steps = round(SECONDS / STEP)

    def derivative(x: Any, u: list[float]) -> Any:
        return np.array(vehicle_dynamics_mb(x.tolist(), u, parameters))

    def plainly() -> Any:
        x = start.values.copy()
        for k in range(n_steps):
            u = [STEERING if k < n_steps // 2 else 0.0, 0.0]
            k1 = derivative(x, u)
            k2 = derivative(x + 0.5 * STEP * k1, u)
            k3 = derivative(x + 0.5 * STEP * k2, u)
            k4 = derivative(x + STEP * k3, u)
            x = x + STEP / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        return x

    def compiled() -> Any:
        turning = np.array([STEERING, 0.0, 0.0, 0.0, 0.0])
        straight = np.zeros(5)
        return plant.advance(
            plant.advance(start, turning, n_steps // 2), straight, n_steps - n_steps // 2
        ).values

    compiled()
    times: dict[str, list[float]] = {"plain": [], "compiled": []}
    for _ in range(REPEATS):
        for name, work in (("plain", plainly), ("compiled", compiled)):
            started = time.perf_counter()
            work()
            times[name].append(time.perf_counter() - started)
    difference = float(np.abs(plainly() - compiled()).max())
    return statistics.median(times["plain"]), statistics.median(times["compiled"]), difference


def dataset_run(name: str, jobs: int) -> tuple[float, float, int]:
    """Seconds, peak memory of the largest process [MB], and how many drives there are."""
    from vehest.configuration.composition import compose_config
    from vehest.run.console import Messages
    from vehest.run.ingest import outcome_of
    from vehest.run.runner import Runner
    from vehest.run.signals import StopSignals

    with tempfile.TemporaryDirectory(prefix="vehest-bench-") as folder:
        config = compose_config("ingest", [f"dataset={name}", f"output={folder}"])
        started = time.perf_counter()
        artefact = Runner(Path(folder), Messages(quiet=True), StopSignals(), jobs).ingest(config)
        seconds = time.perf_counter() - started
        n_drives = outcome_of(artefact)["drives"]
    peak = max(
        resource.getrusage(who).ru_maxrss
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return seconds, peak * 1024 / 1e6, n_drives


def in_own_process(work: Any, *arguments: object) -> Any:
    """Run in a fresh process, so that peak memory is its own."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(work, *arguments).result()


def versions() -> dict[str, str]:
    """Versions of the libraries; in a process of its own."""
    from vehest.artefacts.artefact import library_versions

    return library_versions()


def main() -> None:
    """Measure, write, print the ratios."""
    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    in_own_process(dataset_run, "sim_small", 1)  # compiles
    plain, compiled, difference = in_own_process(plant_runs)
    if not difference < 1e-9:
        sys.exit(f"the compiled plant ends {difference:g} away from the library")
    rows = [
        {
            "case": f"{SECONDS:g} s of the plant at {SPEED:g} m/s, {STEP * 1e3:g} ms a step: library in Python, compiled",
            "baseline_seconds": round(plain, 4),
            "ours_seconds": round(compiled, 4),
            "ratio": round(plain / compiled, 1),
        }
    ]
    for name in DATASETS:
        alone, alone_mb, n_drives = in_own_process(dataset_run, name, 1)
        together, together_mb, _ = in_own_process(dataset_run, name, cores)
        rows.append(
            {
                "case": f"{name}, {n_drives} drives: one process, {cores} processes",
                "baseline_seconds": round(alone, 1),
                "ours_seconds": round(together, 1),
                "ratio": round(alone / together, 2),
                "baseline_mb": round(alone_mb, 1),
                "ours_mb": round(together_mb, 1),
            }
        )
    machine = {
        "processor": platform.processor() or platform.machine(),
        "system": platform.system(),
        "cores_used": cores,
    }
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    RESULT.write_text(
        json.dumps(
            {"cases": rows, "versions": in_own_process(versions), "machine": machine}, indent=1
        )
        + "\n"
    )
    for row in rows:
        name = str(row["case"]).split(",")[0]
        limit = MOST_SECONDS.get(name)
        seconds = float(row["ours_seconds"])
        target = (
            f"; target of {limit:g} s {'met' if seconds <= limit else 'MISSED'}" if limit else ""
        )
        memory = f"; {row['ours_mb']:.0f} MB a process" if "ours_mb" in row else ""
        print(
            f"{row['ratio']:6.1f} x  {row['case']}  ({row['baseline_seconds']} s -> {row['ours_seconds']} s{memory}{target})"
        )


if __name__ == "__main__":
    main()
