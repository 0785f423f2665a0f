"""Training speed: compiled recursions against plain PyTorch, and members together against each alone, in the same run.

Writes results/benchmarks/training.json. Every case runs in a process of its own, on one core, after a warm-up; a case's figure
is the best of its repeats. Data: random numbers in the shape of five minutes at 20 Hz (the time does not depend on values).
"""

from __future__ import annotations

import json
import platform
import resource
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

RESULT = Path(__file__).parents[1] / "results" / "benchmarks" / "training.json"
SAMPLES = 6000
REPEATS = 3
MEMBERS = 5
STRUCTURES = {
    "ksnn_linear_bias_p2": ("ksnn", {"n_hidden": 0, "bias": True}),
    "ksnn_nonlinear_no_bias_p2_q2": ("ksnn", {"n_hidden": 2, "bias": False}),
    "gru_states_5": ("gru", {"n_states": 5}),
    "lstm_states_5": ("lstm", {"n_states": 5}),
}


def one_epoch(structure: str, compiled: bool, members: int) -> tuple[float, float]:
    """Seconds of one epoch of ``members`` members trained together, and peak memory [MB]."""
    import torch

    from vehest.data.recording import Recording
    from vehest.estimators.base import FitData
    from vehest.estimators.registry import estimator_class
    from vehest.training.context import FitContext
    from vehest.training.supervised import SupervisedSettings

    torch.set_num_threads(1)
    generator = np.random.default_rng(0)
    scales = {"yaw_rate": 0.2, "vx": 1.0, "ay": 3.0, "ax": 1.0, "vy_ref": 0.5}
    channels = {
        name: scale * generator.standard_normal(SAMPLES) + 25.0 * (name == "vx")
        for name, scale in scales.items()
    }
    drive = Recording("random", "none", 20.0, 0.0, channels, "simulated")
    name, config = STRUCTURES[structure]
    kind = estimator_class(name)

    def fit(epochs: int) -> float:
        networks = [kind.from_config(config) for _ in range(members)]
        for seed, network in enumerate(networks):
            network.seed(seed)
        started = time.perf_counter()
        settings = SupervisedSettings(max_epochs=epochs, patience=epochs, compiled=compiled)
        kind.fit_members(networks, FitData([drive], [drive.cut(0.0, 30.0)]), settings, FitContext())
        return time.perf_counter() - started

    fit(1)
    seconds = min(fit(2) - fit(1) for _ in range(REPEATS))
    return seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def in_own_process(
    work: Callable[..., tuple[float, float]], *arguments: object
) -> tuple[float, float]:
    """Run in a fresh process, so that peak memory is its own."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(work, *arguments).result()


def main() -> None:
    """Measure, write, print the ratios."""
    from vehest.artefacts.artefact import library_versions

    cases = []
    for structure in STRUCTURES:
        together = in_own_process(one_epoch, structure, True, MEMBERS)
        plain = in_own_process(one_epoch, structure, False, MEMBERS)
        alone = in_own_process(one_epoch, structure, True, 1)
        cases.append(
            case(
                f"{structure}: {MEMBERS} trainings, plain PyTorch against compiled, one epoch",
                plain,
                together,
            )
        )
        cases.append(
            case(
                f"{structure}: {MEMBERS} seeds each alone against together, one epoch",
                (MEMBERS * alone[0], alone[1]),
                together,
            )
        )
    machine = {
        "processor": platform.processor() or platform.machine(),
        "system": platform.system(),
        "cores_used": 1,
    }
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    RESULT.write_text(
        json.dumps({"cases": cases, "versions": library_versions(), "machine": machine}, indent=1)
        + "\n"
    )
    for entry in cases:
        print(
            f"{entry['ratio']:6.1f} x  {entry['case']}  ({entry['baseline_seconds']:.3f} s -> {entry['ours_seconds']:.3f} s)"
        )


def case(name: str, baseline: tuple[float, float], ours: tuple[float, float]) -> dict[str, object]:
    """One row of the result file."""
    return {
        "case": name,
        "baseline_seconds": round(baseline[0], 4),
        "ours_seconds": round(ours[0], 4),
        "ratio": round(baseline[0] / ours[0], 2),
        "baseline_mb": round(baseline[1], 1),
        "ours_mb": round(ours[1], 1),
    }


if __name__ == "__main__":
    main()
