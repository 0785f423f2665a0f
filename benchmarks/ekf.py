"""Ten hours at 20 Hz through the filter whose tyres adapt (RATTE): compiled against the tests' extended filter, step by step in torch.

Writes results/benchmarks/ekf.json. Samples are random numbers in the shape of a drive (the time does not depend on values). The filter
step by step is timed on ten seconds of them, and ten hours take 3600 times as long; both ways filter those ten seconds to the same states.
One thread, one process, seconds of the processor, after a warm-up; memory is the peak of the process beyond its size before.
"""

from __future__ import annotations

import json
import os
import platform
import resource
import sys
import time
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "filters"))

RESULT = Path(__file__).parents[1] / "results" / "benchmarks" / "ekf.json"
RATE = 20
HOURS = float(os.environ.get("BENCH_HOURS", "10"))
SHORT = 200
MOST_SECONDS = 60.0
MOST_DIFFERENCE = 1e-9


def main() -> None:
    """Measure, write, print."""
    from readable_filters import extended_filter, rational_model

    from vehest.artefacts.artefact import library_versions
    from vehest.estimators.rational_ekf import RationalFilter
    from vehest.filters.gaussian import Gaussian

    torch.set_num_threads(1)
    noise = {"yaw_rate": 0.005, "ay": 0.15, "steer": 0.003, "tyres": 0.01}
    curves = {"c1_front": 0.008, "c2_front": 6.7e4, "c1_rear": 0.005, "c2_rear": 1.15e5}
    estimator = RationalFilter.from_config({"noise": noise, "curves": curves})
    assert isinstance(estimator, RationalFilter)
    steps = round(HOURS * 3600 * RATE)
    generator = np.random.default_rng(0)
    samples = generator.standard_normal((steps, 4)) * [0.2, 1.0, 3.0, 0.03] + [0.0, 25.0, 0.0, 0.0]
    short = samples[:SHORT]
    compiled = estimator.filter_samples(short)
    first = Gaussian(*map(torch.as_tensor, estimator.first_gaussian(short[0], {})))
    inputs = (torch.as_tensor(short[:, [0, 2]]), torch.as_tensor(short[:, [1, 3]]))
    extended_filter(rational_model(estimator), inputs[0][:5], inputs[1][:5], first)
    started = time.process_time()
    readable = extended_filter(rational_model(estimator), *inputs, first).filtered.mean.numpy()
    baseline = (time.process_time() - started) * steps / SHORT
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    started = time.process_time()
    estimator.filter_samples(samples)
    ours = time.process_time() - started
    peak = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 / 1e6
    row = {
        "case": f"{HOURS:g} hours at {RATE} Hz, RATTE: step by step in torch against compiled",
        "baseline_seconds": round(baseline, 1),
        "ours_seconds": round(ours, 3),
        "ratio": round(baseline / ours, 1),
        "ours_mb": round(peak, 1),
        "largest_difference_of_states": float(f"{np.abs(compiled.mean - readable).max():.2g}"),
    }
    machine = {
        "processor": platform.processor() or platform.machine(),
        "system": platform.system(),
        "cores_used": 1,
    }
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    RESULT.write_text(
        json.dumps({"cases": [row], "versions": library_versions(), "machine": machine}, indent=1)
        + "\n"
    )
    met = ours <= MOST_SECONDS and row["largest_difference_of_states"] <= MOST_DIFFERENCE
    print(
        f"{row['ratio']:.0f} x  {row['case']}  ({baseline:.0f} s -> {ours:.2f} s; target {'met' if met else 'MISSED'})"
    )


if __name__ == "__main__":
    main()
