"""What the contract, a band and health cost, a step online and a minute in batch, against the estimator alone; a block bootstrap, faults.

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


def compared(case: str, baseline: float, ours: float) -> dict[str, Any]:
    """A row of the result."""
    return {
        "case": case,
        "baseline_seconds": float(f"{baseline:.3g}"),
        "ours_seconds": float(f"{ours:.3g}"),
        "ratio": round(baseline / ours, 3),
    }


def bootstrap_row() -> dict[str, Any]:
    """Twenty candidates of three seeds against the best of them, 150 blocks drawn 10,000 times: all pairs together, and one by one."""
    from vehest.evaluation.significance import differences_of_blocks

    generator = np.random.default_rng(0)
    sizes = generator.uniform(20.0, 40.0, 150)
    sums = [sizes * generator.gamma(2.0, 1.0, (3, 150)) for _ in range(20)]
    pairs = [(sums[0], other) for other in sums[1:]]
    apart = least(lambda: [differences_of_blocks([pair], sizes) for pair in pairs])
    return compared(
        "block bootstrap of 20 candidates, 10,000 draws",
        apart,
        least(lambda: differences_of_blocks(pairs, sizes)),
    )


def faults_row() -> dict[str, Any]:
    """Every fault in three severities from ten starts, in a drive of 150 s, by the model that comes with vehest."""
    import vehest
    from single_track_drive import linear_drive
    from vehest.inference.estimation import prepared_recording
    from vehest.trust.contract import GuardedRun
    from vehest.trust.faults import KINDS, Fault, inject

    model = vehest.load_model("pretrained")
    trust = model.trust
    drive = prepared_recording(model, linear_drive(150.0, 100.0, 0)[0])
    faults = [
        Fault(kind, "vx" if kind == "lost_wheel" else "ay", severity, onset=onset)  # type: ignore[arg-type]
        for kind in KINDS
        for severity in ("mild", "medium", "severe")
        for onset in range(30, 80, 5)
    ]
    alone = least(lambda: [model.estimate([drive]) for _ in faults])
    whole = least(
        lambda: [
            GuardedRun(model, trust)(inject(drive.channels, drive.rate_hz, fault), drive)
            for fault in faults
        ]
    )
    return compared(f"ksnn: {len(faults)} faults in 150 s", alone, whole)


def main() -> None:
    """Measure, write, print."""
    import vehest
    from single_track_drive import linear_drive
    from vehest.artefacts.artefact import library_versions
    from vehest.trust.contract import GuardedRun, GuardedStepper

    torch.set_num_threads(1)
    drives = [linear_drive(60.0, 100.0, seed)[0] for seed in range(3)]
    rows = [bootstrap_row(), faults_row()]
    for name, words in FAMILIES.items():
        model = vehest.train(name, drives[:1], drives[1:2], words)
        trust = model.trust
        assert trust.bands is not None
        assert trust.health is not None
        columns = {channel: np.array(drives[2][channel]) for channel in model.channels}
        measured = drives[2].select(model.channels)
        samples = [
            dict(zip(columns, row, strict=True))
            for row in np.stack(list(columns.values()), 1).tolist()
        ]

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
                **compared(f"{name}: a step online", alone / steps, whole / steps),
                "contract_seconds": float(f"{guarded / steps:.3g}"),
                "band_and_health_us": round(1e6 * (whole - guarded) / steps, 2),
            }
        )
        alone, whole = (
            least(lambda: model.estimate([measured])),  # noqa: B023
            least(lambda: GuardedRun(model, trust)(columns, measured)),  # noqa: B023
        )
        rows.append(compared(f"{name}: a minute in batch", alone, whole))
    machine = f"{platform.machine()}, {platform.system()} {platform.release()}"
    RESULT.write_text(
        json.dumps({"cases": rows, "versions": library_versions(), "machine": machine}, indent=1)
        + "\n",
        encoding="utf-8",
    )
    for row in rows:
        beyond = (
            f", band and health {row['band_and_health_us']} µs"
            if "band_and_health_us" in row
            else ""
        )
        print(
            f"{row['case']}: {row['baseline_seconds']:g} s alone, {row['ours_seconds']:g} s together{beyond}; ratio {row['ratio']}"
        )


if __name__ == "__main__":
    main()
