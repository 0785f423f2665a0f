"""Training speed of many seeds: of a KS-NN, GRU or LSTM trained together against one after another by a plain PyTorch loop, in one run.

Writes results/benchmarks/ksnn.json. Both ways train on the same random numbers in the shape of five minutes at 20 Hz (the time does not
depend on values), in float32, batches of 64 windows, with the validation loss after every epoch. The plain loop is the readable module with
autograd and Adam, one network at a time; it is timed on one epoch of one seed, and 64 seeds take 64 times as long. Both ways are allowed
two threads, the seeds together are timed from the end of the first epoch, each way runs in a process of its own, after a warm-up, and the
ways take turns; a figure is the best of the rounds, for both alike, memory the peak of the process so far. The first epoch's validation
losses are compared. A peer stands beside, timed once: all seeds batched by torch.func.vmap over the readable module (cells of plain
tensors). BENCH_BUSY=1 keeps a core busy (beside.py), without the peer.
"""

from __future__ import annotations

import json
import os
import platform
import resource
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from multiprocessing import get_context
from typing import Any

import numpy as np

from beside import BUSY, result_file, spinning

RESULT = result_file("ksnn")
SAMPLES = 6000
VALIDATION_SECONDS = 30.0
WINDOW = 30
BATCH = 64
PLAIN_SEEDS = 1
EPOCHS = 4
ROUNDS = 3
THREADS = 2
STRUCTURES = {  # family, settings, seeds, and the ratio that is asked for
    "ksnn no bias, (P, Q) = (2, 0)": (
        "ksnn",
        {"n_local": 2, "n_hidden": 0, "bias": False},
        64,
        900,
    ),
    "ksnn bias, (P, Q) = (2, 0)": ("ksnn", {"n_local": 2, "n_hidden": 0, "bias": True}, 64, 900),
    "ksnn no bias, (P, Q) = (3, 2)": (
        "ksnn",
        {"n_local": 3, "n_hidden": 2, "bias": False},
        64,
        280,
    ),
    "ksnn bias, (P, Q) = (3, 2)": ("ksnn", {"n_local": 3, "n_hidden": 2, "bias": True}, 64, 280),
    "gru, 5 states": ("gru", {"n_states": 5}, 20, 40),
    "lstm, 5 states": ("lstm", {"n_states": 5}, 20, 40),
}
Figures = tuple[float, float, list[float]]


def drives() -> tuple[Any, Any]:
    """What is learnt from and what is validated on."""
    from vehest.data.recording import Recording

    generator = np.random.default_rng(0)
    scales = {"yaw_rate": 0.2, "vx": 1.0, "ay": 3.0, "ax": 1.0, "vy_ref": 0.5}
    channels = {
        name: scale * generator.standard_normal(SAMPLES) + 25.0 * (name == "vx")
        for name, scale in scales.items()
    }
    drive = Recording("random", "none", 20.0, 0.0, channels, "simulated")
    return drive, drive.cut(0.0, VALIDATION_SECONDS)


def together(
    name: str, config: dict[str, Any], seeds: int, compiled: bool = True, epochs: int = EPOCHS
) -> Figures:
    """Training steps · seeds a second of all seeds together, peak memory [MB], first validation losses; by vmap if not ``compiled``."""
    import torch

    from vehest.estimators.base import FitData
    from vehest.estimators.registry import estimator_class
    from vehest.training.context import FitContext
    from vehest.training.supervised import SupervisedSettings

    torch.set_num_threads(THREADS)
    train, validation = drives()

    def fit(epochs: int) -> tuple[float, list[float]]:
        members = [estimator_class(name).from_config(config) for _ in range(seeds)]
        for seed, member in enumerate(members):
            member.seed(seed)
        ends: list[float] = []
        settings = SupervisedSettings(
            max_epochs=epochs, patience=epochs, batch_size=BATCH, compiled=compiled
        )
        context = FitContext(on_progress=lambda progress: ends.append(time.perf_counter()))
        records = estimator_class(name).fit_members(
            members, FitData([train], [validation]), settings, context
        )
        return ends[-1] - ends[0], [
            float(record.history["validation_loss"][0]) for record in records
        ]

    seconds, losses = fit(epochs + 1)  # from the end of the first epoch to that of the last
    return epochs * seeds * _steps() / seconds, _peak(), losses


def plain(name: str, config: dict[str, Any], seeds: int) -> Figures:
    """The same for a few seeds one after another."""
    import torch

    torch.set_num_threads(THREADS)
    plain_epoch(name, config, 0, batches=10)
    started = time.perf_counter()
    losses = [plain_epoch(name, config, seed) for seed in range(PLAIN_SEEDS)]
    return PLAIN_SEEDS * _steps() / (time.perf_counter() - started), _peak(), losses


def plain_epoch(name: str, config: dict[str, Any], seed: int, batches: int | None = None) -> float:
    """Train one network for an epoch as one would write it down; its validation loss [m²/s²]."""
    import torch

    from vehest.data.windows import windows_of
    from vehest.estimators.registry import estimator_class
    from vehest.training.members import constrain, prepare
    from vehest.training.supervised import shuffle_seed

    estimator = estimator_class(name).from_config(config)
    train, validation = drives()
    network = estimator.network_for([train])
    network.reset(torch.Generator().manual_seed(seed))
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-3)
    learnt, held_out = (
        windows_of([part], estimator.channels, "vy_ref", WINDOW) for part in (train, validation)
    )
    series, targets, starts = (
        torch.as_tensor(values) for values in (learnt.series, learnt.targets, learnt.starts)
    )
    series = prepare(network, series.float())
    targets = targets.float()
    rows = torch.arange(WINDOW)
    order = torch.randperm(len(starts), generator=torch.Generator().manual_seed(shuffle_seed(seed)))
    for batch in order.split(BATCH)[:batches]:
        optimiser.zero_grad()
        loss = (
            (network(series[starts[batch].unsqueeze(-1) + rows]) - targets[batch]).square().mean()
        )
        loss.backward()
        optimiser.step()
        with torch.no_grad():
            constrain(network, dict(network.named_parameters()))
    with torch.no_grad():
        windows = prepare(network, torch.as_tensor(held_out.series).float())[
            torch.as_tensor(held_out.starts).unsqueeze(-1) + rows
        ]
        return float(
            (network(windows).double() - torch.as_tensor(held_out.targets)).square().mean()
        )


def _steps() -> int:
    """Training steps of one seed in an epoch."""
    return -(-(SAMPLES - WINDOW) // BATCH)


def _peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measured(
    name: str, config: dict[str, Any], seeds: int, pools: list[ProcessPoolExecutor]
) -> list[Figures]:
    """Best rounds of the plain loop and of all seeds together; then, where no core is kept busy, one epoch by vmap."""
    rounds = [
        [
            pool.submit(way, name, config, seeds).result()
            for pool, way in zip(pools[:2], (plain, together), strict=True)
        ]
        for _ in range(ROUNDS)
    ]
    found = [
        (max(run[0] for run in way), max(run[1] for run in way), way[0][2])
        for way in zip(*rounds, strict=True)
    ]
    return (
        found
        if BUSY
        else [*found, pools[2].submit(together, name, config, seeds, False, 1).result()]
    )


def main() -> None:
    """Measure, write, print the ratios."""
    from vehest.artefacts.artefact import library_versions

    with ExitStack() as stack:
        pools = [
            stack.enter_context(ProcessPoolExecutor(1, mp_context=get_context("spawn")))
            for _ in range(3)
        ]
        figures = {
            structure: measured(*asked[:3], pools) for structure, asked in STRUCTURES.items()
        }
    cases = []
    for structure, (baseline, ours, *peers) in figures.items():
        *_, seeds, least = STRUCTURES[structure]
        difference = max(
            abs(one - other) / other for one, other in zip(ours[2], baseline[2], strict=False)
        )
        assert difference < 1e-4, f"the two ways learn different things: {difference}"
        steps = seeds * _steps()
        cases.append(
            {
                "case": f"{structure}: one epoch of {seeds} seeds, plain PyTorch one after another against together",
                "baseline_seconds": round(steps / baseline[0], 4),
                "ours_seconds": round(steps / ours[0], 4),
                "ratio": round(ours[0] / baseline[0], 2),
                "least_ratio": least,
                "baseline_steps_per_second": round(baseline[0], 1),
                "ours_steps_per_second": round(ours[0], 1),
                "baseline_mb": round(baseline[1], 1),
                "ours_mb": round(ours[1], 1),
                "relative_difference_of_losses": float(f"{difference:.1e}"),
            }
        )
        entry = cases[-1]
        for batched in peers:
            entry |= {
                "vmap_seconds": round(steps / batched[0], 4),
                "ratio_to_vmap": round(ours[0] / batched[0], 2),
            }
            entry["vmap_relative_difference_of_losses"] = float(
                f"{abs(batched[2][0] / baseline[2][0] - 1.0):.1e}"
            )
        print(
            f"{entry['ratio']:6.1f} x (at least {least})  {entry['case']}  "
            f"({baseline[0]:.0f} -> {ours[0]:.0f} steps a second, {ours[1]:.0f} MB, losses differ by {difference:.1e})",
            flush=True,
        )
    machine = {
        "processor": platform.processor() or platform.machine(),
        "system": platform.system(),
        "cores_used": THREADS,
    }
    machine["cores"] = os.cpu_count() or 1
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    RESULT.write_text(
        json.dumps({"cases": cases, "versions": library_versions(), "machine": machine}, indent=1)
        + "\n"
    )


if __name__ == "__main__":
    with spinning():
        main()
