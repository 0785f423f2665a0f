"""What the contract, a band and health cost: a step online and a minute in batch, against the estimator alone.

Writes results/benchmarks/trust.json. A linear drive with steering at 100 Hz; one thread, seconds of the processor, the least of five passes
over a minute, after compilation. `contract_seconds` is the guard of samples and estimates alone, `ours_seconds` with band and health.
"""

from __future__ import annotations

import json
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
RESULT = Path(__file__).parents[1] / "results" / "benchmarks" / "trust.json"
PASSES = 5
CURVES = "{c1_front: 0.1, c2_front: 0.7e5, c1_rear: 0.1, c2_rear: 1.2e5}"
FAMILIES = {
    "luenberger": ["training.grid=1", "training.max_evaluations=20"],
    "rational_ekf": [
        "estimator.rate_hz=100",
        "training.method=data",
        "estimator.curves={c1_front: 0.1, c2_front: 0.7e5, c1_rear: 0.1, c2_rear: 1.2e5}",
    ],
    "ksnn": ["estimator.rate_hz=100", "training.max_epochs=1"],
}


def least(work: Callable[[], Any]) -> float:
    """Seconds of the processor, the least of some passes."""
    times = []
    for _ in range(PASSES):
        started = time.process_time()
        work()
        times.append(time.process_time() - started)
    return min(times)


def main() -> None:
    """Measure, write, print."""
    import vehest
    from single_track_drive import linear_drive
    from vehest.run.artefacts import library_versions
    from vehest.trust.contract import GuardedStepper, estimate_guarded

    torch.set_num_threads(1)
    drives = [linear_drive(60.0, 100.0, seed)[0] for seed in range(3)]
    rows = []
    for name, words in FAMILIES.items():
        model = vehest.train(name, drives[:1], drives[1:2], words)
        trust = vehest.api._TRUST[model]
        assert trust.bands is not None
        assert trust.health is not None
        columns = {channel: np.array(drives[2][channel]) for channel in model.channels}
        measured = drives[2].select(model.channels)
        samples = [dict(zip(columns, row, strict=True)) for row in np.stack(list(columns.values()), 1).tolist()]

        def walk(stepper: Any, samples: list[dict[str, float]] = samples) -> None:
            for sample in samples:
                stepper.step(sample)

        walk(GuardedStepper(model, trust))
        alone, guarded, whole = (
            least(lambda make=make: walk(make()))  # type: ignore[misc]
            for make in (
                model.online,
                lambda model=model: GuardedStepper(model),
                lambda model=model, trust=trust: GuardedStepper(model, trust),
            )
        )
        steps = len(samples)
        rows.append(
            {
                "case": f"{name}: a step online",
                "baseline_seconds": float(f"{alone / steps:.3g}"),
                "contract_seconds": float(f"{guarded / steps:.3g}"),
                "ours_seconds": float(f"{whole / steps:.3g}"),
                "ratio": round(alone / whole, 3),
                "band_and_health_us": round(1e6 * (whole - guarded) / steps, 2),
            }
        )
        alone, whole = (
            least(lambda: model.estimate([measured])),  # noqa: B023
            least(lambda: estimate_guarded(model, columns, measured, trust)),  # noqa: B023
        )
        rows.append(
            {
                "case": f"{name}: a minute in batch",
                "baseline_seconds": float(f"{alone:.3g}"),
                "ours_seconds": float(f"{whole:.3g}"),
                "ratio": round(alone / whole, 3),
            }
        )
    machine = f"{platform.machine()}, {platform.system()} {platform.release()}"
    RESULT.write_text(json.dumps({"cases": rows, "versions": library_versions(), "machine": machine}, indent=1) + "\n", encoding="utf-8")
    for row in rows:
        beyond = f", band and health {row['band_and_health_us']} µs" if "band_and_health_us" in row else ""
        print(f"{row['case']}: {row['baseline_seconds']:g} s alone, {row['ours_seconds']:g} s with all{beyond}; ratio {row['ratio']}")


if __name__ == "__main__":
    main()
